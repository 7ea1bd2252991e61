"""Static initialization: gravity, tilt and gyro bias from a steady IMU."""

from collections.abc import Sequence

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array, rotation_between_vectors
from fleetmap.inertial import GRAVITY_MPS2
from fleetmap.odometry.filter.nav_state import InitialState, NavState
from fleetmap.odometry.settings import FilterSettings, OdometrySettings, StartSettings
from fleetmap.sensors.samples import ImuSamples

_MAX_LOOK_BACK_S = 20.0
_JUDGED_NS = 500_000_000


def static_initialization(imu: ImuSamples, until_ns: int, settings: OdometrySettings) -> InitialState | None:
    """State at the end of the latest steady window before `until_ns`; None if the IMU was never steady."""
    window_ns = int(settings.start.steady_window_s * 1e9)
    if not len(imu):
        return None
    first_ns = max(int(imu.stamps_ns[0]), until_ns - int(_MAX_LOOK_BACK_S * 1e9))
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
    state = NavState(rotation=rotation, gyro_bias_radps=window.gyro_radps.mean(axis=0))
    # the accelerometer's bias along gravity shows in its size; across gravity it hides in the tilt
    state.accel_bias_mps2 = 0.5 * (np.linalg.norm(force) - GRAVITY_MPS2) * (force / np.linalg.norm(force))
    velocity, gyro, accel = (
        sigma**2
        for sigma in (
            settings.initial_velocity_sigma_mps,
            settings.initial_gyro_bias_sigma_radps,
            settings.initial_accel_bias_sigma_mps2,
        )
    )
    covariance = np.diag([0.0] * 3 + [velocity] * 3 + [1e-8] * 3 + [gyro] * 3 + [accel] * 3)
    # tilt and bias errors are one: R (a_m - ba) must keep pointing up, so r_xy follows from R dba
    tilt_from_force = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) / GRAVITY_MPS2
    by_bias = tilt_from_force @ rotation
    tilt = settings.initial_tilt_sigma_rad**2
    covariance[0:3, 0:3] = accel * by_bias @ by_bias.T + np.diag([tilt, tilt, 1e-8])
    covariance[0:3, 12:15] = accel * by_bias
    covariance[12:15, 0:3] = covariance[0:3, 12:15].T
    return InitialState(state, covariance, stamp_ns)
