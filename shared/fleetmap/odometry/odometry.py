"""The odometry of robot and survey: samples in, one estimate for each frame out.

Never touches a file, a socket or a clock.
"""

from collections.abc import Callable, Sequence

import numpy as np

from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array
from fleetmap.odometry.accelerometer_check import AccelerometerCheck
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.odometry.filter.msckf import InitialState, NavState
from fleetmap.odometry.filter.sliding_window import OdometryRig, SlidingWindow
from fleetmap.odometry.gyro_clock import GyroClock
from fleetmap.odometry.modes import ImuInputs, Mode, StartingMode, VisualMode
from fleetmap.odometry.odometry_checks import MAX_OFFSET_SIGMAS
from fleetmap.odometry.sensor_buffer import SensorBuffer
from fleetmap.odometry.settings import OdometrySettings
from fleetmap.odometry.tracking.tracker import Ids, Tracker
from fleetmap.sensors.rectification import MountedRig, RectifiedFrame
from fleetmap.sensors.samples import ImuSamples, WheelSample

_IMU_MEMORY_S = 25.0
_IMU_MEMORY_INERTIAL_S = 4.0  # with a state to continue from, no start is searched for in it


class Odometry:
    """Stereo-inertial, or stereo alone if the rig has no IMU. Frames go to the current mode, see `modes`."""

    _points_in_camera: Callable[[Ids], Array] | None = None  # see Tracker

    def __init__(
        self, rig: MountedRig, settings: OdometrySettings, stereo_settings: StereoSettings | None = None
    ) -> None:
        """rig: its first camera is followed until `follow`."""
        self._rig, self._stereo_settings = OdometryRig(rig, settings), stereo_settings
        self._samples = SensorBuffer()
        self.accelerometer = AccelerometerCheck(rig.base_from_body)
        self.clock = GyroClock(MAX_OFFSET_SIGMAS * settings.filter.time_offset_sigma_s)
        self._tracker = self._new_tracker(0, 0)
        self._before: RectifiedFrame | None = None  # of a camera that is followed from the next frame on
        self._mode = self._first_mode()
        self._frame_index = 0

    def handle_imu(self, samples: ImuSamples) -> None:
        """Add samples newer than any before; ignored by a rig without IMU noise figures."""
        self._samples.add_imu(samples)

    def handle_wheel(self, samples: Sequence[WheelSample]) -> None:
        """Add wheel odometry newer than any before, on the IMU's clock; used once gravity is known."""
        if self._rig.settings.filter.use_wheels:
            self._samples.add_wheel(samples)

    def follow(self, number: int, before: RectifiedFrame | None) -> None:
        """Take the frames of another view from now on; before: its frame at the last moment, in which its tracks begin."""
        self._rig = OdometryRig(self._rig.rig, self._rig.settings, number)
        self._mode.follow(self._rig)
        self._before = before if self._frame_index else None
        first_frame = self._frame_index - (self._before is not None)
        self._tracker = self._new_tracker(first_frame, self._tracker.next_id)

    def _new_tracker(self, first_frame: int, first_id: int) -> Tracker:
        return Tracker(
            self._rig.camera,
            self._rig.settings.tracker,
            self._stereo_settings,
            first_frame=first_frame,
            first_id=first_id,
            points_in_camera=None if self._rig.camera.baseline_m else self._points_in_camera,
        )

    def handle_stereo(self, frame: RectifiedFrame) -> OdometryEstimate:
        """Return the estimate at `frame`, of the followed view, which must be newer than any before.

        IMU samples up to its stamp should have been added.
        """
        memory_s = _IMU_MEMORY_INERTIAL_S if self._mode.inertial else _IMU_MEMORY_S
        self._samples.absorb(min(frame.stamp_ns, self._mode.stamp_ns or frame.stamp_ns), memory_s)
        stamp_ns, frame_index = frame.stamp_ns + int(self._rig.imu_minus_cam_s * 1e9), self._frame_index
        mode = self._mode if frame_index else self._mode.begin(stamp_ns)
        mode.predict(stamp_ns)
        before = None if self._before is None else self._tracker.track(self._before, mode.cam_from_earlier)
        tracked = self._tracker.track(frame, mode.cam_from_earlier, mode.rotation_sigma_rad)
        if before is not None:
            tracked, self._before = tracked.begun_in(frame_index - 1, before), None
        step = mode.process(frame_index, tracked)
        self._mode, self._frame_index = step.mode, frame_index + 1
        return self._mode.estimate(frame.stamp_ns, frame_index, tracked, step)

    def handle_fix(
        self, at: OdometryEstimate, map_from_body: Array, cov_rot_trans: Array, *, is_confirmed: bool
    ) -> None:
        """Take the pose of an earlier frame in a map whose z points up, with covariance (6, 6). A pair of cameras needs none."""

    @property
    def refuses_imu(self) -> bool:
        """True if the images contradicted the IMU's rotation, so that it is no longer used."""
        return self._rig.imu is not None and type(self._mode) is VisualMode

    def motion_since(self, frame_index: int) -> tuple[Array, Array] | None:
        """earlier_from_now (4, 4) since a frame (counted from 0) as known now, and its covariance.

        None if the frame is forgotten, which a frame dropped just now is not yet. The covariance (6, 6) is that
        of a left perturbation in the earlier body's axes, rotation first. Sparse images can revise earlier poses:
        then this is the motion between two frames, not the difference of their estimates.
        """
        return self._mode.motion_since(frame_index)

    def will_forget(self, frame_index: int) -> bool:
        """True if `motion_since` may not know a frame after the next one: the oldest known one, and dropped ones."""
        return self._mode.will_forget(frame_index)

    def _first_mode(self) -> Mode:
        window = SlidingWindow(self._rig, InitialState(NavState(), np.diag([1e-10] * 15), 0))
        if self._rig.imu is None:
            return VisualMode(window)
        return StartingMode(window, ImuInputs(self._rig, self._samples, self.clock, self.accelerometer))
