"""Detection of a ground robot without wheel odometry that leaves the ground, from the motion of IMU and images.

What stands on the ground moves along one plane of its own body, also on ramps: it has no speed along the normal of that plane. The robot's
drive shows whether that holds for it, and which plane it is. Source: Dissanayake et al. 2001 (motion constraints of land vehicles).
"""

from collections import deque
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, length

_WINDOW_NS = 400_000_000
_MEMORY_M = 10.0  # of the drive that shows the plane
_LEAST_SHARE = 0.5  # of that memory in use: after 7 m
_PLANE_RAD = np.radians(
    1.0
)  # root mean square between motion and plane: of cars 0.3 degrees, of drones and hands at least 3
_UP_WEIGHT = 0.003  # of the mean up direction as the normal: motion to 1 degree against slopes to 4, in 20 windows
# Motion off the plane that the ground causes: thresholds, and the foot and the top of slopes of 17 degrees.
_OFF_M, _OFF_SHARE = 0.05, 0.3
_SIGMAS = 4.0
# By braking and loads; a slope of 17 degrees under a wheelbase of 0.3 m tilts less within this way.
_TILT, _TILT_M = np.cos(np.radians(12.0)), 0.2


class _Step(NamedTuple):
    stamp_ns: int
    step_m: Array  # (3,) since the frame before, in the body's axes
    moved_m: Array  # (3,) within the window, with its sigma
    sigma_m: float
    up_body: Array

    @property
    def is_noise(self) -> bool:
        """True if it may have stood."""
        return length(self.moved_m) < _SIGMAS * self.sigma_m


class FloorMotion:
    """Follows a robot frame by frame. Never reports one whose drive has shown no plane: it may fly, or be held by hand."""

    def __init__(self) -> None:
        self._steps = deque[_Step]()  # of the window
        self._last_ns = 0
        self._is_off = False
        self._forget()

    def _forget(self) -> None:
        # Means over the way of the memory, as far as it is in use: motion in a window (3, 3) and its variance by noise, up (3,).
        self._moments, self._variance_m2, self._up, self._share = np.zeros((3, 3)), 0.0, np.zeros(3), 0.0
        self._way_m, self._earlier_up = 0.0, np.zeros(3)  # since it stood so

    def is_lifted(self, stamp_ns: int, up_body: Array, earlier_from_body: Array | None, sigma_mps: float) -> bool:
        """True if the robot leaves the ground with this frame.

        up_body (3,): unit, in the body's axes. earlier_from_body (4, 4): since the frame before. sigma_mps: of the speed upwards.
        """
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if earlier_from_body is None or stamp_ns - last_ns > _WINDOW_NS:  # nobody knows how it moved
            self._steps.clear()
            self._way_m, self._earlier_up = 0.0, up_body
            return False
        past = list[_Step]()
        while self._steps and stamp_ns - self._steps[0].stamp_ns > _WINDOW_NS:
            past.append(self._steps.popleft())
        step_m, sigma_m = earlier_from_body[:3, 3], sigma_mps * _WINDOW_NS * 1e-9
        moved_m = step_m + sum(step.step_m for step in self._steps)
        step = _Step(stamp_ns, step_m, moved_m, sigma_m, up_body)
        self._steps.append(step)
        self._way_m += 0.0 if step.is_noise else length(step_m)
        if self._way_m > _TILT_M:
            self._way_m, self._earlier_up = 0.0, up_body
        was_off, self._is_off = self._is_off, self._leaves(step)
        if was_off and not self._is_off:
            self._forget()  # nobody knows on what it is now
            self._steps.clear()
        elif not self._is_off:
            for earlier in past:  # before what may be a lift begins
                self._remember(earlier)
        return self._is_off

    def _leaves(self, step: _Step) -> bool:
        """True if a motion is off the plane of the drive, which has shown one."""
        if self._share < _LEAST_SHARE:
            return False
        size_m2 = float(np.trace(self._moments))
        normal = np.asarray(np.linalg.solve(self._moments / size_m2 + _UP_WEIGHT * np.eye(3), self._up), float)
        normal = normal / length(normal)
        if normal @ self._moments @ normal > _PLANE_RAD**2 * size_m2 + self._variance_m2:
            return False
        off_m = float(normal @ step.moved_m)
        along_m = length(step.moved_m - off_m * normal)
        is_tilted = self._earlier_up @ step.up_body < _TILT
        return bool(is_tilted or abs(off_m) > _OFF_M + _OFF_SHARE * along_m + _SIGMAS * step.sigma_m)

    def _remember(self, step: _Step) -> None:
        if step.is_noise:
            return
        kept = float(np.exp(-length(step.step_m) / _MEMORY_M))
        self._moments = kept * self._moments + (1.0 - kept) * np.outer(step.moved_m, step.moved_m)
        self._variance_m2 = kept * self._variance_m2 + (1.0 - kept) * step.sigma_m**2
        self._up = kept * self._up + (1.0 - kept) * step.up_body
        self._share = kept * self._share + (1.0 - kept)
