"""The filter's state and window: corrections, clones that come and go, and the motion between them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel
from fleetmap.numerics.linear_kernels import exp_so3, matmul, rotate, skew
from fleetmap.numerics.transform_kernels import (
    adjoint,
    copy_into,
    earlier_from_later,
    inverse,
    transform_of,
)
from fleetmap.odometry.filter.covariance_kernels import with_clone, without_errors


class State(NamedTuple):
    """Rotation (3, 3), velocity, position, gyro bias and accelerometer bias (3,)."""

    rotation: Array
    velocity: Array
    position: Array
    gyro_bias: Array
    accel_bias: Array


class Window(NamedTuple):
    """Rotations (M, 3, 3) and positions (M, 3) of M clones; the filter's two covariances, see `InvariantFilter`."""

    rotations: Array
    positions: Array
    covariance: Array
    true_error_cov: Array


@kernel
def turn_clones(rotations: Array, positions: Array, errors: Array) -> None:
    """Applies errors (6 M,) to the body transforms of M clones, in place."""
    for m in range(len(positions)):
        turn = exp_so3(errors[6 * m : 6 * m + 3])
        rotations[m] = matmul(turn, rotations[m])
        positions[m] = rotate(turn, positions[m]) + errors[6 * m + 3 : 6 * m + 6]


@kernel
def apply_error(state: State, rotations: Array, positions: Array, error: Array) -> None:
    """Corrects state and clones in place by an error (16 + 6 M,): state, time offset, clones."""
    turn = exp_so3(error[0:3])
    velocity, position = rotate(turn, state.velocity), rotate(turn, state.position)
    copy_into(state.rotation, matmul(turn, state.rotation))
    for a in range(3):
        state.velocity[a] = velocity[a] + error[3 + a]
        state.position[a] = position[a] + error[6 + a]
        state.gyro_bias[a] += error[9 + a]
        state.accel_bias[a] += error[12 + a]
    turn_clones(rotations, positions, error[16:])


@kernel
def rows_of(held: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n,) where each of the wanted ids (n,) stands among those that are held (M,), all of which are."""
    out = np.zeros(len(wanted), np.int64)
    for n in range(len(wanted)):
        for row in range(len(held)):
            if held[row] == wanted[n]:
                out[n] = row
    return out


@kernel
def add_clone(window: Window, state: State, rate_body: Array, considered: int, offset: int) -> Window:
    """The window with the state's body as its newest clone; rate_body (3,) ties it to the time offset, error number `offset`."""
    count = len(window.positions)
    rotations, positions = np.empty((count + 1, 3, 3)), np.empty((count + 1, 3))
    for m in range(count):
        copy_into(rotations[m], window.rotations[m])
    copy_into(positions, window.positions)
    copy_into(rotations[count], state.rotation)
    turn, by_offset = rotate(state.rotation, rate_body), np.empty(6)
    moved = rotate(skew(state.position), turn)
    for a in range(3):
        positions[count, a] = state.position[a]
        by_offset[a], by_offset[3 + a] = turn[a], state.velocity[a] + moved[a]
    covariance = with_clone(window.covariance, 0, offset, by_offset)
    true_error_cov = with_clone(window.true_error_cov, considered, considered + offset, by_offset)
    return Window(rotations, positions, covariance, true_error_cov)


@kernel
def drop_clone(window: Window, index: int, considered: int, clones: int) -> Window:
    """The window without a clone; the first one's errors begin at number `clones`."""
    count, at = len(window.positions) - 1, clones + 6 * index
    rotations, positions = np.empty((count, 3, 3)), np.empty((count, 3))
    for m in range(count):
        old = m if m < index else m + 1
        copy_into(rotations[m], window.rotations[old])
        for a in range(3):
            positions[m, a] = window.positions[old, a]
    covariance, true_error_cov = window.covariance, window.true_error_cov
    return Window(rotations, positions, without_errors(covariance, at), without_errors(true_error_cov, considered + at))


@kernel
def cam_from_earlier(
    state: State, rotation: Array, position: Array, cam_from_body: Array, body_from_cam: Array
) -> Array:
    """(4, 4) from the camera of an earlier body, a rotation and a position, to that of the state."""
    body_from_earlier = matmul(
        matmul(cam_from_body, inverse(state.rotation, state.position)), transform_of(rotation, position)
    )
    return matmul(body_from_earlier, body_from_cam)


@kernel
def body_covariance(position: Array, true_error_cov: Array, considered: int) -> Array:
    """(6, 6) of rotation and position of the state, from that of its errors, which begin at number `considered`."""
    jacobian = np.zeros((6, 9))
    lever = skew(position)
    for a in range(3):
        jacobian[a, a] = jacobian[3 + a, 6 + a] = 1.0
        for b in range(3):
            jacobian[3 + a, b] = -lever[a, b]
    own = true_error_cov[considered : considered + 9, considered : considered + 9]
    return matmul(matmul(jacobian, own), jacobian.T)


@kernel
def motion_since(window: Window, index: int, errors: int) -> tuple[Array, Array]:
    """As `InvariantFilter.motion_since`; the first clone's errors begin at number `errors` of the second covariance."""
    newest, c = len(window.positions) - 1, window.true_error_cov
    at, end, difference = errors + 6 * index, errors + 6 * newest, np.empty((6, 6))
    for a in range(6):
        for b in range(6):
            both = c[end + a, end + b] + c[at + a, at + b]
            difference[a, b] = both - c[end + a, at + b] - c[at + a, end + b]
    carry = adjoint(inverse(window.rotations[index], window.positions[index]))
    earlier_from_now = earlier_from_later(window.rotations, window.positions, index, newest)
    return earlier_from_now, matmul(matmul(carry, difference), carry.T)


@kernel
def wheel_rows(
    state: State,
    velocity_base: Array,
    yaw_rate: float,
    gyro: Array,
    base_from_body: Array,
    jacobian: Array,
    by_considered: Array,
) -> Array:
    """Residual (4,) of `measurements.wheel_odometry`; fills jacobian (4, 15) and by_considered (4, 4), zero before."""
    turn, rate = np.empty((3, 3)), np.empty(3)
    copy_into(turn, base_from_body[:3, :3])
    for a in range(3):
        rate[a] = gyro[a] - state.gyro_bias[a]
    base_body = inverse(turn, base_from_body[:3, 3])[:3, 3]
    base_from_odom, turning = matmul(turn, state.rotation.T), rotate(turn, rate)
    driven, swung = rotate(base_from_odom, state.velocity), rotate(turn, rotate(skew(rate), base_body))
    # R^T v with the invariant error changes by R^T nu alone: turning the frame turns both
    copy_into(jacobian[:3, 3:6], base_from_odom)
    copy_into(jacobian[:3, 9:12], matmul(turn, skew(base_body)))
    residual = np.empty(4)
    for a in range(3):
        jacobian[3, 9 + a] = -turn[2, a]
        residual[a] = velocity_base[a] - (driven[a] + swung[a])
    by_considered[0, 2], by_considered[3, 3] = driven[0] + swung[0], turning[2]
    residual[3] = yaw_rate - turning[2]
    return residual
