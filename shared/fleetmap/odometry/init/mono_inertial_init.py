"""The start of one camera with an IMU in motion: how long its way was, which way is down, how fast it goes."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fleetmap.geometry import Array, so3_exp
from fleetmap.inertial import Preintegrated, preintegrate
from fleetmap.odometry.filter.msckf import GRAVITY_MPS2
from fleetmap.odometry.init.filter_initialization import Start, _gyro_bias_step, _motion_state, _tangent
from fleetmap.odometry.settings import FilterSettings, MonocularSettings, StartSettings
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples, Trajectory

_POSITION_SIGMA_M, _VELOCITY_SIGMA_MPS = 0.006, 0.04


@dataclass(frozen=True, slots=True)
class MonoInertialStart:
    """A start, the metres in one unit of vision, and the standard deviation of that as a share of it."""

    start: Start
    metres_per_unit: float
    scale_sigma_share: float


def mono_inertial_initialization(
    vision: Trajectory, imu: ImuSamples, noise: ImuNoise, body_from_cam: Array, settings: MonocularSettings,
    start_settings: StartSettings, filter_settings: FilterSettings,
) -> MonoInertialStart | None:  # fmt: skip
    """Aligns a camera's way up to scale with the IMU's.

    vision holds vision_from_cam at IMU stamps. None where the motion does not show the scale to within the settings' share, or
    where what fits is no gravity. Unknowns: direction of gravity, accelerometer bias, scale, velocities. Source: Mur-Artal and
    Tardos 2017, Qin 2018 (gravity on a sphere).
    """
    rotations = vision.frame_from_body[:, :3, :3] @ body_from_cam[:3, :3].T  # vision_from_body
    turned = np.tile(np.eye(4), (len(vision), 1, 1))
    turned[:, :3, :3] = rotations
    bodies = Trajectory(vision.stamps_ns, turned)
    gyro_bias = np.zeros(3)
    for _ in range(2):
        gyro_bias = gyro_bias + _gyro_bias_step(bodies, imu, noise, gyro_bias)
    stamps = [int(s) for s in vision.stamps_ns]
    terms = [preintegrate(imu, a, b, gyro_bias, np.zeros(3), noise) for a, b in pairwise(stamps)]
    way = _Way(rotations, vision.positions_m, -rotations @ body_from_cam[:3, 3], terms)
    gravity = _free_gravity(way)
    if gravity is None or abs(np.linalg.norm(gravity) - GRAVITY_MPS2) > 3 * start_settings.max_gravity_error_mps2:
        return None
    direction, accel_bias = gravity / np.linalg.norm(gravity), np.zeros(3)
    for _ in range(5):
        basis = _tangent(direction)
        solution, covariance = _sphere_step(
            way, direction, basis, accel_bias, filter_settings.initial_accel_bias_sigma_mps2
        )
        direction = so3_exp(np.cross(direction, basis @ solution[:2])) @ direction
        accel_bias = accel_bias + solution[2:5]
    scale, sigma = float(solution[5]), float(np.sqrt(covariance[5, 5]))
    if (
        scale <= 0
        or sigma > settings.max_scale_sigma_share * scale
        or np.linalg.norm(accel_bias) > 6 * filter_settings.initial_accel_bias_sigma_mps2
    ):
        return None
    turned[:, :3, 3] = scale * way.cameras + way.levers
    start = _motion_state(bodies, direction, solution[-3:], gyro_bias, accel_bias, basis, covariance, filter_settings)
    return MonoInertialStart(start, scale, sigma / scale)


@dataclass(frozen=True)
class _Way:
    """vision_from_body rotations (K, 3, 3); cameras (K, 3) up to scale; levers (K, 3) metres from camera to body; K - 1 increments."""

    rotations: Array
    cameras: Array
    levers: Array
    terms: list[Preintegrated]


def _free_gravity(way: _Way) -> Array | None:
    """Gravity (3,) with its size free, by linear least squares over scale and all velocities."""
    count = len(way.cameras)
    rows, right = np.zeros((6 * (count - 1), 4 + 3 * count)), np.zeros(6 * (count - 1))
    for k, term in enumerate(way.terms):
        dt, rotation, at, v = term.dt_s, way.rotations[k], 6 * k, 4 + 3 * k
        rows[at : at + 3, 0:3] = 0.5 * dt * dt * np.eye(3)
        rows[at : at + 3, 3] = -(way.cameras[k + 1] - way.cameras[k])
        rows[at : at + 3, v : v + 3] = dt * np.eye(3)
        right[at : at + 3] = way.levers[k + 1] - way.levers[k] - rotation @ term.delta_position_m
        rows[at + 3 : at + 6, 0:3] = dt * np.eye(3)
        rows[at + 3 : at + 6, v : v + 3] = np.eye(3)
        rows[at + 3 : at + 6, v + 3 : v + 6] = -np.eye(3)
        right[at + 3 : at + 6] = -rotation @ term.delta_velocity_mps
    weights = np.tile([1 / _POSITION_SIGMA_M] * 3 + [1 / _VELOCITY_SIGMA_MPS] * 3, count - 1)
    solution, _, rank, _ = np.linalg.lstsq(rows * weights[:, None], right * weights, rcond=None)
    return np.asarray(solution[:3]) if rank == rows.shape[1] else None


def _sphere_step(
    way: _Way, direction: Array, basis: Array, accel_bias: Array, bias_sigma: float
) -> tuple[Array, Array]:
    """One Gauss-Newton step with gravity's size known: solution and covariance, which residuals beyond the sigmas widen.

    Order: gravity's direction (2), accelerometer bias (3), scale, velocities (3 each).
    """
    count = len(way.cameras)
    size = 6 + 3 * count
    hessian, gradient, squares = np.zeros((size, size)), np.zeros(size), 0.0
    gravity = GRAVITY_MPS2 * direction
    weights = np.array([_POSITION_SIGMA_M**-2] * 3 + [_VELOCITY_SIGMA_MPS**-2] * 3)
    for k, term in enumerate(way.terms):
        dt, rotation, v = term.dt_s, way.rotations[k], 6 + 3 * k
        rows = np.zeros((6, size))
        rows[0:3, 0:2] = 0.5 * dt * dt * GRAVITY_MPS2 * basis
        rows[0:3, 2:5] = rotation @ term.d_position_d_accel
        rows[0:3, 5] = -(way.cameras[k + 1] - way.cameras[k])
        rows[0:3, v : v + 3] = dt * np.eye(3)
        rows[3:6, 0:2] = dt * GRAVITY_MPS2 * basis
        rows[3:6, 2:5] = rotation @ term.d_velocity_d_accel
        rows[3:6, v : v + 3] = np.eye(3)
        rows[3:6, v + 3 : v + 6] = -np.eye(3)
        moved = term.delta_position_m + term.d_position_d_accel @ accel_bias
        gained = term.delta_velocity_mps + term.d_velocity_d_accel @ accel_bias
        right = np.concatenate(
            [
                way.levers[k + 1] - way.levers[k] - 0.5 * dt * dt * gravity - rotation @ moved,
                -dt * gravity - rotation @ gained,
            ]
        )
        hessian += rows.T @ (weights[:, None] * rows)
        gradient += rows.T @ (weights * right)
        squares += float(right @ (weights * right))
    hessian[2:5, 2:5] += np.eye(3) / bias_sigma**2
    gradient[2:5] -= accel_bias / bias_sigma**2
    covariance = np.linalg.inv(hessian + 1e-9 * np.eye(size))
    solution = covariance @ gradient
    left = max(squares - float(gradient @ solution), 0.0) / max(6 * (count - 1) - size + 3, 1)
    return np.asarray(solution), np.asarray(max(left, 1.0) * covariance)
