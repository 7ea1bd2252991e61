"""Floors with a lift, and a robot that rides it: scripted odometry, fixes with misses, inertial and wheel samples of the ride."""

from collections.abc import Generator, Iterator
from dataclasses import dataclass, field, replace
from typing import Any
from unittest.mock import patch

import numpy as np

from fleetmap.geometry import Array, Rings, se3, se3_inverse, so3_exp
from fleetmap.mapformat.building import BuildingFrame, Floor, FloorEntry
from fleetmap.messages import Status
from fleetmap.odometry.accelerometer_check import AccelerometerCheck
from fleetmap.relocalization.map_view import ALIAS_STEP_M, CovisibleLandmarks
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import ImuSamples, PositionPrior, WheelSample
from locclient.localization import localizer as module
from locclient.localization.estimate import Estimate
from support.fleet.scripted_robot import BODY_FROM_CAM, ScriptedOdometry, first_near, scripted_localizer

FRAME_S, IMU_HZ, SPEED_MPS = 0.2, 100, 0.6
STOREY_M = 4.0
CABIN = np.array([[8.0, -1.2], [11.0, -1.2], [11.0, 1.2], [8.0, 1.2]])
STAND_M = 9.5  # along x, inside
WRONG_M = 0.5
NOISE = ImuNoise(1.7e-4, 2e-5, 2e-3, 3e-4)
# Of map queries with a fix; of comparisons with a floor at the place of a fix on another one.
SEEN_SHARE, COMPARED_SHARE = 0.75, 0.9


class Odometry(ScriptedOdometry):
    refuses_imu = False
    accelerometer = AccelerometerCheck(np.eye(4))

    def handle_imu(self, _: ImuSamples) -> None:
        """The scripted motion needs none."""

    def handle_wheel(self, _: object) -> None:
        """Nor these."""


@dataclass
class Relocalizer:
    """Of one floor: gives the fixes that the world has for it."""

    floor: str
    fixes: dict[str, list[Fix]]
    rng: np.random.Generator

    @property
    def view(self) -> Any:
        places = np.tile(np.eye(4), (30, 1, 1))
        places[:, 0, 3] = np.linspace(-4.0, 12.0, 30)
        return type("View", (), {"map_from_cam": places})

    def extract(self, _: RectifiedFrame) -> Generator[None, None, dict[str, list[Fix]]]:
        seen = dict(self.fixes)
        yield
        return seen

    def _found(self, seen: dict[str, list[Fix]], share: float) -> list[Fix]:
        return list(seen[self.floor]) if self.rng.random() < share else []

    def near(self, seen: dict[str, list[Fix]], map_from_cam: Array, cov: Array, _: object = ()) -> Fix | None:
        return first_near(self._found(seen, SEEN_SHARE), map_from_cam, cov)

    def anywhere(
        self, seen: dict[str, list[Fix]], near: object = None, _: object = None, found: Any = (), failed: Any = None
    ) -> Generator[None, None, list[Fix]]:
        yield
        new = self._found(seen, COMPARED_SHARE if near is not None and failed is None else SEEN_SHARE)
        return list(found) or new


