"""Detection of a robot that is lifted off the ground, by hands, fork or hoist, from the motion of IMU and images, and of its wheels."""

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, length, se3_inverse
from fleetmap.odometry.floor_motion import FloorMotion
from fleetmap.sensors.samples import WheelSample

WINDOW_NS = 400_000_000
# Climb that the ground allows: thresholds, and slopes of 17 degrees over the rolled distance.
_CLIMB_M, _CLIMB_SHARE = 0.05, 0.3
_SIGMAS = 4.0
_TILT = np.cos(np.radians(12.0))  # against the ground on which it rolled: ramps and braking cause less
_FLOOR_KEPT = 0.95  # share of the old up direction, with each frame in which the wheels roll
_ROLLING_MPS = 0.05
# Distance without rotation of the wheels; a robot that skids with locked wheels slows down.
_CARRIED_M, _SKID_SHARE = 0.15, 0.8


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
        return self._climbs(climb_sigma_mps) or self._is_tilted(up, speed_mps) or self._is_moved(speed_mps)

    def _climbs(self, sigma_mps: float) -> bool:
        climb_m, rolled_m = sum(s.climb_m for s in self._steps), sum(s.rolled_m for s in self._steps)
        return abs(climb_m) > _CLIMB_M + _CLIMB_SHARE * rolled_m + _SIGMAS * sigma_mps * WINDOW_NS * 1e-9

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
