"""Odometry of one camera without an IMU, by wheels: its images measure no length, and correct the motion in a map alone."""

from collections import deque
from typing import Any, NamedTuple

import numpy as np

from fleetmap.geometry import Array, length, rotation_angle_rad, se3_exp, se3_inverse
from fleetmap.odometry.estimate import OdometryStatus
from fleetmap.odometry.filter.sliding_window import OdometryRig
from fleetmap.odometry.modes import Mode, Step
from fleetmap.odometry.mono.two_view import two_view_motion
from fleetmap.odometry.sensor_buffer import SensorBuffer
from fleetmap.odometry.tracking.tracker import Tracked
from fleetmap.sensors.samples import WheelSample

_KEPT_FRAMES = 64
_SILENT_NS = 200_000_000  # without samples the motion is unknown
_WAY_SIGMAS = 10.0  # of a point's motion in the image, from which on it shows where the camera went


class _Rolled(NamedTuple):
    """Sums until a frame: way, turn, time of motion, and each sample's sigmas over its time."""

    way_m: float = 0.0
    turn_rad: float = 0.0
    moving_s: float = 0.0
    sigma_m: float = 0.0
    sigma_rad: float = 0.0


class _Frame(NamedTuple):
    frame_index: int
    odom_from_body: Array
    rolled: _Rolled
    stamp_ns: int = 0


class SeenWay(NamedTuple):
    """The way of the camera by two images: since when, and its direction (3,), of length 1, in axes of the base at that moment."""

    since_ns: int
    direction_base: Array


