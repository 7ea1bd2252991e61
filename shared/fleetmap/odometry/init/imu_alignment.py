"""Start of the inertial state: by a steady IMU, or by alignment of visual odometry with one: gyro bias, gravity, accelerometer bias,
velocities, and the scale if unknown.

Sources: Mur-Artal and Tardos 2017 (linear alignment), Qin et al. 2018 (gravity on a sphere).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array, rotation_between_vectors, se3, skew, so3_exp, so3_log
from fleetmap.inertial import GRAVITY_MPS2, Preintegrated, preintegrate
from fleetmap.odometry.filter.msckf import InitialState, NavState
from fleetmap.odometry.sensor_buffer import IMU_GAP_NS
from fleetmap.odometry.settings import FilterSettings, OdometrySettings, StartSettings
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples, Stamps, Trajectory

_MAX_BIAS_SIGMAS = 6.0  # a larger accelerometer bias indicates a wrong fit
_Step = tuple[int, int, int]  # the number of a frame, its stamp and the next one's
_Term = tuple[int, Preintegrated]  # the number of a frame, and the motion until the next one


@dataclass(frozen=True, slots=True)
class VisualMotion:
    """K frames in axes of vision: rotations (K, 3, 3) vision_from_body, positions (K, 3) positions_m + scale * unscaled.

    unscaled (K, 3) is None if vision is metric. Sigmas are those of one interval's position and velocity;
    gravity_weights are those of the first, linear step.
    """

    stamps_ns: list[int]
    rotations: Array
    positions_m: Array
    unscaled: Array | None
    sigma_m: float
    sigma_mps: float
    gravity_weights: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Alignment:
    """Gravity's direction (3,) in axes of vision with a basis (3, 2) across it, biases (3,), and the last step's result.

    solution (n,), covariance (n, n): direction (2), accelerometer bias (3), scale if unknown, velocities (3 each).
    """

    direction: Array
    basis: Array
    gyro_bias_radps: Array
    accel_bias_mps2: Array
    solution: Array
    covariance: Array


def align(
    motion: VisualMotion,
    imu: ImuSamples,
    noise: ImuNoise,
    settings: OdometrySettings,
    *,
    gravity_slack: float,
    steps: int,
) -> Alignment | None:
    """Align with the given number of Gauss-Newton steps; None if the fitted gravity is implausible or a bias of either sensor too large.

    Motion that the IMU missed would count as a bias: only steps between frames that it felt whole are compared.
    gravity_slack: factor on the settings' tolerance of gravity's size in the linear step.
    """
    gyro_bias, felt = np.zeros(3), _felt_steps(motion.stamps_ns, imu)
    for _ in range(2):
        gyro_bias = gyro_bias + _gyro_bias_step(motion, felt, imu, noise, gyro_bias)
    # A bias larger than that of any gyro at rest comes from wrong tracks.
    if not np.linalg.norm(gyro_bias) < settings.start.steady_gyro_mean_radps:
        return None
    terms = [(k, preintegrate(imu, start, end, gyro_bias, np.zeros(3), noise)) for k, start, end in felt]
    gravity = _free_gravity(motion, terms)
    max_error = gravity_slack * settings.start.max_gravity_error_mps2
    if gravity is None or abs(np.linalg.norm(gravity) - GRAVITY_MPS2) > max_error:
        return None
    direction, accel_bias = gravity / np.linalg.norm(gravity), np.zeros(3)
    bias_sigma = settings.filter.initial_accel_bias_sigma_mps2
    for _ in range(steps):
        basis = _tangent(direction)
        solution, covariance = _sphere_step(motion, terms, GRAVITY_MPS2 * direction, basis, accel_bias, bias_sigma)
        direction = so3_exp(np.cross(direction, basis @ solution[:2])) @ direction
        accel_bias = accel_bias + solution[2:5]
    if np.linalg.norm(accel_bias) > _MAX_BIAS_SIGMAS * bias_sigma:
        return None
    return Alignment(direction, basis, gyro_bias, accel_bias, solution, covariance)


def initial_state(vision: Trajectory, alignment: Alignment) -> InitialState:
    """The filter's first state and covariance at the last view, in the old frame turned so that gravity points down."""
    down = np.array([0.0, 0.0, -1.0])
    turn = rotation_between_vectors(alignment.direction, down)
    last = se3(turn, np.zeros(3)) @ vision.frame_from_body[-1]
    state = NavState(
        last[:3, :3].copy(),
        turn @ alignment.solution[-3:],
        last[:3, 3].copy(),
        alignment.gyro_bias_radps,
        alignment.accel_bias_mps2,
    )
    size = len(alignment.covariance)
    # order: gravity direction, accelerometer bias, last velocity, then the unknowns of vision and gyro
    joint = np.zeros((8, size))
    joint[:5, :5] = np.eye(5)
    joint[5:8, size - 3 :] = np.eye(3)
    solved = joint @ alignment.covariance @ joint.T
    to_error = np.zeros((15, 8))
    # gravity known as d, truly d + B x: the frame must turn by r with r x d_odom = -T B x, so r = -d_odom x (T B x)
    to_error[0:3, 0:2] = -skew(down) @ turn @ alignment.basis
    to_error[3:6, 5:8] = turn
    to_error[12:15, 2:5] = np.eye(3)
    to_error[3:6] += skew(state.velocity_mps) @ to_error[0:3]
    to_error[6:9] = skew(state.position_m) @ to_error[0:3]
    covariance = 4.0 * to_error @ solved @ to_error.T
    least = np.diag([1e-6] * 3 + [1e-4] * 3 + [1e-6] * 3 + [4e-6] * 3 + [1e-4] * 3)
    return InitialState(state, covariance + least, int(vision.stamps_ns[-1]))


