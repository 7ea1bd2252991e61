"""Inputs of a calibration estimate: keyframes, landmarks, inertial samples, wheels."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import AnyArray, Array
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import ImuSamples, WheelSample
from mapserver.calibration.parameters import LENS_SIGMAS


@dataclass(frozen=True)
class MotionState:
    """Variables of K keyframes and N landmarks.

    map_from_body (K, 4, 4); motions (K, 9): velocity in map, gyro bias, accelerometer bias, zero without an IMU; points_map (N, 3).
    """

    map_from_body: Array
    motions: Array
    points_map: Array


@dataclass(frozen=True)
class CalibrationData:
    """One stretch of a recording, tracked by a survey under `calibration`, with the `rectifier` of that calibration.

    stamps_ns (K,) on the cameras' clock. Observations are sorted by landmark: obs_keyframe, obs_landmark (M,); obs_pixels (M, 4) of
    the rectified pair: u_left, v_left, u_right, v_right, the last two NaN without a match in the right image. obs_sigma_px (M, 3): of the
    left pixel, of the disparity, of the row difference. imu: empty if absent. bias_px: possible common error of pixels and disparities,
    which does not average out. lens_sigmas: of the given distortion.
    """

    calibration: RigCalibration
    rectifier: Rectifier
    stamps_ns: NDArray[np.int64]
    start: MotionState
    obs_keyframe: AnyArray
    obs_landmark: AnyArray
    obs_pixels: Array
    obs_sigma_px: Array
    imu: ImuSamples
    wheel: Sequence[WheelSample] = ()
    bias_px: float = 0.0
    lens_sigmas: Array = field(default_factory=lambda: LENS_SIGMAS)

    @property
    def is_inertial(self) -> bool:
        """True if the data include an IMU."""
        return self.calibration.imu is not None and len(self.imu) > 0