@dataclass
class LiftWorld:
    """A robot in a building. likeness: inliers of a fix on each other floor as a share of those on its own; 0 for none.

    has_stock: pallets stand at the same places on every floor, with other goods; without, floors are equal.
    """

    floors: int
    likeness: float
    seed: int
    has_imu: bool = True
    has_stock: bool = False
    track: dict[str, Any] = field(default_factory=dict)
    level: int = 0
    frames: int = 0
    driven_m: float = 0.0  # since the doors opened
    wrong: int = 0  # frames with a wrong claim, but during rides

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        self.keys = ["", *(f"floor-{n}" for n in range(1, self.floors))]
        self.fixes: dict[str, list[Fix]] = {key: [] for key in self.keys}
        self.odometry = Odometry()
        self.localizer = scripted_localizer(self.odometry, self.track, NOISE if self.has_imu else None)
        # Each map has its own origin and heading in the building.
        frames = [BuildingFrame(x_m=5.0 * n, y_m=-2.0 * n, yaw_rad=0.4 * n) for n in range(self.floors)]
        self.map_from_plan = [se3_inverse(frame.building_from_map) for frame in frames]
        held = {}
        for n, (key, frame) in enumerate(zip(self.keys, frames, strict=True)):
            ring = (self.map_from_plan[n] @ np.c_[CABIN, np.zeros(4), np.ones(4)].T).T[:, :2]
            entry = FloorEntry(site=key or "own", level=f"L{n}", height_m=STOREY_M * n)
            held[key] = Floor(entry, frame, {"A": ((ring,),)})
        self.localizer.handle_building(held)
        with patch.object(module, "Relocalizer", lambda floor, *_: Relocalizer(floor, self.fixes, self.rng)):
            for key in self.keys:
                self.localizer.handle_version(1, key, None, ALIAS_STEP_M, key)  # type: ignore[arg-type]
        self.plan_from_body = se3(np.eye(3), np.array([0.0, 0.0, 0.3]))
        pallets = [(x, y, 0.5) for x in (0.0, 2.0, 4.0, 6.0) for y in (-2.0, 2.0)]
        stock = np.concatenate([np.random.default_rng(5).uniform(0.0, 0.5, (12, 3)) + at for at in pallets])
        self._stock = np.tile(stock, (self.floors, 1, 1))
        self._looks = np.random.default_rng(7).integers(0, 256, (*self._stock.shape[:2], 32), np.uint8)
        self._bias_mps2 = self.rng.normal(0.0, 0.1)

    def redraw(self, number: int, lifts: dict[str, tuple[Rings, ...]]) -> None:
        """Draw other lifts on a floor."""
        floors = dict(self.localizer._lift.building)
        floors[self.keys[number]] = replace(floors[self.keys[number]], lifts=lifts)
        self.localizer.handle_building(floors)

    @property
    def map_from_body(self) -> Array:
        """Truth, in the map of the robot's floor."""
        return self.map_from_plan[self.level] @ self.plan_from_body

    def step(self, speed_mps: float, accel_mps2: Array | None = None, *, sees: bool = True) -> Estimate:
        """One frame. accel_mps2: of the cabin at the inertial samples since the frame before."""
        motion = se3(np.eye(3), np.array([speed_mps * FRAME_S, 0.0, 0.0]))
        self.plan_from_body = self.plan_from_body @ motion
        self.odometry.next_motion = motion
        self._look(sees=sees)
        count = round(IMU_HZ * FRAME_S)
        now_ns, step_ns = int((self.frames + 1) * FRAME_S * 1e9), int(1e9 / IMU_HZ)
        stamps = now_ns - step_ns * np.arange(count)[::-1]
        noise = NOISE.accel_noise_mps2_rthz * np.sqrt(IMU_HZ)
        self._bias_mps2 += self.rng.normal(0.0, NOISE.accel_walk_mps3_rthz * np.sqrt(FRAME_S))
        force = np.array([0.0, 0.0, 9.81 + self._bias_mps2]) + self.rng.normal(0, noise, (count, 3))
        force += self.rng.normal(0.0, 0.3 if speed_mps else 0.02, (count, 3))
        if accel_mps2 is not None:
            force[:, 2] += accel_mps2
        if self.has_imu:
            self.localizer.handle_imu(ImuSamples(stamps, np.zeros((count, 3)), force))
        wheel = WheelSample(now_ns - 10_000_000, np.array([speed_mps, 0.0, 0.0]), 0.0, 0.02, 0.01)
        self.localizer.handle_wheel([wheel])
        self.frames += 1
        self.driven_m += abs(speed_mps) * FRAME_S
        picture = self.rng.integers(0, 255, (480, 640), np.uint8)
        estimate = self.localizer.handle_stereo(RectifiedFrame(now_ns, picture, None, None))
        self.wrong += accel_mps2 is None and self.is_wrong(estimate)
        return estimate

    def _look(self, *, sees: bool) -> None:
        for number, key in enumerate(self.keys):
            share = 1.0 if number == self.level else self.likeness
            self.fixes[key] = [self._fix(number, share)] if sees and share > 0 else []

    def _fix(self, number: int, share: float) -> Fix:
        turn = se3(so3_exp(self.rng.normal(0, 0.001, 3)), np.zeros(3))
        map_from_body = self.map_from_plan[number] @ self.plan_from_body @ turn
        map_from_body[:3, 3] += self.rng.normal(0.0, 0.01, 3)
        covariance = np.diag([0.002**2] * 3 + [0.01**2] * 3)
        inliers = max(1, round(share * self.rng.normal(60, 8)))
        place, floor = map_from_body @ BODY_FROM_CAM, self.keys[number]
        fix = Fix(place, covariance, inliers, 20, alias_ratio=0.1, landmark_recall=0.6 * share, floor=floor)
        if not self.has_stock:
            return fix
        points, body = self._stock[number], self.plan_from_body[:3, 3]
        near = np.linalg.norm(points[:, :2] - body[:2], axis=1) < 5.0
        found = self.rng.random(int(near.sum())) < (0.4 if number == self.level else 0.03)
        there = self.map_from_plan[number]
        seen = points[near] @ there[:3, :3].T + there[:3, 3]
        ids = np.flatnonzero(near).astype(np.uint32)
        return replace(fix, covisible=CovisibleLandmarks(ids, seen, self._looks[number][near], found))

    def told(self, sigma_m: float = 0.1, level: int | None = None, **about: Any) -> None:
        """A prior at its place; level: in the map of another floor."""
        place = self.map_from_plan[self.level if level is None else level] @ self.plan_from_body
        covariance, stamp_ns = np.diag([0.02**2] * 3 + [sigma_m**2] * 3), int(self.frames * FRAME_S * 1e9) + 1
        self.localizer.handle_prior(PositionPrior(stamp_ns, place, covariance, **about))

    def drive(self, metres: float, *, sees: bool = True) -> list[Estimate]:
        speed_mps = float(np.sign(metres)) * SPEED_MPS
        return [self.step(speed_mps, sees=sees) for _ in range(round(abs(metres) / (SPEED_MPS * FRAME_S)))]

    def stand(self, seconds: float, *, sees: bool = False) -> list[Estimate]:
        return [self.step(0.0, sees=sees) for _ in range(round(seconds / FRAME_S))]

    def board(self) -> list[Estimate]:
        """Drive into the cabin, and wait there."""
        return [*self.drive(STAND_M), *self.stand(4.0)]

    def board_and_ride(self, level: int, **how: float) -> list[Estimate]:
        return [*self.board(), *self.ride(level, **how)]

    def ride(self, level: int, fastest_mps: float = 1.0, accel_mps2: float = 0.8) -> Iterator[Estimate]:
        """The cabin's ride to another floor; the doors are closed."""
        height_m = STOREY_M * (level - self.level)
        fastest_mps = min(fastest_mps, float(np.sqrt(abs(height_m) * accel_mps2)))
        start_s, count = fastest_mps / accel_mps2, round(IMU_HZ * FRAME_S)
        pulse = np.full(round(start_s * IMU_HZ), np.sign(height_m) * accel_mps2)
        accel = np.concatenate([pulse, np.zeros(round((abs(height_m) / fastest_mps - start_s) * IMU_HZ)), -pulse])
        accel = np.r_[accel, np.zeros(-len(accel) % count)]
        for part in accel.reshape(-1, count):
            yield self.step(0.0, part, sees=False)
        self.level = level

    def is_wrong(self, estimate: Estimate) -> bool:
        """True if it claims a place that is not its own."""
        if estimate.map_from_body is None or estimate.status not in {Status.TRACKING, Status.DEGRADED}:
            return False
        off_m = float(np.linalg.norm(estimate.map_from_body[:3, 3] - self.map_from_body[:3, 3]))
        return estimate.floor != self.keys[self.level] or off_m > WRONG_M

    def is_right(self, estimate: Estimate) -> bool:
        return estimate.status is Status.TRACKING and not self.is_wrong(estimate)