def felt_part(vision: Trajectory, imu: ImuSamples, most: int) -> tuple[Trajectory, Stamps]:
    """The frames beside the last `most` steps that the IMU felt whole, and durations (S,) of these in ns; empty if the newest is none."""
    felt = np.array([k for k, *_ in _felt_steps(vision.stamps_ns.tolist(), imu)[-most:]], np.int64)
    felt = felt[: len(felt) if len(vision) - 2 in felt else 0]
    beside = np.union1d(felt, felt + 1)
    return Trajectory(vision.stamps_ns[beside], vision.frame_from_body[beside]), np.diff(vision.stamps_ns)[felt]


def _felt_steps(stamps_ns: Sequence[int], imu: ImuSamples) -> list[_Step]:
    steps = [(k, start, end) for k, (start, end) in enumerate(pairwise(stamps_ns))]
    return [step for step in steps if core.longest_gap_ns(imu.stamps_ns, step[1], step[2]) <= IMU_GAP_NS]


def _gyro_bias_step(
    motion: VisualMotion, felt: list[_Step], imu: ImuSamples, noise: ImuNoise, gyro_bias: Array
) -> Array:
    hessian, gradient = np.zeros((3, 3)), np.zeros(3)
    for k, start_ns, end_ns in felt:
        term = preintegrate(imu, start_ns, end_ns, gyro_bias, np.zeros(3), noise)
        error = so3_log(term.delta_rotation.T @ (motion.rotations[k].T @ motion.rotations[k + 1]))
        hessian += term.d_rotation_d_gyro.T @ term.d_rotation_d_gyro
        gradient += term.d_rotation_d_gyro.T @ error
    return np.asarray(np.linalg.solve(hessian + 1e-12 * np.eye(3), gradient))


def _free_gravity(motion: VisualMotion, terms: list[_Term]) -> Array | None:
    """Gravity (3,) with its size free, by linear least squares over all velocities, and the scale if unknown."""
    parts = [_equations(motion, k, term, 1.0, np.eye(3), np.zeros(3), None) for k, term in terms]
    rows, right = (np.concatenate(sides) for sides in zip(*parts, strict=True))
    weights = np.tile(np.repeat(motion.gravity_weights, 3), len(terms))
    solution, _, rank, _ = np.linalg.lstsq(rows * weights[:, None], right * weights, rcond=None)
    return np.asarray(solution[:3]) if rank == rows.shape[1] else None


def _equations(
    motion: VisualMotion,
    k: int,
    term: Preintegrated,
    size_mps2: float,
    directions: Array,
    gravity: Array,
    accel_bias: Array | None,
) -> tuple[Array, Array]:
    """Rows (6, n) and right side (6,) of an interval, for corrections of `gravity` along directions (3, g), in units of size_mps2, of the
    accelerometer's bias unless that is None, for the scale if unknown, and all velocities.

    For p and v of the body: p' - p - R dp = 0.5 dt^2 g + dt v and -R dv = dt g + v - v'.
    """
    dt, rotation = term.dt_s, motion.rotations[k]
    moved, gained = term.delta_position_m, term.delta_velocity_mps
    columns = [np.vstack([0.5 * dt * dt * size_mps2 * directions, dt * size_mps2 * directions])]
    if accel_bias is not None:
        moved, gained = moved + term.d_position_d_accel @ accel_bias, gained + term.d_velocity_d_accel @ accel_bias
        columns.append(np.vstack([rotation @ term.d_position_d_accel, rotation @ term.d_velocity_d_accel]))
    if motion.unscaled is not None:
        columns.append(np.append(motion.unscaled[k] - motion.unscaled[k + 1], np.zeros(3))[:, None])
    velocities = np.zeros((6, 3 * len(motion.rotations)))
    velocities[:3, 3 * k : 3 * k + 3] = dt * np.eye(3)
    velocities[3:, 3 * k : 3 * k + 6] = np.hstack([np.eye(3), -np.eye(3)])
    shift = motion.positions_m[k + 1] - motion.positions_m[k] - 0.5 * dt * dt * gravity - rotation @ moved
    return np.hstack([*columns, velocities]), np.concatenate([shift, -dt * gravity - rotation @ gained])


