"""The right-invariant multi-state constraint filter, `core.Filter`, with its state, and the settings and records of Python."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array
from fleetmap.inertial import GRAVITY_MPS2, densities
from fleetmap.odometry.settings import FilterSettings
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import ImuSamples, WheelSample


class NavState(NamedTuple):
    """Nominal state in `odom`."""

    rotation: Array = np.eye(3)
    velocity_mps: Array = np.zeros(3)
    position_m: Array = np.zeros(3)
    gyro_bias_radps: Array = np.zeros(3)
    accel_bias_mps2: Array = np.zeros(3)


@dataclass(frozen=True, slots=True)
class InitialState:
    """A first state with covariance (15, 15) in the filter's error, valid at stamp_ns."""

    state: NavState
    covariance: Array
    stamp_ns: int


class InvariantFilter(core.Filter):
    """Keeps the current state and a window of past body transforms (clones) with their joint covariance.

    Without an IMU the state moves by `predict_random_walk` instead of `propagate`; velocity and biases are then unused. `covariance`
    weighs and gates measurements; `true_error_cov` is reported, see `core.Filter`.
    """

    def __init__(
        self,
        state: NavState,
        nav_covariance: Array,
        settings: FilterSettings,
        cameras: Sequence[tuple[StereoCamera, Array]],
        true_error_cov: Array | None = None,
    ) -> None:
        """nav_covariance (15, 15) in the filter's error; true_error_cov: covariance of the true error, if different.

        cameras: each with its body_from_cam (4, 4).
        """
        true_error_cov = nav_covariance if true_error_cov is None else true_error_cov
        quantile = NormalDist().inv_cdf(settings.chi_square_share)
        rig = (
            np.array([camera.lens for camera, _ in cameras]),
            np.array([body_from_cam for _, body_from_cam in cameras]),
        )
        begun = NavState(*(np.array(values, np.float64, order="C") for values in state))
        super().__init__(*begun, nav_covariance, true_error_cov, *rig, settings, quantile, GRAVITY_MPS2)

    @property
    def state(self) -> NavState:
        """A copy of the current state."""
        return NavState(*self.nav_state())

    def propagate(
        self, imu: ImuSamples, start_ns: int, end_ns: int, noise: ImuNoise, true_noise: ImuNoise | None = None
    ) -> Array:
        """Move the state from start_ns to end_ns; return the last angular rate (3,), bias removed.

        noise weighs the prediction; true_noise, if different, goes into true_error_cov.
        """
        judged = densities(noise), densities(true_noise or noise)
        return self.predict_inertial(imu.stamps_ns, imu.gyro_radps, imu.accel_mps2, int(start_ns), int(end_ns), *judged)

    def correct_by_wheel_sample(
        self, sample: WheelSample, gyro_radps: Array, base_from_body: Array, gate: float
    ) -> float:
        """As `correct_by_wheels`; gyro_radps (3,): measured at the same time."""
        speeds = sample.velocity_base_mps, float(sample.yaw_rate_radps), sample.sigma_mps, sample.sigma_radps
        return self.correct_by_wheels(*speeds, gyro_radps, base_from_body, gate)
