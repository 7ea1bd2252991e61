"""Tracking of a live survey: the survey's own odometry, frame by frame, and the data of its keyframes for the growing map."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.odometry.estimate import OdometryEstimate, OdometryStatus
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import ImuSamples, WheelSample
from mapserver.plugins.live_surveys.message import NewKeyframe, joined_imu
from mapserver.survey.odometry_pass import OdometryRun, TrackedFrame
from mapserver.survey.pose_graph.odometry_factors import FLOOR, INERTIAL_FLOOR, step_covariance
from mapserver.survey.settings import SurveySettings

_TORN_M2 = 100.0


class Tracked(NamedTuple):
    """Tracking result of one frame.

    quality: share of its consistent points, 0 while the odometry is lost; keyframe: its data for the map, None if it is not one;
    pixels (N, 3), u_left v u_right, of the tracked points, None without any.
    """

    frame: RectifiedFrame
    quality: float
    keyframe: NewKeyframe | None
    pixels: Array | None = None


class _Before(NamedTuple):
    """The last keyframe: its pose with the covariance, and the variance of breaks until then."""

    covariance: Array
    frame_from_body: Array
    torn_m2: float


class LiveTracking:
    """Processes every frame in order."""

    def __init__(self, calibration: RigCalibration, rectifier: Rectifier, settings: SurveySettings) -> None:
        self._run = OdometryRun(calibration, rectifier, settings)
        self._is_single, self._has_imu = rectifier.camera.baseline_m == 0, calibration.imu is not None
        self._torn_m2 = 0.0  # variance of the gaps between runs of one camera
        self._before: _Before | None = None
        self._imu: list[ImuSamples] = []

    def handle(self, frame: RectifiedFrame, imu: ImuSamples, wheel: Sequence[WheelSample]) -> Tracked:
        """Track the next frame, with the new samples of the IMU and the wheels up to it."""
        tracked = self._run.handle(frame, imu, wheel)
        self._imu.append(imu)
        estimate = tracked.estimate
        keyframe = None
        if tracked.is_keyframe and self._has_place(estimate):
            keyframe = self._keyframe(tracked)
        quality = 0.0 if estimate.status is OdometryStatus.DEGRADED else float(estimate.inlier_share)
        return Tracked(tracked.frame, quality, keyframe, estimate.track_pixels)

    def _has_place(self, estimate: OdometryEstimate) -> bool:
        """True if the frame's pose relative to earlier ones is known: with one camera only after its start, with an IMU after scale."""
        if not self._is_single or (
            estimate.status is not OdometryStatus.INITIALISING and estimate.scale_known == self._has_imu
        ):
            return True
        if self._before is not None and not self._has_imu:
            self._torn_m2 += _TORN_M2  # a new start has its own scale
        return False

    def _keyframe(self, tracked: TrackedFrame) -> NewKeyframe:
        estimate, covariance, frame_from_body = tracked.estimate, self._run.chain.covariance, tracked.frame_from_body
        before, step_cov, imu = self._before, None, joined_imu(self._imu)
        if before is not None:
            step = se3_inverse(before.frame_from_body) @ frame_from_body
            known, least = (before.covariance, covariance), INERTIAL_FLOOR if estimate.inertial else FLOOR
            step_cov = step_covariance(known, before.frame_from_body[:3, :3], step, least)
            if self._torn_m2 > before.torn_m2:
                step_cov = step_cov + _TORN_M2 * np.eye(6)
        velocity_body_mps = estimate.odom_from_body[:3, :3].T @ estimate.velocity_odom_mps
        self._before = _Before(covariance, frame_from_body, self._torn_m2)
        self._imu = []
        return NewKeyframe(
            number=tracked.number,
            frame_from_body=frame_from_body,
            level_from_frame=self._run.chain.level_from_frame,
            step_cov=step_cov,
            motion_body=np.r_[velocity_body_mps, estimate.gyro_bias_radps, estimate.accel_bias_mps2],
            inertial=estimate.inertial,
            imu=imu,
            variance_m2=float(np.trace(covariance[3:, 3:])) + self._torn_m2,
        )