class WheelMode(Mode):
    """Dead reckoning. The errors of samples stay alike from one to the next, so that sigmas add up and variances do not."""

    stamp_ns = 0

    def __init__(self, rig: OdometryRig, samples: SensorBuffer) -> None:
        self._rig, self._samples = rig, samples
        self._frames = deque[_Frame](maxlen=_KEPT_FRAMES)
        self._newest: WheelSample | None = None
        self._velocity_mps = np.zeros(3)
        self._is_silent = True
        self.seen_way: SeenWay | None = None  # by the images alone, if one ends with the last frame
        self._way_begins: tuple[int, Tracked, float] | None = None  # and the motion in the image that it needs, pixels

    def follow(self, rig: OdometryRig) -> None:
        self._rig = rig

    def predict(self, stamp_ns: int) -> None:
        """See Mode: a sample counts until its stamp, the newest one also after it."""
        at_ns = since_ns = self.stamp_ns or stamp_ns
        samples = self._samples.wheel_between(at_ns + 1, stamp_ns)
        self._newest, self.stamp_ns = samples[-1] if samples else self._newest, stamp_ns
        self._is_silent = self._newest is None or stamp_ns - self._newest.stamp_ns > _SILENT_NS
        parts = [(sample.stamp_ns, sample) for sample in samples]
        if self._newest is not None and not self._is_silent:
            parts.append((stamp_ns, self._newest))
        number, before, rolled, _ = self._frames[-1] if self._frames else _Frame(-1, np.eye(4), _Rolled())
        odom_from_base = before @ se3_inverse(self._rig.base_from_body)
        for until_ns, sample in parts:
            duration_s, at_ns = (until_ns - at_ns) * 1e-9, until_ns
            step = se3_exp(duration_s * np.array([0.0, 0.0, sample.yaw_rate_radps, *sample.velocity_base_mps]))
            odom_from_base = odom_from_base @ step
            way_m, turn_rad = length(step[:3, 3]), rotation_angle_rad(step[:3, :3])
            moving_s = duration_s if way_m + turn_rad else 0.0
            new = way_m, turn_rad, moving_s, sample.sigma_mps * duration_s, sample.sigma_radps * duration_s
            rolled = _Rolled(*np.add(rolled, new).tolist())
        odom_from_body = odom_from_base @ self._rig.base_from_body
        self._velocity_mps = (odom_from_body - before)[:3, 3] / max((stamp_ns - since_ns) * 1e-9, 1e-3)
        self._frames.append(_Frame(number + 1, odom_from_body, rolled, stamp_ns))

    def cam_from_earlier(self, frame_index: int) -> Array | None:
        motion = self.motion_since(frame_index)
        rig = self._rig
        return None if motion is None else np.asarray(rig.cam_from_body @ se3_inverse(motion[0]) @ rig.body_from_cam)

    def process(self, frame_index: int, tracked: Tracked) -> Step:
        """See Mode: nothing corrects it, but images that show another direction."""
        self.seen_way = way = self._see_way(tracked)
        return Step(self, is_lost=self._is_silent or tracked.lost or self._contradicts(way))

    def _see_way(self, tracked: Tracked) -> SeenWay | None:
        """Return the way since an earlier frame as soon as its points have moved enough in the image."""
        s = self._rig.settings.monocular
        anew = self.stamp_ns, tracked, _WAY_SIGMAS * s.sigma_px
        since_ns, before, wanted_px = self._way_begins or anew
        _, a, b = np.intersect1d(before.ids, tracked.ids, return_indices=True)
        pixels_a, pixels_b = before.pixels[a, :2], tracked.pixels[b, :2]
        if self._way_begins is None or tracked.lost or len(a) < s.first_min_points:
            self._way_begins = anew
            return None
        moved_px = float(np.median(np.linalg.norm(pixels_a - pixels_b, axis=1)))
        if moved_px < wanted_px:
            return None
        found = two_view_motion(self._rig.camera, pixels_a, pixels_b, seed=len(a))
        if found is None or found.inliers.mean() < 0.6 or found.parallax_rad < np.radians(s.min_angle_deg):
            self._way_begins = since_ns, before, 1.5 * moved_px  # a turn, or too flat a scene
            return None
        self._way_begins = anew
        b_from_a, base_from_cam = found.b_from_a, self._rig.base_from_body[:3, :3] @ self._rig.body_from_cam[:3, :3]
        return SeenWay(since_ns, -base_from_cam @ b_from_a[:3, :3].T @ b_from_a[:3, 3])

    def _contradicts(self, way: SeenWay | None) -> bool:
        """Return True if the camera went the other way by the wheels."""
        begun = next((frame for frame in self._frames if way and frame.stamp_ns == way.since_ns), None)
        if way is None or begun is None:
            return False
        base_from_odom = self._rig.base_from_body @ se3_inverse(begun.odom_from_body)
        then, now = (base_from_odom @ f.odom_from_body @ self._rig.body_from_cam for f in (begun, self._frames[-1]))
        return bool((now - then)[:3, 3] @ way.direction_base < 0.0)

    def motion_since(self, frame_index: int) -> tuple[Array, Array] | None:
        number = frame_index - self._frames[0].frame_index
        if self._is_silent or not 0 <= number < len(self._frames):
            return None
        earlier, now = self._frames[number], self._frames[-1]
        rolled = _Rolled(*np.subtract(now.rolled, earlier.rolled).tolist())
        return se3_inverse(earlier.odom_from_body) @ now.odom_from_body, self._covariance(rolled)

    def _covariance(self, rolled: _Rolled) -> Array:
        settings = self._rig.settings.filter
        sigma_rad = rolled.sigma_rad + settings.wheel_yaw_scale_sigma * rolled.turn_rad
        slipped_m = settings.wheel_slip_mps * rolled.moving_s
        sigma_m = rolled.sigma_m + settings.wheel_speed_scale_sigma * rolled.way_m + slipped_m
        # By the ground, which wheels do not show.
        tilt_rad = settings.initial_tilt_sigma_rad if rolled.moving_s else 0.0
        turns = [sigma_rad + tilt_rad, sigma_rad + tilt_rad, sigma_rad]
        return np.diag(np.square([*turns, *[sigma_m + turns[0] * rolled.way_m] * 3]))

    def will_forget(self, frame_index: int) -> bool:
        return frame_index <= self._frames[0].frame_index

    def state(self, frame_index: int, tracked: Tracked, step: Step) -> dict[str, Any]:
        """See Mode; biases are unknown."""
        _, odom_from_body, rolled, _ = self._frames[-1]
        return {
            "odom_from_body": odom_from_body,
            "cov_rot_trans": self._covariance(rolled) + 1e-12 * np.eye(6),
            "velocity_odom_mps": self._velocity_mps,
            "status": OdometryStatus.DEGRADED if frame_index and step.is_lost else OdometryStatus.TRACKING,
        }
