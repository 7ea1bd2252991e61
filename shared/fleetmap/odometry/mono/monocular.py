"""The odometry of one camera, with or without IMU."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.stereo import StereoSettings
from fleetmap.geometry import Array
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.odometry.modes import Mode, VisualMode, WindowMode, imu_inputs
from fleetmap.odometry.mono.mono_modes import MonocularMode, MonocularWindow
from fleetmap.odometry.odometry import Odometry
from fleetmap.odometry.settings import OdometrySettings, TrackerSettings
from fleetmap.odometry.tracking.tracker import MotionSince, Tracked, Tracker
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera


def make_odometry(
    calibration: RigCalibration,
    camera: StereoCamera,
    body_from_cam: Array,
    imu_minus_cam_s: float,
    settings: OdometrySettings,
    stereo_settings: StereoSettings | None = None,
) -> Odometry:
    """The odometry for a rectified camera: `MonocularOdometry` for a single one without a depth sensor."""
    kind = MonocularOdometry if camera.baseline_m == 0 else Odometry
    return kind(calibration, camera, body_from_cam, imu_minus_cam_s, settings, stereo_settings)


class MonocularTracker(Tracker):
    """The tracker with points that were triangulated from several frames, where no second camera shows their depth."""

    def __init__(
        self, camera: StereoCamera, settings: TrackerSettings, points_in_camera: Callable[[NDArray[np.int64]], Array]
    ) -> None:
        super().__init__(camera, settings)
        self._points_in_camera = points_in_camera

    def track(
        self, frame: RectifiedFrame, motion_since: MotionSince, rotation_sigma_rad: float | None = None
    ) -> Tracked:
        """As Tracker's; followed points are enough to go on, since without parallax none of them can be triangulated."""
        before = self._points.ids
        tracked = super().track(frame, motion_since, rotation_sigma_rad)
        followed = int(np.isin(tracked.ids, before).sum())
        if tracked.cam_from_previous is None and followed >= self._settings.min_inliers and not tracked.by_descriptors:
            guess = motion_since(self._frame_index - 1)
            return replace(tracked, cam_from_previous=np.eye(4) if guess is None else guess)
        return tracked

    def _points_cam(self, pixels: Array) -> Array:
        assert len(pixels) == len(self._points.ids)
        points = self._points_in_camera(self._points.ids)
        points[~(points[:, 2] > 0.0)] = np.nan
        return points


class MonocularOdometry(Odometry):
    """The class `Odometry` for one camera; `scale_known` of its estimates says whether its metres are metres."""

    def handle_stereo(self, frame: RectifiedFrame) -> OdometryEstimate:
        """The estimate at `frame`, of one image in spite of the name; newer than any before."""
        if isinstance(self._mode, VisualMode):  # the IMU was given up, or its filter diverged
            self._vision.resume(self._mode)
            self._mode = self._vision
        return super().handle_stereo(frame)

    def _first_mode(self) -> Mode:
        rig = self._rig
        self._tracker = MonocularTracker(rig.camera, rig.settings.tracker, self._points_in_camera)
        self._vision = MonocularMode(rig, None if rig.imu is None else imu_inputs(rig, rig.imu, self._samples))
        return self._vision

    def _points_in_camera(self, ids: NDArray[np.int64]) -> Array:
        """(N, 3) tracked points in the camera of the frame before, NaN where unknown."""
        if isinstance(self._mode, WindowMode) and isinstance(self._mode.window, MonocularWindow):
            return self._mode.window.points_in_camera(ids)
        return self._vision.points_in_camera(ids)
