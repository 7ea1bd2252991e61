"""What one fix says of how the cameras are mounted: gravity, the driving direction, and the floor. Pure."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, se3_inverse, so3_log
from fleetmap.odometry import OdometryEstimate
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sensors.samples import WheelSample

_ACCEL_BIAS_RAD = 0.003  # gravity in the IMU's axes, from moment to moment
_FLOOR_RADIUS_M, _FLOOR_SIGMA_M = 4.0, 0.02
_SLAB_M = 0.06  # landmarks of a floor lie within this height
_MIN_IN_SLAB, _MIN_DENSITY = (
    12,
    3.0,
)  # landmarks of a floor, and how much more of them than in the slabs above, in the mean
_BELOW_SHARE = 0.05  # of the landmarks, below the floor: reflections, and errors of depth
_MIN_STEP_M, _MAX_TURN_RAD = 0.4, 0.15  # of a step whose chord shows the driving direction


class BasePose(NamedTuple):
    """The base by a fix, with what the wheels had measured until then: metres forward and to the left."""

    map_from_base: Array
    cov_rot_trans: Array
    travelled_m: Array


class WheelTravel:
    """Sum of what the wheels measured, forward and left. is_heard: whether there are wheels, so that the robot stands on a floor."""

    def __init__(self) -> None:
        self.travelled_m = np.zeros(2)
        self._last_ns: int | None = None

    @property
    def is_heard(self) -> bool:
        """Whether wheel odometry has come."""
        return self._last_ns is not None

    def handle(self, samples: Sequence[WheelSample]) -> None:
        """Adds samples in the order of their stamps."""
        for sample in samples:
            if self._last_ns is not None:
                self.travelled_m += sample.velocity_base_mps[:2] * (sample.stamp_ns - self._last_ns) * 1e-9
            self._last_ns = sample.stamp_ns


def tilt(fix: Fix, cam_from_body: Array, odometry: OdometryEstimate) -> tuple[Array, Array]:
    """(2, 4) Jacobian and (2,) measurement, in sigmas: how far gravity lies from the map's vertical about the body's x and y axes.

    Columns: the cameras' turn against the body about its x and y, and the map's own tilt about its x and y.
    """
    map_from_body = fix.map_from_cam[:3, :3] @ cam_from_body[:3, :3]
    up_by_map, up_by_imu = map_from_body.T[:, 2], odometry.odom_from_body[:3, :3].T[:, 2]
    measured = np.cross(up_by_map, up_by_imu)[:2]
    variance = fix.cov_rot_trans[:2, :2].trace() / 2 + odometry.cov_rot_trans[:2, :2].trace() / 2 + _ACCEL_BIAS_RAD**2
    jacobian = np.hstack([np.eye(2), map_from_body.T[:2, :2]])
    return jacobian / np.sqrt(variance), measured / np.sqrt(variance)


def heading(before: BasePose, now: BasePose) -> tuple[float, float] | None:
    """The cameras' turn against the body about its z, and its sigma; None where a step does not show it.

    That is the angle from where the map says the base went to where the wheels say. The chord of an arc runs along the mean of the
    headings at its ends.
    """
    before_from_now = se3_inverse(before.map_from_base) @ now.map_from_base
    turn_rad = float(so3_log(before_from_now[:3, :3])[2])
    step_m, wheels_m = before_from_now[:2, 3], now.travelled_m - before.travelled_m
    length_m = float(np.linalg.norm(step_m))
    if abs(turn_rad) > _MAX_TURN_RAD or not _MIN_STEP_M < length_m < 2 * float(np.linalg.norm(wheels_m)):
        return None
    angle = np.arctan2(wheels_m[1], wheels_m[0]) - np.arctan2(step_m[1], step_m[0]) + 0.5 * turn_rad
    variances = [end.cov_rot_trans[3:5, 3:5].trace() / 2 for end in (before, now)]
    return float((angle + np.pi) % (2 * np.pi) - np.pi), float(np.sqrt(sum(variances))) / length_m


def height(base: BasePose, points_map: Array) -> tuple[float, float] | None:
    """Height of the base above the floor of the map around it, and its sigma; None where landmarks show no floor.

    A floor is the lowest height at which many more landmarks lie than above, and below which hardly any do.
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
