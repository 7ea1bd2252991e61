"""The inner loops over inertial samples. State order: rotation, velocity, position, gyro bias, accelerometer bias."""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.inertial.so3_kernels import (
    matmul3,
    matmul3_skew,
    matmul3_transposed,
    matvec3,
    right_jacobian_into,
)
from fleetmap.numerics.kernel import kernel
from fleetmap.numerics.linear_kernels import exp_into
from fleetmap.sensors.samples import Stamps


@kernel
def _interpolated(stamp_ns: int, stamps_ns: Stamps, values: Array, out: Array) -> None:
    """Row of `values` (N, 3) at a moment, between two stamps (N,) linearly, beyond them the nearest."""
    after = int(np.searchsorted(stamps_ns, stamp_ns, side="right"))
    if after in (0, len(stamps_ns)) or stamps_ns[after - 1] == stamp_ns:
        out[:] = values[max(after - 1, 0)]
        return
    # Nanoseconds since 1970 do not fit into a float.
    share = float(stamp_ns - stamps_ns[after - 1]) / float(stamps_ns[after] - stamps_ns[after - 1])
    for a in range(3):
        out[a] = values[after - 1, a] + share * (values[after, a] - values[after - 1, a])


@kernel
def _between(x: float, at: Array, values: Array, out: Array) -> None:
    """Row of values (N, 3) at x, linear between at (N,), the nearest row beyond them. To the bit as np.interp."""
    after = int(np.searchsorted(at, x, side="right"))
    is_held = after in (0, len(at)) or at[after - 1] == x
    before = max(after - 1, 0)
    for a in range(3):
        out[a] = values[before, a]
        if not is_held:
            slope = (values[after, a] - values[before, a]) / (at[after] - at[before])
            out[a] = slope * (x - at[before]) + values[before, a]


@kernel
def intervals(stamps_ns: Stamps, gyro: Array, accel: Array, start_ns: int, end_ns: int) -> tuple[Array, Array, Array]:
    """As `preintegration.imu_intervals`."""
    if end_ns <= start_ns or len(stamps_ns) == 0:
        return np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))
    first, end = int(np.searchsorted(stamps_ns, start_ns + 1)), int(np.searchsorted(stamps_ns, end_ns))
    count, begin = end - first + 1, max(first - 1, 0)
    steps_s, rates, forces = np.empty(count), np.empty((count, 3)), np.empty((count, 3))
    at = (stamps_ns[begin : end + 1] - start_ns).astype(np.float64)
    before_ns = start_ns
    for n in range(count):
        after_ns = stamps_ns[first + n] if n < count - 1 else end_ns
        middle = 0.5 * ((after_ns - start_ns) + (before_ns - start_ns))
        _between(middle, at, gyro[begin : end + 1], rates[n])
        _between(middle, at, accel[begin : end + 1], forces[n])
        steps_s[n] = (after_ns - before_ns) * 1e-9
        before_ns = after_ns
    return steps_s, rates, forces


@kernel
def cut_samples(
    stamps_ns: Stamps, gyro: Array, accel: Array, start_ns: int, end_ns: int
) -> tuple[Array, Array, Array, Array, float]:
    """Samples between two moments with both ends added: seconds since the first (N,), rates and forces (N, 3), the hole (N - 1,)
    around each step, and the sample period there, NaN where it is unknown.

    A hole is the distance between the recorded samples around a step; outside the data it goes from the data's end.
    """
    first = int(np.searchsorted(stamps_ns, start_ns, side="right"))
    last = max(int(np.searchsorted(stamps_ns, end_ns)), first)
    inner = last - first
    moments = np.empty(inner + 2, np.int64)
    moments[0], moments[inner + 1] = start_ns, end_ns
    moments[1 : inner + 1] = stamps_ns[first:last]
    rates, forces = np.zeros((inner + 2, 3)), np.zeros((inner + 2, 3))
    times_s, holes_s = np.asarray((moments - start_ns) * 1e-9, np.float64), np.empty(inner + 1)
    if len(stamps_ns) == 0:
        holes_s[0] = times_s[1]
        return times_s, rates, forces, holes_s, np.nan
    rates[1 : inner + 1], forces[1 : inner + 1] = gyro[first:last], accel[first:last]
    for end in (0, inner + 1):
        _interpolated(moments[end], stamps_ns, gyro, rates[end])
        _interpolated(moments[end], stamps_ns, accel, forces[end])
    for n in range(inner + 1):
        before = int(np.searchsorted(stamps_ns, moments[n], side="right")) - 1
        after = int(np.searchsorted(stamps_ns, moments[n + 1]))
        begins = stamps_ns[before] if before >= 0 else moments[n]
        ends = stamps_ns[after] if after < len(stamps_ns) else moments[n + 1]
        holes_s[n] = (ends - begins) * 1e-9
    near = stamps_ns[max(first - 2, 0) : last + 2]
    return times_s, rates, forces, holes_s, float(np.median(np.diff(near))) * 1e-9 if len(near) > 1 else np.nan


