"""Tracking of a survey under way: the survey's own odometry, frame by frame, and what the growing map needs of its keyframes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import ImuSamples, WheelSample
from mapserver.survey.bundle.odometry_factors import floor_of, step_covariance
from mapserver.survey.live.live_values import NewKeyframe, joined_imu
from mapserver.survey.odometry_pass import OdometryRun, TrackedFrame
from mapserver.survey.settings import SurveySettings

_TORN_M2 = 100.0


class Tracked(NamedTuple):
    """One frame as tracking leaves it.

    frame_from_body (4, 4); quality: share of its points that agree, 0 while the odometry is lost; keyframe: what the map takes of it,
    None where it is none; pixels (N, 3), u_left v u_right, of the points that the odometry follows, None where it follows none.
    """

    frame: RectifiedFrame
    frame_from_body: Array
    quality: float
    keyframe: NewKeyframe | None
    pixels: Array | None = None


class _Before(NamedTuple):
    """The last keyframe: its place with the covariance, and what was torn until then."""

    covariance: Array
    frame_from_body: Array
    torn_m2: float


class LiveTracking:
    """Takes every frame in turn."""

    def __init__(self, calibration: RigCalibration, rectifier: Rectifier, settings: SurveySettings) -> None:
        self._run = OdometryRun(calibration, rectifier, settings)
        self._is_single, self._has_imu = rectifier.camera.baseline_m == 0, calibration.imu is not None
        self._torn_m2 = 0.0  # variance of what lies between runs of one camera
        self._before: _Before | None = None
        self._imu: list[ImuSamples] = []

    def handle(self, frame: RectifiedFrame, imu: ImuSamples, wheel: Sequence[WheelSample]) -> Tracked:
        """The next frame, with the samples of the IMU and the wheels up to it that were not given before."""
        tracked = self._run.handle(frame, imu, wheel)
        self._imu.append(imu)
        estimate = tracked.estimate
        keyframe = None
        if tracked.is_keyframe and self._has_place(estimate):
            keyframe = self._keyframe(tracked)
        quality = 0.0 if estimate.status is OdometryStatus.DEGRADED else float(estimate.inlier_share)
        return Tracked(tracked.frame, tracked.frame_from_body, quality, keyframe, estimate.track_pixels)

    def _has_place(self, estimate: OdometryEstimate) -> bool:
        """Whether a frame lies to those before: of one camera not until it has started, with an IMU not until the scale is known."""
        if not self._is_single or (
            estimate.status is not OdometryStatus.INITIALISING and estimate.scale_known == self._has_imu
        ):
            return True
        if self._before is not None and not self._has_imu:
            self._torn_m2 += _TORN_M2  # a new start has a scale of its own
        return False

    def _keyframe(self, tracked: TrackedFrame) -> NewKeyframe:
        estimate, covariance, frame_from_body = tracked.estimate, self._run.chain.covariance, tracked.frame_from_body
        before, step_cov, imu = self._before, None, joined_imu(self._imu)
        if before is not None:
            step = se3_inverse(before.frame_from_body) @ frame_from_body
            known, floor = (before.covariance, covariance), floor_of(inertial=estimate.inertial)
            step_cov = step_covariance(known, before.frame_from_body[:3, :3], step, floor)
            if self._torn_m2 > before.torn_m2:
                step_cov = step_cov + _TORN_M2 * np.eye(6)
        rotation = estimate.odom_from_body[:3, :3]
        self._before = _Before(covariance, frame_from_body, self._torn_m2)
        self._imu = []
        return NewKeyframe(
            number=tracked.number,
            frame_from_body=frame_from_body,
            level_from_frame=self._run.chain.level_from_frame,
            step_cov=step_cov,
            velocity_body_mps=rotation.T @ estimate.velocity_odom_mps,
            gyro_bias_radps=estimate.gyro_bias_radps,
            accel_bias_mps2=estimate.accel_bias_mps2,
            inertial=estimate.inertial,
            imu=imu,
            variance_m2=float(np.trace(covariance[3:, 3:])) + self._torn_m2,
        )