def _sphere_step(
    motion: VisualMotion, terms: list[_Term], gravity: Array, basis: Array, accel_bias: Array, bias_sigma: float
) -> tuple[Array, Array]:
    """One Gauss-Newton step with gravity's size known: solution and covariance, see `Alignment`.

    If the scale is unknown, residuals beyond the sigmas widen the covariance.
    """
    count = len(motion.rotations)
    size = (5 if motion.unscaled is None else 6) + 3 * count
    hessian, gradient, squares = np.zeros((size, size)), np.zeros(size), 0.0
    weights = np.repeat([motion.sigma_m**-2, motion.sigma_mps**-2], 3)
    for k, term in terms:
        rows, right = _equations(motion, k, term, GRAVITY_MPS2, basis, gravity, accel_bias)
        hessian += rows.T @ (weights[:, None] * rows)
        gradient += rows.T @ (weights * right)
        squares += float(right @ (weights * right))
    hessian[2:5, 2:5] += np.eye(3) / bias_sigma**2
    gradient[2:5] -= accel_bias / bias_sigma**2
    covariance = np.linalg.inv(hessian + 1e-9 * np.eye(size))
    solution = np.asarray(covariance @ gradient)
    if motion.unscaled is not None:
        left = max(squares - float(gradient @ solution), 0.0) / max(6 * len(terms) - size + 3, 1)
        covariance = max(left, 1.0) * covariance
    return solution, np.asarray(covariance)


def _tangent(direction: Array) -> Array:
    """(3, 2) orthonormal basis across a direction."""
    other = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(direction, other)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)], axis=1)


def dynamic_initialization(
    vision: Trajectory, imu: ImuSamples, noise: ImuNoise, settings: OdometrySettings
) -> InitialState | None:
    """Align visual odometry (metric, body transforms in any frame) with the IMU, see `imu_alignment`.

    None if the alignment contradicts gravity's size.
    """
    stamps_ns, rotations = vision.stamps_ns.tolist(), vision.frame_from_body[:, :3, :3]
    motion = VisualMotion(stamps_ns, rotations, vision.positions_m, None, 0.004, 0.04, (200.0, 20.0))
    found = align(motion, imu, noise, settings, gravity_slack=2.0, steps=4)
    return None if found is None else initial_state(vision, found)


_POSITION_SIGMA_M, _VELOCITY_SIGMA_MPS = 0.006, 0.04


def mono_inertial_initialization(
    vision: Trajectory, imu: ImuSamples, noise: ImuNoise, body_from_cam: Array, settings: OdometrySettings
) -> tuple[InitialState, float] | None:
    """Align a camera's path up to scale with the IMU's, see `imu_alignment`; return the first state and metres per unit of vision.

    vision holds vision_from_cam at IMU stamps. None if the motion does not determine the scale to within the settings' share, or
    if the fitted gravity is implausible.
    """
    rotations = vision.frame_from_body[:, :3, :3] @ body_from_cam[:3, :3].T  # vision_from_body
    levers_m, weights = -rotations @ body_from_cam[:3, 3], (1 / _POSITION_SIGMA_M, 1 / _VELOCITY_SIGMA_MPS)
    sigmas = _POSITION_SIGMA_M, _VELOCITY_SIGMA_MPS
    motion = VisualMotion(vision.stamps_ns.tolist(), rotations, levers_m, vision.positions_m, *sigmas, weights)
    found = align(motion, imu, noise, settings, gravity_slack=3.0, steps=5)
    if found is None:
        return None
    scale, sigma = float(found.solution[5]), float(np.sqrt(found.covariance[5, 5]))
    if scale <= 0 or sigma > settings.monocular.max_scale_sigma_share * scale:
        return None
    vision_from_body = np.tile(np.eye(4), (len(vision), 1, 1))
    vision_from_body[:, :3, :3] = rotations
    vision_from_body[:, :3, 3] = scale * vision.positions_m + levers_m
    return initial_state(Trajectory(vision.stamps_ns, vision_from_body), found), scale