@kernel
def step_rotvec(gyro_a: Array, gyro_b: Array, dt_s: float, out: Array) -> None:
    """Rotation vector over one step of linearly changing rate: mean rate plus coning term (Magnus, second order)."""
    coning = dt_s * dt_s / 12.0
    out[0] = 0.5 * dt_s * (gyro_a[0] + gyro_b[0]) + coning * (gyro_a[1] * gyro_b[2] - gyro_a[2] * gyro_b[1])
    out[1] = 0.5 * dt_s * (gyro_a[1] + gyro_b[1]) + coning * (gyro_a[2] * gyro_b[0] - gyro_a[0] * gyro_b[2])
    out[2] = 0.5 * dt_s * (gyro_a[2] + gyro_b[2]) + coning * (gyro_a[0] * gyro_b[1] - gyro_a[1] * gyro_b[0])


@kernel
def _propagate_covariance(
    cov: Array, transition: Array, gyro_gain: Array, accel_gain: Array, variances: Array, dt_s: float, work: Array
) -> None:
    """cov <- A cov A^T + noise, A = I but for nine rows. variances: gyro, accel, gyro walk, accel walk."""
    for r in range(9):
        for c in range(15):
            total = cov[r, c] if r >= 3 else 0.0
            for k in range(3):
                total += transition[r, k] * cov[k, c]
            for k in range(9, 15):
                total += transition[r, k] * cov[k, c]
            if r >= 6:
                total += dt_s * cov[r - 3, c]
            work[r, c] = total
    for r in range(9, 15):
        for c in range(15):
            work[r, c] = cov[r, c]
    for r in range(15):
        for c in range(r + 1):
            if c >= 9:
                total = work[r, c]
            else:
                total = work[r, c] if c >= 3 else 0.0
                for k in range(3):
                    total += work[r, k] * transition[c, k]
                for k in range(9, 15):
                    total += work[r, k] * transition[c, k]
                if c >= 6:
                    total += dt_s * work[r, c - 3]
            if r < 9:
                for k in range(3):
                    total += variances[0] * gyro_gain[r, k] * gyro_gain[c, k]
                    total += variances[1] * accel_gain[r, k] * accel_gain[c, k]
            elif r == c:
                total += variances[2] if r < 12 else variances[3]
            cov[r, c] = total
            cov[c, r] = total


@kernel
def _set_transition(
    rot_a: Array,
    rot_b: Array,
    step: Array,
    jac: Array,
    acc_a: Array,
    acc_b: Array,
    dt_s: float,
    work: Array,
    transition: Array,
    gyro_gain: Array,
    accel_gain: Array,
) -> None:
    """First nine rows of the error transition over one step, and the gains of rate and acceleration noise."""
    lever_a, lever_b, turned, through = work[0], work[1], work[2], work[3]
    matmul3_skew(rot_a, acc_a, lever_a)
    matmul3_skew(rot_b, acc_b, lever_b)
    for a in range(3):
        for b in range(3):
            turned[a, b] = lever_b[a, 0] * step[b, 0] + lever_b[a, 1] * step[b, 1] + lever_b[a, 2] * step[b, 2]
    matmul3(lever_b, jac, through)
    for a in range(3):
        for b in range(3):
            transition[a, b] = step[b, a]
            transition[3 + a, b] = -0.5 * dt_s * (lever_a[a, b] + turned[a, b])
            transition[6 + a, b] = -dt_s * dt_s * (lever_a[a, b] / 3.0 + turned[a, b] / 6.0)
            gyro_gain[a, b] = dt_s * jac[a, b]
            gyro_gain[3 + a, b] = -0.5 * dt_s * dt_s * through[a, b]
            gyro_gain[6 + a, b] = -dt_s * dt_s * dt_s * through[a, b] / 6.0
            accel_gain[3 + a, b] = 0.5 * dt_s * (rot_a[a, b] + rot_b[a, b])
            accel_gain[6 + a, b] = dt_s * dt_s * (rot_a[a, b] / 3.0 + rot_b[a, b] / 6.0)
    for a in range(9):
        for b in range(3):
            transition[a, 9 + b] = -gyro_gain[a, b]
            transition[a, 12 + b] = -accel_gain[a, b]


