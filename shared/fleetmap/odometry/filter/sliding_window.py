"""Sliding window of the odometry: the filter, its clones, and the observations that link them."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, length, rotation_angle_rad, se3_adjoint, se3_inverse
from fleetmap.odometry.filter.msckf import InitialState, InvariantFilter
from fleetmap.odometry.odometry_checks import middle
from fleetmap.odometry.settings import OdometrySettings
from fleetmap.odometry.tracking.tracker import Tracked
from fleetmap.sensors.rectification import MountedRig

_UNKNOWN_DEPTH_M = 5.0
# The filter contradicts the images if it accepts less than this share of at least as many tracks over as many updates.
_LEAST_TAKEN, _JUDGED_TRACKS, _JUDGED_UPDATES = 0.2, 10, 3


class OdometryRig:
    """A rig of which the odometry follows one camera, with the number `followed` among those mounted: camera, body_from_cam (4, 4).

    imu is None for a rig without noise figures.
    """

    def __init__(self, rig: MountedRig, settings: OdometrySettings, followed: int = 0) -> None:
        self.rig, self.settings, self.followed = rig, settings, followed
        self.mounted, self.imu_minus_cam_s = rig.mounted, rig.imu_minus_cam_s
        self.imu, self.base_from_body = rig.calibration.imu, rig.base_from_body
        self.camera, self.body_from_cam = rig.mounted[followed]
        self.cam_from_body = se3_inverse(self.body_from_cam)


class SlidingWindow:
    """The state at stamp_ns (IMU clock), one clone for each frame that is kept, and the observations not used yet."""

    first_depth_m: float | None = 20.0  # of a point without disparity; None: that of the scene

    def __init__(self, rig: OdometryRig, start: InitialState) -> None:
        self.rig, self.stamp_ns = rig, start.stamp_ns
        self.rate_body_radps = np.zeros(3)  # at the state, without bias
        self.scene_depth_m = _UNKNOWN_DEPTH_M
        self.contradicts_images = False
        self.previous_from_body: Array | None = (
            None  # the motion since the frame before, as known after the last update
        )
        self._judged = deque[tuple[int, int]](maxlen=_JUDGED_UPDATES)  # numbers of accepted and refused tracks
        self._refused_frames = 0  # in a row in which the filter refused tracks and accepted none
        settings = rig.settings.filter
        true_error_cov = settings.real_start_share**2 * start.covariance
        if rig.imu is not None:  # the mean of a steady gyro is far more accurate than its weight
            true_error_cov[9:12, :], true_error_cov[:, 9:12] = 0.0, 0.0
            true_error_cov[range(9, 12), range(9, 12)] = settings.real_gyro_bias_sigma_radps**2
        self.filter = InvariantFilter(start.state, start.covariance, settings, rig.mounted, true_error_cov)
        self._stamps_ns: dict[int, int] = {}
        # Frames dropped with the newest: a frame that is kept, and kept_from_dropped.
        self._merged: dict[int, tuple[int, Array]] = {}

    def restarted(self, start: InitialState) -> "SlidingWindow":
        """An empty window of the same scene."""
        window = type(self)(self.rig, start)
        window.scene_depth_m = self.scene_depth_m
        return window

    # --- queries ---

    def motion_since(self, frame_index: int) -> tuple[Array, Array] | None:
        """As `Odometry.motion_since`."""
        if frame_index in self.filter.clone_ids:  # of nearly all frames
            return self.filter.motion_since(frame_index)
        kept, frame_from_kept = self._kept(frame_index)
        if kept not in self.filter.clone_ids:
            return None
        kept_from_now, covariance = self.filter.motion_since(kept)
        carry = se3_adjoint(frame_from_kept)
        return frame_from_kept @ kept_from_now, carry @ covariance @ carry.T

    def _kept(self, frame_index: int) -> tuple[int, Array]:
        """The kept frame that represents a dropped one, and frame_from_kept (4, 4); for a kept frame itself."""
        kept_from_frame = np.eye(4)
        while frame_index in self._merged:
            frame_index, kept_from_earlier = self._merged[frame_index]
            kept_from_frame = kept_from_earlier @ kept_from_frame
        return frame_index, se3_inverse(kept_from_frame)

    def cam_from_earlier(self, frame_index: int) -> Array | None:
        """(4, 4) from a frame's camera to the current one; None if the frame is not kept."""
        if frame_index not in self.filter.clone_ids:
            return None
        return self.filter.cam_from_earlier(frame_index, self.rig.cam_from_body, self.rig.followed)

    def matched_body(self, tracked: Tracked) -> tuple[int, Array] | None:
        """After a gap: the best matched clone and odom_from_body (4, 4) by vision since then."""
        best = next((e for e in tracked.earlier if e.frame_index in self.filter.clone_ids), None)
        if best is None or not tracked.by_descriptors:
            return None
        odom_from_earlier = self.filter.odom_from_clone(best.frame_index)
        odom_from_cam = odom_from_earlier @ self.rig.body_from_cam @ se3_inverse(best.cam_from_earlier)
        return best.frame_index, np.asarray(odom_from_cam @ self.rig.cam_from_body)

    def seconds_since(self, frame_index: int) -> float:
        """Time from a kept frame to the state."""
        return (self.stamp_ns - self._stamps_ns[frame_index]) * 1e-9

    def seconds_between(self, earlier_index: int, later_index: int) -> float:
        """Time between two kept frames."""
        return (self._stamps_ns[later_index] - self._stamps_ns[earlier_index]) * 1e-9

    # --- one frame ---

    def seed(self, frame_index: int, tracked: Tracked) -> None:
        """Start an empty window with one frame; the tracks continue from it."""
        self._add_clone(frame_index)
        self.filter.observe(frame_index, self.rig.followed, tracked.ids, tracked.pixels)

    def update(self, frame_index: int, tracked: Tracked, chunk_frames: int, iterations: int) -> NDArray[np.int8]:
        """Add a frame at the state and use the tracks that ended, those that are due, or (after a gap) all.

        Every observation is used exactly once. Returns the result of `core.Filter.update`.
        """
        self._add_clone(frame_index)
        self._observe(frame_index, tracked)
        due = (frame_index + tracked.ids) % chunk_frames == 0
        chosen = tracked.ids, due | tracked.by_descriptors, self.first_depth_m or self.scene_depth_m
        seen, scale = self.matched_body(tracked), self.rig.settings.filter.descriptor_sigma_scale
        effort = (iterations,) if seen is None else (4, seen[1], scale)
        used = self.filter.update(*chosen, *effort)
        self._judged.append((int(np.count_nonzero(used == 1)), int(np.count_nonzero(used == -1))))
        if self._judged[-1][0]:
            self._refused_frames = 0
        elif self._refused_frames or self._judged[-1][1]:
            self._refused_frames += 1
        taken, refused = (sum(counts) for counts in zip(*self._judged, strict=True))
        is_clear = len(self._judged) == _JUDGED_UPDATES and taken + refused >= _JUDGED_TRACKS
        takes_few = is_clear and taken < _LEAST_TAKEN * (taken + refused)
        # Or each of few tracks was due once.
        self.contradicts_images = takes_few or self._refused_frames >= chunk_frames
        self._prune()
        kept, previous_from_kept = self._kept(frame_index - 1)
        is_known = kept in self.filter.clone_ids
        self.previous_from_body = (
            previous_from_kept @ self.filter.motion_between(kept, frame_index) if is_known else None
        )
        return used

    def _add_clone(self, frame_index: int) -> None:
        self.filter.add_clone(frame_index, self.rate_body_radps)
        self._stamps_ns[frame_index] = self.stamp_ns

    def _observe(self, frame_index: int, tracked: Tracked) -> None:
        for earlier in tracked.earlier:
            self.filter.observe(earlier.frame_index, self.rig.followed, earlier.ids, earlier.pixels)
        self.filter.observe(frame_index, self.rig.followed, tracked.ids, tracked.pixels)
        self.scene_depth_m = self._depth_of(tracked.pixels)

    def _depth_of(self, pixels: Array) -> float:
        disparities = pixels[:, 0] - pixels[:, 2]
        known = disparities[np.isfinite(disparities)]
        camera = self.rig.camera
        return camera.focal_px * camera.baseline_m / middle(known) if len(known) else _UNKNOWN_DEPTH_M

    def _prune(self) -> None:
        """Drop the second newest clone if the robot hardly moved since the one before, else the oldest."""
        settings = self.rig.settings.filter
        self._merged.clear()
        while len(self.filter.clone_ids) >= settings.clones:
            ids = self.filter.clone_ids
            motion = self.filter.motion_between(ids[-3], ids[-2])
            is_still = (
                rotation_angle_rad(motion[:3, :3]) < settings.keyframe_rotation_rad
                and length(motion[:3, 3]) / self.scene_depth_m < settings.keyframe_parallax
            )
            gone = ids[-2] if is_still else ids[0]
            if is_still:
                self._merged[gone] = ids[-3], motion
            self.filter.remove_clone(gone)
            self._stamps_ns.pop(gone, None)
