"""How the filter begins: from a steady IMU, or in motion from visual odometry aligned to the IMU."""

from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array, rotation_between_vectors, skew, so3_exp, so3_log
from fleetmap.inertial import Preintegrated, preintegrate
from fleetmap.odometry.filter.msckf import GRAVITY_MPS2, NavState
from fleetmap.odometry.init import static_initialization_kernels
from fleetmap.odometry.settings import FilterSettings, StartSettings
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples, Trajectory

_MAX_LOOK_BACK_S = 20.0


@dataclass(frozen=True, slots=True)
class Start:
    """A first state with covariance (15, 15) in the filter's error, valid at stamp_ns.

    odom_from_old (4, 4) turns earlier transforms.
    """

    state: NavState
    covariance: Array
    stamp_ns: int
    odom_from_old: Array


def static_initialization(
    imu: ImuSamples, until_ns: int, settings: StartSettings, filter_settings: FilterSettings
) -> Start | None:
    """The state at the end of the latest steady window before `until_ns`; None where the IMU was never steady."""
    window_ns = int(settings.steady_window_s * 1e9)
    if not len(imu):
        return None
    first_ns = max(int(imu.stamps_ns[0]), until_ns - int(_MAX_LOOK_BACK_S * 1e9))
    end_ns = static_initialization_kernels.latest_steady(
        imu.stamps_ns, imu.gyro_radps, imu.accel_mps2, first_ns, until_ns, window_ns, _limits(settings)
    )
    if end_ns < first_ns:
        return None
    return _steady_state(imu.between(end_ns - window_ns, end_ns), end_ns, filter_settings)


def is_steady(window: ImuSamples, settings: StartSettings) -> bool:
    """Whether the means of tenths of the window agree: vibration averages out, motion that matters does not.

    Standing still and rolling at constant speed look alike here; gravity can be read in both, so the speed stays open.
    """
    return static_initialization_kernels.is_steady(window.gyro_radps, window.accel_mps2, _limits(settings))


def _limits(settings: StartSettings) -> Array:
    return np.array(
        [
            settings.steady_gyro_sigma_radps, settings.steady_accel_sigma_mps2, settings.steady_gyro_mean_radps, GRAVITY_MPS2,
            settings.max_gravity_error_mps2,
        ]
    )  # fmt: skip


def _steady_state(window: ImuSamples, stamp_ns: int, settings: FilterSettings) -> Start:
    force = window.accel_mps2.mean(axis=0)
    rotation = rotation_between_vectors(force, np.array([0.0, 0.0, 1.0]))
    state = NavState(rotation=rotation, gyro_bias_radps=window.gyro_radps.mean(axis=0))
    # the accelerometer's bias along gravity shows in its size; across gravity it hides in the tilt
    up_body = force / np.linalg.norm(force)
    state.accel_bias_mps2 = 0.5 * (np.linalg.norm(force) - GRAVITY_MPS2) * up_body
    covariance = np.diag(
        [0.0] * 3
        + [settings.initial_velocity_sigma_mps**2] * 3
        + [1e-8] * 3
        + [settings.initial_gyro_bias_sigma_radps**2] * 3
        + [settings.initial_accel_bias_sigma_mps2**2] * 3
    )
    # tilt and bias errors are one: R (a_m - ba) must keep pointing up, so r_xy follows from R dba
    link = np.zeros((3, 3))
    link[0, 1], link[1, 0] = -1.0 / GRAVITY_MPS2, 1.0 / GRAVITY_MPS2
    by_bias = link @ rotation
    sigma2 = settings.initial_accel_bias_sigma_mps2**2
    covariance[0:3, 0:3] = sigma2 * by_bias @ by_bias.T + np.diag([settings.initial_tilt_sigma_rad**2] * 2 + [1e-8])
    covariance[0:3, 12:15] = sigma2 * by_bias
    covariance[12:15, 0:3] = covariance[0:3, 12:15].T
    return Start(state, covariance, stamp_ns, np.eye(4))


