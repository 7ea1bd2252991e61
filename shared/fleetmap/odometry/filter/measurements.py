"""Linear measurements of the filter's error: zero velocity and wheel odometry."""

from dataclasses import dataclass

import numpy as np

from fleetmap.geometry import Array, skew
from fleetmap.odometry.filter import state_kernels
from fleetmap.odometry.filter.nav_state import NavState
from fleetmap.odometry.settings import FilterSettings
from fleetmap.sensors.samples import WheelSample

CONSIDERED = (
    4  # considered and never estimated: disparity offset, depth scale, scales of the wheels' speed and yaw rate
)
_ERRORS = 15  # of the state: rotation, velocity, position, gyro bias, accelerometer bias


@dataclass(frozen=True, slots=True)
class LinearMeasurement:
    """residual (n,) = jacobian (n, m) @ error + noise (n, n), for the first m errors of the filter.

    The covariances: noise weighs the measurement; true_noise, where it differs, and by_considered (n, 4), derivatives by
    the considered errors, go into the true error's covariance.
    """

    jacobian: Array
    residual: Array
    noise: Array
    true_noise: Array | None = None
    by_considered: Array | None = None


def zero_velocity(
    state: NavState, gyro_mean_radps: Array, gyro_sigma_radps: float, settings: FilterSettings
) -> LinearMeasurement:
    """The body neither moves nor turns: velocity zero, the gyro shows its bias alone (ZUPT).

    gyro_mean_radps (3,) over the time since the last frame, known to gyro_sigma_radps.
    """
    jacobian = np.zeros((6, _ERRORS))
    jacobian[:3, :3], jacobian[:3, 3:6] = -skew(state.velocity_mps), np.eye(3)
    jacobian[3:, 9:12] = np.eye(3)
    residual = np.concatenate([-state.velocity_mps, gyro_mean_radps - state.gyro_bias_radps])
    sigmas = np.array([settings.still_sigma_mps] * 3 + [gyro_sigma_radps] * 3)
    return LinearMeasurement(jacobian, residual, np.diag(sigmas**2))


def wheel_odometry(
    state: NavState, sample: WheelSample, gyro_radps: Array, base_from_body: Array, settings: FilterSettings
) -> LinearMeasurement:
    """The motion of `base` by its wheels: forward speed, no other, and yaw rate. gyro_radps (3,): measured at the same time."""
    jacobian, by_considered = np.zeros((4, _ERRORS)), np.zeros((4, CONSIDERED))
    measured = sample.velocity_base_mps, float(sample.yaw_rate_radps), gyro_radps, base_from_body
    residual = state_kernels.wheel_rows(state.arrays, *measured, jacobian, by_considered)
    sigmas = np.array([sample.sigma_mps, settings.wheel_slip_mps, settings.wheel_slip_mps, sample.sigma_radps])
    weighed = np.diag((settings.wheel_sigma_scale * sigmas) ** 2)
    return LinearMeasurement(jacobian, residual, weighed, np.diag(sigmas**2), by_considered)
