"""IMU preintegration between two moments: relative motion, its covariance, and the derivatives of both by the biases.

Convention, in a gravity-aligned frame: R_j = R_i dR, v_j = v_i + g dt + R_i dv and
p_j = p_i + v_i dt + g dt^2 / 2 + R_i dp.
Errors are those of the increments: rotation on the right (dR Exp(error)), then velocity, position and the two biases.
"""

from dataclasses import dataclass

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples, Stamps

GRAVITY_MPS2 = 9.81
GRAVITY_MAP = np.array([0.0, 0.0, -GRAVITY_MPS2])


@dataclass(frozen=True)
class Preintegrated:
    """Relative motion of the body between two stamps as measured by the IMU, in body axes at `start_ns`.

    delta_rotation (3, 3), delta_velocity_mps (3,), delta_position_m (3,): without gravity and initial velocity.
    cov (15, 15): rotation, velocity, position, gyro bias, accelerometer bias; the last six are the biases' walk since
    `start_ns`, with its correlation to the motion. d_*_d_* (3, 3): derivatives at the linearisation point
    gyro_bias_radps (3,), accel_bias_mps2 (3,), rotation as a right perturbation. max_gap_s: longest stretch without a
    sample, one sample period in a healthy recording. The core's adjustment reads the fields in this order.
    """

    start_ns: int
    end_ns: int
    dt_s: float
    delta_rotation: Array
    delta_velocity_mps: Array
    delta_position_m: Array
    cov: Array
    d_rotation_d_gyro: Array
    d_velocity_d_gyro: Array
    d_velocity_d_accel: Array
    d_position_d_gyro: Array
    d_position_d_accel: Array
    gyro_bias_radps: Array
    accel_bias_mps2: Array
    max_gap_s: float


def preintegrate(
    imu: ImuSamples, start_ns: int, end_ns: int, gyro_bias: Array, accel_bias: Array, noise: ImuNoise
) -> Preintegrated:
    """Integrate the motion from `start_ns` to `end_ns`, biases (3,) taken as constant.

    Samples are interpolated at both ends and held beyond the data. If more than a few sample periods are missing,
    `max_gap_s` shows it and the covariance grows by the largest plausible motion; no data at all gives zero increments
    with a covariance to match. Source: Forster et al. 2017, On-manifold preintegration for real-time VIO.
    """
    gyro_bias, accel_bias = np.array(gyro_bias, np.float64), np.array(accel_bias, np.float64)
    rotation, velocity, position, by_bias, cov, max_gap_s = core.preintegrate(
        *_arrays(imu), int(start_ns), int(end_ns), gyro_bias, accel_bias, densities(noise)
    )
    moments = int(start_ns), int(end_ns), (end_ns - start_ns) * 1e-9
    derivatives = by_bias[0], by_bias[1], by_bias[2], by_bias[3], by_bias[4]
    return Preintegrated(*moments, rotation, velocity, position, cov, *derivatives, gyro_bias, accel_bias, max_gap_s)


def imu_intervals(imu: ImuSamples, start_ns: int, end_ns: int) -> tuple[Array, Array, Array]:
    """Intervals (N,) seconds between start and end with gyro and accel (N, 3) at their middles, linearly interpolated.

    Beyond the first and last sample the nearest one is held.
    """
    return core.imu_intervals(*_arrays(imu), int(start_ns), int(end_ns))


def densities(noise: ImuNoise) -> tuple[float, float, float, float]:
    """Noise densities in the core's order: gyro and accelerometer, and the random walks of their biases."""
    walks = noise.gyro_walk_radps2_rthz, noise.accel_walk_mps3_rthz
    return noise.gyro_noise_radps_rthz, noise.accel_noise_mps2_rthz, *walks


def _arrays(imu: ImuSamples) -> tuple[Stamps, Array, Array]:
    rates_and_forces = np.ascontiguousarray(imu.gyro_radps), np.ascontiguousarray(imu.accel_mps2)
    return np.ascontiguousarray(imu.stamps_ns), *rates_and_forces
