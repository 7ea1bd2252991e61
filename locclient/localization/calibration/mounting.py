"""Information of one fix on the mounting of the cameras, by gravity, driving direction and the ground. Pure."""

from bisect import bisect_left
from cmath import phase
from collections import deque
from collections.abc import Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, se3_inverse, so3_log
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sensors.samples import WheelSample

_ACCEL_BIAS_RAD = 0.003  # short-term error of gravity in the IMU's axes
_FLOOR_RADIUS_M, _FLOOR_SIGMA_M = 4.0, 0.02
_SLAB_M = 0.06  # landmarks of the ground lie within this height
# minimum number of landmarks of the ground, and ratio to the mean of the slabs above
_MIN_IN_SLAB, _MIN_DENSITY = 12, 3.0
_BELOW_SHARE = 0.05  # of the landmarks may lie below the ground: reflections, and errors of depth
_MIN_STEP_M, _MAX_TURN_RAD = 0.4, 0.15  # of a step that determines the driving direction
_KEPT_SAMPLES = 2000  # of wheel odometry: 20 s at 100 Hz, a hundred times the duration of a fix


class BasePose(NamedTuple):
    """Pose of the base by a fix, and by the wheels at the same frame (`WheelTravel.at`)."""

    map_from_base: Array
    cov_rot_trans: Array
    by_wheels: Array


class WheelTravel:
    """Path of the base by the wheels alone. is_heard: True if wheel samples were received, so that the robot stands on the ground."""

    def __init__(self) -> None:
        self._placed: deque[tuple[int, complex, float]] = deque(maxlen=_KEPT_SAMPLES)  # stamp, x + iy in metres, yaw

    @property
    def is_heard(self) -> bool:
        return bool(self._placed)

    def handle(self, samples: Sequence[WheelSample]) -> None:
        for sample in samples:
            last_ns, place_m, yaw_rad = self._placed[-1] if self._placed else (sample.stamp_ns, 0j, 0.0)
            elapsed_s = (sample.stamp_ns - last_ns) * 1e-9
            turn_rad = sample.yaw_rate_radps * elapsed_s
            way_m = elapsed_s * complex(*sample.velocity_base_mps[:2]) * np.exp(1j * (yaw_rad + 0.5 * turn_rad))
            self._placed.append((sample.stamp_ns, place_m + way_m, yaw_rad + turn_rad))

    def at(self, stamp_ns: int) -> Array:
        """Return (3,) x, y in metres and yaw in radians since the first sample; NaN before the oldest kept sample and after the newest."""
        after = bisect_left(self._placed, stamp_ns, key=itemgetter(0))
        around = [self._placed[max(after - 1, 0)], self._placed[min(after, len(self._placed) - 1)]]
        elapsed_ns = [placed[0] - stamp_ns for placed in around]
        places = np.array([(place_m.real, place_m.imag, yaw_rad) for _, place_m, yaw_rad in around])
        return np.array([np.interp(0, elapsed_ns, values, np.nan, np.nan) for values in places.T])


def tilt(fix: Fix, cam_from_body: Array, odometry: OdometryEstimate) -> tuple[Array, Array]:
    """Return (2, 4) Jacobian and (2,) measurement, in sigmas: angle of gravity to the map's vertical about the body's x and y axes.

    Columns: rotation of the cameras against the body about its x and y, and the map's own tilt about its x and y.
    """
    map_from_body = fix.map_from_cam[:3, :3] @ cam_from_body[:3, :3]
    up_by_map, up_by_imu = map_from_body.T[:, 2], odometry.odom_from_body[:3, :3].T[:, 2]
    measured = np.cross(up_by_map, up_by_imu)[:2]
    variance = fix.cov_rot_trans[:2, :2].trace() / 2 + odometry.cov_rot_trans[:2, :2].trace() / 2 + _ACCEL_BIAS_RAD**2
    return np.hstack([np.eye(2), map_from_body.T[:2, :2]]) / np.sqrt(variance), measured / np.sqrt(variance)


def heading(before: BasePose, now: BasePose) -> tuple[float, float] | None:
    """Return the rotation of the cameras against the body about its z, and its sigma; None if the step does not determine it.

    It is the angle from the base's direction of travel by the map to that by the wheels. A turn missing in the wheels is assumed to
    be spread evenly over the step, which rotates it by half of that; at one end, it would rotate it by all or nothing.
    """
    before_from_now = se3_inverse(before.map_from_base) @ now.map_from_base
    turn_rad = float(so3_log(before_from_now[:3, :3])[2])
    wheels_m = complex(*(now.by_wheels - before.by_wheels)[:2]) * np.exp(-1j * before.by_wheels[2])
    missing_rad = turn_rad - float(now.by_wheels[2] - before.by_wheels[2])
    step_m = before_from_now[:2, 3]
    length_m = float(np.linalg.norm(step_m))
    if abs(turn_rad) > _MAX_TURN_RAD or not _MIN_STEP_M < length_m < 2 * abs(wheels_m):
        return None
    angle = phase(wheels_m) - np.arctan2(step_m[1], step_m[0]) + 0.5 * missing_rad
    variances = [end.cov_rot_trans[3:5, 3:5].trace() / 2 for end in (before, now)]
    sigma = np.hypot(np.sqrt(sum(variances)) / length_m, missing_rad / np.sqrt(12))  # uniform from one end to the other
    return float((angle + np.pi) % (2 * np.pi) - np.pi), float(sigma)


def height(base: BasePose, points_map: Array) -> tuple[float, float] | None:
    """Return the height of the base above the map's ground around it, and its sigma; None if the landmarks show none.

    The ground is the lowest height with many more landmarks than above it and hardly any below.
    """
    place_m = base.map_from_base[:3, 3]
    near = np.abs(points_map[:, :2] - place_m[:2]).max(axis=1) < _FLOOR_RADIUS_M
    levels = np.sort(points_map[near, 2])
    if len(levels) < 2 * _MIN_IN_SLAB:
        return None
    inside = np.searchsorted(levels, levels + _SLAB_M, side="right") - np.arange(len(levels))
    lowest = inside[: max(int(_BELOW_SHARE * len(levels)), 1) + 1]
    first = int(np.argmax(lowest))
    mean = len(levels) * _SLAB_M / max(levels[-1] - levels[0], _SLAB_M)
    if lowest[first] < max(_MIN_IN_SLAB, _MIN_DENSITY * mean):
        return None
    floor_m = float(np.median(levels[first : first + lowest[first]]))
    return float(place_m[2]) - floor_m, float(np.hypot(_FLOOR_SIGMA_M, np.sqrt(base.cov_rot_trans[5, 5])))