def dynamic_initialization(
    vision: Trajectory, imu: ImuSamples, noise: ImuNoise, settings: StartSettings, filter_settings: FilterSettings
) -> Start | None:
    """Aligns visual odometry (metric, body transforms in any frame) with the IMU.

    Solves for gyro bias, gravity, velocity and accelerometer bias. None where the alignment does not give gravity its
    size. Source: Mur-Artal and Tardos 2017 (alignment), Qin 2018 (gravity on a sphere).
    """
    stamps, bodies = vision.stamps_ns, vision.frame_from_body
    count = len(stamps)
    gyro_bias = np.zeros(3)
    for _ in range(2):
        gyro_bias = gyro_bias + _gyro_bias_step(vision, imu, noise, gyro_bias)
    terms = [
        preintegrate(imu, int(stamps[k]), int(stamps[k + 1]), gyro_bias, np.zeros(3), noise) for k in range(count - 1)
    ]
    gravity = _free_gravity(bodies, terms)
    if gravity is None or abs(np.linalg.norm(gravity) - GRAVITY_MPS2) > settings.max_gravity_error_mps2 * 2:
        return None
    direction = gravity / np.linalg.norm(gravity)
    accel_bias = np.zeros(3)
    for _ in range(4):
        basis = _tangent(direction)
        solution, covariance = _sphere_step(
            bodies, terms, direction, basis, accel_bias, filter_settings.initial_accel_bias_sigma_mps2
        )
        turn = basis @ solution[:2]
        direction = so3_exp(np.cross(direction, turn)) @ direction
        accel_bias = accel_bias + solution[2:5]
    velocity = solution[5 + 3 * (count - 1) : 5 + 3 * count]
    if np.linalg.norm(accel_bias) > 6 * filter_settings.initial_accel_bias_sigma_mps2:
        return None
    return _motion_state(vision, direction, velocity, gyro_bias, accel_bias, basis, covariance, filter_settings)


def _gyro_bias_step(vision: Trajectory, imu: ImuSamples, noise: ImuNoise, gyro_bias: Array) -> Array:
    hessian, gradient = np.zeros((3, 3)), np.zeros(3)
    for k in range(len(vision) - 1):
        term = preintegrate(imu, int(vision.stamps_ns[k]), int(vision.stamps_ns[k + 1]), gyro_bias, np.zeros(3), noise)
        seen = vision.frame_from_body[k, :3, :3].T @ vision.frame_from_body[k + 1, :3, :3]
        error = so3_log(term.delta_rotation.T @ seen)
        hessian += term.d_rotation_d_gyro.T @ term.d_rotation_d_gyro
        gradient += term.d_rotation_d_gyro.T @ error
    return np.asarray(np.linalg.solve(hessian + 1e-12 * np.eye(3), gradient))


def _free_gravity(bodies: Array, terms: list[Preintegrated]) -> Array | None:
    """Gravity (3,) with its size free, by linear least squares over all velocities."""
    count = len(bodies)
    rows, right = np.zeros((6 * (count - 1), 3 + 3 * count)), np.zeros(6 * (count - 1))
    for k, term in enumerate(terms):
        dt, rotation = term.dt_s, bodies[k, :3, :3]
        at = 6 * k
        rows[at : at + 3, 0:3] = 0.5 * dt * dt * np.eye(3)
        rows[at : at + 3, 3 + 3 * k : 6 + 3 * k] = dt * np.eye(3)
        right[at : at + 3] = bodies[k + 1, :3, 3] - bodies[k, :3, 3] - rotation @ term.delta_position_m
        rows[at + 3 : at + 6, 0:3] = dt * np.eye(3)
        rows[at + 3 : at + 6, 3 + 3 * k : 6 + 3 * k] = np.eye(3)
        rows[at + 3 : at + 6, 6 + 3 * k : 9 + 3 * k] = -np.eye(3)
        right[at + 3 : at + 6] = -rotation @ term.delta_velocity_mps
    weights = np.tile([200.0] * 3 + [20.0] * 3, count - 1)
    solution, _, rank, _ = np.linalg.lstsq(rows * weights[:, None], right * weights, rcond=None)
    return np.asarray(solution[:3]) if rank == rows.shape[1] else None