@dataclass
class RideResult:
    """Seconds and metres from the opening of the doors to the right floor, None for never; frames that claim a place in the ride."""

    found_s: float | None = None
    found_m: float | None = None
    claimed_while_riding: int = 0
    floors_named: set[str] = field(default_factory=set)


def ride(world: LiftWorld, level: int, out_m: float = 8.0, **how: float) -> RideResult:
    """Drive into the lift, ride, and back out of it; the camera looks at the cabin's back wall until the robot has left it."""
    result, wait_s = RideResult(), world.rng.uniform(1.5, 5.0)
    world.drive(7.0)
    world.drive(STAND_M - world.plan_from_body[0, 3], sees=False)
    world.stand(wait_s)
    begun = world.frames
    for estimate in world.ride(level, **how):
        result.claimed_while_riding += world.frames - begun > 5 and estimate.map_from_body is not None
        result.floors_named |= {h.floor for h in estimate.hypotheses}
    world.stand(2.0)
    opened, world.driven_m = world.frames, 0.0
    while world.driven_m < out_m:
        estimate = world.step(-SPEED_MPS, sees=world.plan_from_body[0, 3] < CABIN[0, 0])
        if result.found_s is None and world.is_right(estimate):
            result.found_s, result.found_m = (world.frames - opened) * FRAME_S, world.driven_m
    return result
