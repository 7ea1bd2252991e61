"""Detection of a robot that is lifted off the ground, by hands, fork or hoist, from the motion of IMU and images, and of its wheels.

Without wheel odometry: what stands on the ground moves along one plane of its own body, also on ramps: it has no speed along the normal
of that plane. The robot's drive shows whether that holds for it, and which plane it is. Source: Dissanayake et al. 2001 (motion
constraints of land vehicles).
"""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, length, se3_inverse
from fleetmap.sensors.samples import WheelSample

WINDOW_NS = 400_000_000
# Climb or motion off the plane that the ground allows: thresholds, and slopes of 17 degrees over the rolled distance.
_CLIMB_M, _CLIMB_SHARE = 0.05, 0.3
_SIGMAS = 4.0
_TILT = np.cos(np.radians(12.0))  # against the ground on which it rolled: ramps and braking cause less
_FLOOR_KEPT = 0.95  # share of the old up direction, with each frame in which the wheels roll
_ROLLING_MPS = 0.05
# Distance without rotation of the wheels; a robot that skids with locked wheels slows down.
_CARRIED_M, _SKID_SHARE = 0.15, 0.8
# Without wheels: the drive that shows the plane along which the robot moves.
_MEMORY_M = 10.0
_LEAST_SHARE = 0.5  # of that memory in use: after 7 m
# Root mean square between motion and plane: of cars 0.3 degrees, of drones and hands at least 3.
_PLANE_RAD = np.radians(1.0)
_UP_WEIGHT = 0.003  # of the mean up direction as the normal: motion to 1 degree against slopes to 4, in 20 windows
_TILT_M = 0.2  # by loads; a slope of 17 degrees under a wheelbase of 0.3 m tilts less within this way


class _Step(NamedTuple):
    stamp_ns: int
    climb_m: float
    way_m: Array  # (2,) of the base along the ground, in its own axes
    rolled_m: float
    is_rolling: bool  # straight on or in a turn on the spot


class LiftCheck:
    """Follows a robot frame by frame; by `FloorMotion` without wheel odometry."""

    def __init__(self, base_from_body: Array) -> None:
        self._base_from_body, self._body_from_base = base_from_body, se3_inverse(base_from_body)
        self._floor_motion = FloorMotion()
        self._wheel: WheelSample | None = None
        self._steps = deque[_Step]()
        self._floor_up: Array | None = None  # (3,) in the base's axes
        self._has_rolled = False  # since it was carried: wheels that never turn prove nothing

    def is_lifted(
        self, stamp_ns: int, wheel: Sequence[WheelSample], odom_from_body: Array, earlier_from_body: Array | None,
        climb_sigma_mps: float,
    ) -> bool:  # fmt: skip
        """True if the robot leaves the ground with this frame; stamps on the IMU's clock.

        wheel: the samples since the frame before. odom_from_body (4, 4): z is up. earlier_from_body (4, 4): since the frame before.
        climb_sigma_mps: of the speed upwards.
        """
        self._wheel = wheel[-1] if wheel else self._wheel
        if self._wheel is None:
            return self._floor_motion.is_lifted(stamp_ns, odom_from_body[2, :3], earlier_from_body, climb_sigma_mps)
        if stamp_ns - self._wheel.stamp_ns > WINDOW_NS or earlier_from_body is None:
            self._steps.clear()
            return False
        up_body = odom_from_body[2, :3]
        up = self._base_from_body[:3, :3] @ up_body
        step_m = (self._base_from_body @ earlier_from_body @ self._body_from_base)[:3, 3]
        climb_m, rolling = float(up @ step_m), [*wheel, self._wheel]
        speed_mps = max(length(sample.velocity_base_mps) for sample in rolling)
        rolled_m = speed_mps * (stamp_ns - self._steps[-1].stamp_ns) * 1e-9 if self._steps else 0.0
        is_rolling = speed_mps > 0.0 or any(sample.yaw_rate_radps for sample in rolling)
        self._steps.append(_Step(stamp_ns, climb_m, (step_m - climb_m * up)[:2], rolled_m, is_rolling))
        while stamp_ns - self._steps[0].stamp_ns > WINDOW_NS:
            self._steps.popleft()
        climb_m, rolled_m = sum(s.climb_m for s in self._steps), sum(s.rolled_m for s in self._steps)
        climbs = abs(climb_m) > _CLIMB_M + _CLIMB_SHARE * rolled_m + _SIGMAS * climb_sigma_mps * WINDOW_NS * 1e-9
        return climbs or self._is_tilted(up, speed_mps) or self._is_moved(speed_mps)

    def _is_tilted(self, up: Array, speed_mps: float) -> bool:
        is_tilted = self._floor_up is not None and bool(self._floor_up @ up < _TILT)
        if self._floor_up is None or is_tilted:
            self._floor_up = up  # reported once: the robot may now stand on a slope, and search there
        elif speed_mps > _ROLLING_MPS:
            mixed = _FLOOR_KEPT * self._floor_up + (1.0 - _FLOOR_KEPT) * up
            self._floor_up = mixed / length(mixed)
        return is_tilted

    def _is_moved(self, speed_mps: float) -> bool:
        """True if it keeps moving while its wheels, which turned before, stand still."""
        self._has_rolled |= speed_mps > _ROLLING_MPS
        half = len(self._steps) // 2
        if not self._has_rolled or half < 2 or any(step.is_rolling for step in self._steps):
            return False
        ways_m = np.array([step.way_m for step in self._steps])
        early_m, late_m = length(ways_m[:half].sum(axis=0)), length(ways_m[-half:].sum(axis=0))
        self._has_rolled = early_m + late_m < _CARRIED_M or late_m < _SKID_SHARE * early_m
        return not self._has_rolled


class _GroundStep(NamedTuple):
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
        self._steps = deque[_GroundStep]()  # of the window
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
        if earlier_from_body is None or stamp_ns - last_ns > WINDOW_NS:  # nobody knows how it moved
            self._steps.clear()
            self._way_m, self._earlier_up = 0.0, up_body
            return False
        past = list[_GroundStep]()
        while self._steps and stamp_ns - self._steps[0].stamp_ns > WINDOW_NS:
            past.append(self._steps.popleft())
        step_m, sigma_m = earlier_from_body[:3, 3], sigma_mps * WINDOW_NS * 1e-9
        moved_m = step_m + sum(step.step_m for step in self._steps)
        step = _GroundStep(stamp_ns, step_m, moved_m, sigma_m, up_body)
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

    def _leaves(self, step: _GroundStep) -> bool:
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
        return bool(is_tilted or abs(off_m) > _CLIMB_M + _CLIMB_SHARE * along_m + _SIGMAS * step.sigma_m)

    def _remember(self, step: _GroundStep) -> None:
        if step.is_noise:
            return
        kept = float(np.exp(-length(step.step_m) / _MEMORY_M))
        self._moments = kept * self._moments + (1.0 - kept) * np.outer(step.moved_m, step.moved_m)
        self._variance_m2 = kept * self._variance_m2 + (1.0 - kept) * step.sigma_m**2
        self._up = kept * self._up + (1.0 - kept) * step.up_body
        self._share = kept * self._share + (1.0 - kept)