def _sphere_step(
    bodies: Array, terms: list[Preintegrated], direction: Array, basis: Array, accel_bias: Array, bias_sigma: float
) -> tuple[Array, Array]:
    """One Gauss-Newton step; solution and covariance.

    Order: gravity's direction (2), accelerometer bias (3), velocities (3 each).
    """
    count = len(bodies)
    size = 5 + 3 * count
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    gravity = GRAVITY_MPS2 * direction
    position_sigma, velocity_sigma = 0.004, 0.04
    for k, term in enumerate(terms):
        dt, rotation = term.dt_s, bodies[k, :3, :3]
        rows = np.zeros((6, size))
        rows[0:3, 0:2] = 0.5 * dt * dt * GRAVITY_MPS2 * basis
        rows[0:3, 2:5] = rotation @ term.d_position_d_accel
        rows[0:3, 5 + 3 * k : 8 + 3 * k] = dt * np.eye(3)
        rows[3:6, 0:2] = dt * GRAVITY_MPS2 * basis
        rows[3:6, 2:5] = rotation @ term.d_velocity_d_accel
        rows[3:6, 5 + 3 * k : 8 + 3 * k] = np.eye(3)
        rows[3:6, 8 + 3 * k : 11 + 3 * k] = -np.eye(3)
        moved = term.delta_position_m + term.d_position_d_accel @ accel_bias
        gained = term.delta_velocity_mps + term.d_velocity_d_accel @ accel_bias
        right = np.concatenate(
            [
                bodies[k + 1, :3, 3] - bodies[k, :3, 3] - 0.5 * dt * dt * gravity - rotation @ moved,
                -dt * gravity - rotation @ gained,
            ]
        )
        weights = np.array([position_sigma**-2] * 3 + [velocity_sigma**-2] * 3)
        hessian += rows.T @ (weights[:, None] * rows)
        gradient += rows.T @ (weights * right)
    hessian[2:5, 2:5] += np.eye(3) / bias_sigma**2
    gradient[2:5] -= accel_bias / bias_sigma**2
    covariance = np.linalg.inv(hessian + 1e-9 * np.eye(size))
    return np.asarray(covariance @ gradient), np.asarray(covariance)


def _tangent(direction: Array) -> Array:
    """(3, 2) orthonormal basis across a direction."""
    other = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(direction, other)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)], axis=1)


def _motion_state(
    vision: Trajectory,
    direction: Array,
    velocity: Array,
    gyro_bias: Array,
    accel_bias: Array,
    basis: Array,
    solved: Array,
    settings: FilterSettings,
) -> Start:
    """The filter's first state and covariance, in the old frame turned so that gravity points down."""
    turn = rotation_between_vectors(direction, np.array([0.0, 0.0, -1.0]))
    odom_from_old = np.eye(4)
    odom_from_old[:3, :3] = turn
    last = odom_from_old @ vision.frame_from_body[-1]
    state = NavState(last[:3, :3].copy(), turn @ velocity, last[:3, 3].copy(), gyro_bias, accel_bias)
    size = len(solved)
    # order: gravity direction, accelerometer bias, last velocity, then what vision and gyro leave open
    joint = np.zeros((8, size))
    joint[:5, :5] = np.eye(5)
    joint[5:8, size - 3 :] = np.eye(3)
    solved = joint @ solved @ joint.T
    to_error = np.zeros((15, 8))
    # gravity known as d, truly d + B x: the frame must turn by r with r x d_odom = -T B x, so r = -d_odom x (T B x)
    down = np.array([0.0, 0.0, -1.0])
    to_error[0:3, 0:2] = -skew(down) @ turn @ basis
    to_error[3:6, 5:8] = turn
    to_error[12:15, 2:5] = np.eye(3)
    to_error[3:6] += skew(state.velocity_mps) @ to_error[0:3]
    to_error[6:9] = skew(state.position_m) @ to_error[0:3]
    covariance = 4.0 * to_error @ solved @ to_error.T
    floor = np.diag([1e-6] * 3 + [1e-4] * 3 + [1e-6] * 3 + [4e-6] * 3 + [1e-4] * 3)
    return Start(state, covariance + floor, int(vision.stamps_ns[-1]), odom_from_old)
