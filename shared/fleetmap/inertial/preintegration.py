"""Inertial samples between two moments, summed up once: relative motion, its uncertainty, how both follow the biases.

Convention, in a gravity-aligned frame: R_j = R_i dR, v_j = v_i + g dt + R_i dv and
p_j = p_i + v_i dt + g dt^2 / 2 + R_i dp.
Errors are those of the increments: rotation on the right (dR Exp(error)), then velocity, position and the two biases.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.inertial.preintegration_kernels import cut_samples, integrate_samples, intervals
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples

GRAVITY_MPS2 = 9.81
GRAVITY_MAP = np.array([0.0, 0.0, -GRAVITY_MPS2])

GAP_PERIODS = 3.0  # a longer distance between samples counts as missing data
GAP_GYRO_RADPS = 0.5  # how far the true rate may be from the interpolated one where samples are missing
GAP_ACCEL_MPS2 = 2.0
BLIND_GYRO_RADPS = 1.0  # the same with no sample at all
BLIND_ACCEL_MPS2 = 20.0
DEFAULT_PERIOD_S = 0.01


@dataclass(frozen=True)
class Preintegrated:
    """Relative motion of the body between two stamps as the IMU felt it, in body axes at `start_ns`.

    delta_rotation (3, 3), delta_velocity_mps (3,), delta_position_m (3,): without gravity and initial velocity.
    cov (15, 15): rotation, velocity, position, gyro bias, accelerometer bias; the last six are the biases' walk since
    `start_ns`, with its correlation to the motion. d_*_d_* (3, 3): derivatives at the linearisation point
    gyro_bias_radps (3,), accel_bias_mps2 (3,), rotation as a right perturbation. max_gap_s: longest stretch without a
    sample, one sample period in a healthy recording.
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
    """The motion from `start_ns` to `end_ns`, biases (3,) taken as constant.

    Samples are interpolated at both ends and held beyond the data. Where more than a few sample periods are missing,
    `max_gap_s` says so and the covariance grows by what an unseen motion can be; no data at all gives zero increments
    with a covariance to match. Source: Forster et al. 2017, On-manifold preintegration for real-time VIO.
    """
    assert end_ns >= start_ns
    rotation, velocity, position = np.eye(3), np.zeros(3), np.zeros(3)
    jacobians, cov = np.zeros((5, 3, 3)), np.zeros((15, 15))
    samples = imu.stamps_ns, np.ascontiguousarray(imu.gyro_radps), np.ascontiguousarray(imu.accel_mps2)
    times_s, gyro, accel, holes_s, period_s = cut_samples(*samples, start_ns, end_ns)
    blind = len(imu) == 0
    if not blind:
        gyro, accel = gyro - gyro_bias, accel - accel_bias
    missing = holes_s > GAP_PERIODS * (DEFAULT_PERIOD_S if np.isnan(period_s) else period_s)
    variances = _step_variances(np.diff(times_s), missing, blind, noise)
    integrate_samples(times_s, gyro, accel, variances, rotation, velocity, position, jacobians, cov)
    return Preintegrated(
        start_ns=int(start_ns),
        end_ns=int(end_ns),
        dt_s=(end_ns - start_ns) * 1e-9,
        delta_rotation=rotation,
        delta_velocity_mps=velocity,
        delta_position_m=position,
        cov=cov,
        d_rotation_d_gyro=jacobians[0],
        d_velocity_d_gyro=jacobians[1],
        d_velocity_d_accel=jacobians[2],
        d_position_d_gyro=jacobians[3],
        d_position_d_accel=jacobians[4],
        gyro_bias_radps=np.array(gyro_bias, dtype=np.float64),
        accel_bias_mps2=np.array(accel_bias, dtype=np.float64),
        max_gap_s=float(holes_s.max(initial=0.0)),
    )


def _step_variances(dt_s: Array, missing: NDArray[np.bool_], blind: bool, noise: ImuNoise) -> Array:
    """(N, 4) variances of mean rate and acceleration in each step and of the biases' walk across it."""
    step = np.maximum(dt_s, 1e-12)
    gyro_gap, accel_gap = (BLIND_GYRO_RADPS, BLIND_ACCEL_MPS2) if blind else (GAP_GYRO_RADPS, GAP_ACCEL_MPS2)
    return np.stack(
        [
            noise.gyro_noise_radps_rthz**2 / step + np.where(missing, gyro_gap**2, 0.0),
            noise.accel_noise_mps2_rthz**2 / step + np.where(missing, accel_gap**2, 0.0),
            noise.gyro_walk_radps2_rthz**2 * dt_s,
            noise.accel_walk_mps3_rthz**2 * dt_s,
        ],
        axis=1,
    )


def imu_intervals(imu: ImuSamples, start_ns: int, end_ns: int) -> tuple[Array, Array, Array]:
    """Intervals (N,) seconds between start and end with gyro and accel (N, 3) at their middles, linearly interpolated.

    Beyond the first and last sample the nearest one is held.
    """
    samples = imu.stamps_ns, np.ascontiguousarray(imu.gyro_radps), np.ascontiguousarray(imu.accel_mps2)
    return intervals(*samples, int(start_ns), int(end_ns))