@kernel
def _advance_bias_jacobians(
    jacobians: Array,
    rot_a: Array,
    rot_b: Array,
    step: Array,
    jac: Array,
    acc_a: Array,
    acc_b: Array,
    gyro_change: Array,
    dt_s: float,
    work: Array,
) -> None:
    """Derivatives of the increments by the biases: rot/gyro, vel/gyro, vel/accel, pos/gyro, pos/accel (5, 3, 3)."""
    before, by_rate, now, lever, part_a, part_b = work[0], work[1], work[2], work[3], work[4], work[5]
    coning = dt_s * dt_s / 12.0
    for a in range(3):
        for b in range(3):
            before[a, b] = jacobians[0, a, b]
            by_rate[a, b] = -dt_s if a == b else 0.0
    by_rate[0, 1] -= coning * gyro_change[2]
    by_rate[1, 0] += coning * gyro_change[2]
    by_rate[0, 2] += coning * gyro_change[1]
    by_rate[2, 0] -= coning * gyro_change[1]
    by_rate[1, 2] -= coning * gyro_change[0]
    by_rate[2, 1] += coning * gyro_change[0]
    matmul3_transposed(step, before, now)
    matmul3(jac, by_rate, lever)
    for a in range(3):
        for b in range(3):
            now[a, b] += lever[a, b]
            jacobians[0, a, b] = now[a, b]
    matmul3_skew(rot_a, acc_a, lever)
    matmul3(lever, before, part_a)
    matmul3_skew(rot_b, acc_b, lever)
    matmul3(lever, now, part_b)
    for a in range(3):
        for b in range(3):
            jacobians[3, a, b] += dt_s * jacobians[1, a, b] - dt_s * dt_s * (part_a[a, b] / 3.0 + part_b[a, b] / 6.0)
            jacobians[4, a, b] += dt_s * jacobians[2, a, b] - dt_s * dt_s * (rot_a[a, b] / 3.0 + rot_b[a, b] / 6.0)
            jacobians[1, a, b] -= 0.5 * dt_s * (part_a[a, b] + part_b[a, b])
            jacobians[2, a, b] -= 0.5 * dt_s * (rot_a[a, b] + rot_b[a, b])


@kernel
def integrate_samples(
    times_s: Array,
    gyro_radps: Array,
    accel_mps2: Array,
    variances: Array,
    rotation: Array,
    velocity_mps: Array,
    position_m: Array,
    jacobians: Array,
    cov: Array,
) -> None:
    """Integrates N bias-free samples at times (N,) in place: increments, bias Jacobians (5, 3, 3), covariance (15, 15).

    variances (N - 1, 4): rate, acceleration and the two bias steps, for each step. Rate and specific force change
    linearly between samples; rotation is right to fourth order of the step, velocity and position to second.
    Source: Forster et al. 2017, with the exact derivatives of this rule in place of Euler's.
    """
    theta, rot_b = np.empty(3), np.empty((3, 3))
    step, jac, work = np.empty((3, 3)), np.empty((3, 3)), np.empty((6, 3, 3))
    transition, gyro_gain, accel_gain, cov_work = (
        np.zeros((9, 15)),
        np.zeros((9, 3)),
        np.zeros((9, 3)),
        np.zeros((15, 15)),
    )
    force_a, force_b, gyro_change = np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(times_s) - 1):
        dt_s = times_s[n + 1] - times_s[n]
        acc_a, acc_b = accel_mps2[n], accel_mps2[n + 1]
        step_rotvec(gyro_radps[n], gyro_radps[n + 1], dt_s, theta)
        exp_into(theta, step)
        right_jacobian_into(theta, jac)
        matmul3(rotation, step, rot_b)
        _set_transition(rotation, rot_b, step, jac, acc_a, acc_b, dt_s, work, transition, gyro_gain, accel_gain)
        _propagate_covariance(cov, transition, gyro_gain, accel_gain, variances[n], dt_s, cov_work)
        for a in range(3):
            gyro_change[a] = gyro_radps[n + 1, a] - gyro_radps[n, a]
        _advance_bias_jacobians(jacobians, rotation, rot_b, step, jac, acc_a, acc_b, gyro_change, dt_s, work)
        matvec3(rotation, acc_a, force_a)
        matvec3(rot_b, acc_b, force_b)
        for a in range(3):
            position_m[a] += dt_s * velocity_mps[a] + dt_s * dt_s * (force_a[a] / 3.0 + force_b[a] / 6.0)
            velocity_mps[a] += 0.5 * dt_s * (force_a[a] + force_b[a])
            for b in range(3):
                rotation[a, b] = rot_b[a, b]