LOOK_BACK_NS = 20_000_000_000  # of a start by rest
_STEADY_PARTS = 10  # of a steady window, whose means must agree: a gap of this length leaves one without samples
_JUDGED_NS = 500_000_000


def static_initialization(imu: ImuSamples, until_ns: int, settings: OdometrySettings) -> InitialState | None:
    """State at the end of the latest steady window before `until_ns`; None if the IMU was not steady since it last lost samples."""
    window_ns = int(settings.start.steady_window_s * 1e9)
    # What was lost may be motion: a window over a gap, or before one, tells neither the biases nor how the body stands now.
    gaps = np.flatnonzero(np.diff(imu.stamps_ns, append=until_ns) > window_ns // _STEADY_PARTS)
    since = imu.stamps_ns[gaps[-1] + 1 if len(gaps) else 0 :]
    if not len(since):
        return None
    first_ns = max(int(since[0]), until_ns - LOOK_BACK_NS)
    end_ns = core.latest_steady(
        imu.stamps_ns, imu.gyro_radps, imu.accel_mps2, first_ns, until_ns, window_ns, _limits(settings.start)
    )
    if end_ns < first_ns:
        return None
    return _steady_state(imu.between(end_ns - window_ns, end_ns), end_ns, settings.filter)


def is_steady(window: ImuSamples, settings: StartSettings) -> bool:
    """True if the means of tenths of the window agree: vibration averages out, relevant motion does not.

    Standstill and constant speed cannot be distinguished; both show gravity, so the speed stays unknown.
    """
    return core.is_steady(window.gyro_radps, window.accel_mps2, _limits(settings))


def polynomial_rate(samples: Sequence[tuple[int, Array]], degree: int) -> Array | None:
    """Acceleration (3,) of samples (stamp, value (3,)): speeds for degree 1, positions for degree 2; None for less than half a second.

    By a least-squares polynomial of that degree.
    """
    if len(samples) < 2 * degree + 3 or samples[-1][0] - samples[0][0] < _JUDGED_NS:
        return None
    times_s = (np.array([stamp for stamp, _ in samples], np.float64) - samples[0][0]) * 1e-9
    fitted = np.polynomial.polynomial.polyfit(times_s, np.array([value for _, value in samples]), degree)
    return np.asarray(degree * fitted[degree], np.float64)


def _limits(settings: StartSettings) -> tuple[float, float, float, float, float]:
    """Limits in the core's order."""
    spreads = settings.steady_gyro_sigma_radps, settings.steady_accel_sigma_mps2
    return *spreads, settings.steady_gyro_mean_radps, GRAVITY_MPS2, settings.max_gravity_error_mps2


def _steady_state(window: ImuSamples, stamp_ns: int, settings: FilterSettings) -> InitialState:
    force = window.accel_mps2.mean(axis=0)
    rotation = rotation_between_vectors(force, np.array([0.0, 0.0, 1.0]))
    # the accelerometer's bias along gravity shows in its size; across gravity it hides in the tilt
    accel_bias = 0.5 * (np.linalg.norm(force) - GRAVITY_MPS2) * (force / np.linalg.norm(force))
    state = NavState(rotation, gyro_bias_radps=window.gyro_radps.mean(axis=0), accel_bias_mps2=accel_bias)
    velocity, gyro = settings.initial_velocity_sigma_mps**2, settings.initial_gyro_bias_sigma_radps**2
    accel = settings.initial_accel_bias_sigma_mps2**2
    covariance = np.diag([0.0] * 3 + [velocity] * 3 + [1e-8] * 3 + [gyro] * 3 + [accel] * 3)
    # tilt and bias errors are one: R (a_m - ba) must keep pointing up, so r_xy follows from R dba
    tilt_from_force = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) / GRAVITY_MPS2
    by_bias = tilt_from_force @ rotation
    tilt = settings.initial_tilt_sigma_rad**2
    covariance[0:3, 0:3] = accel * by_bias @ by_bias.T + np.diag([tilt, tilt, 1e-8])
    covariance[0:3, 12:15] = accel * by_bias
    covariance[12:15, 0:3] = covariance[0:3, 12:15].T
    return InitialState(state, covariance, stamp_ns)
