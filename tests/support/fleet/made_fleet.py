"""Synthetic robots that report like real ones, with known failures: for tests and benchmarks of statistics."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from fleetmap.messages import FailureReport, FixNote, Placement, PoseMessage, RobotHealth, Thumbnail
from mapserver.fleet.fleet import Fleet

BLIND_STEPS = 4  # seconds without a place after a failure begins; its report comes when they are over
GOOD_STEPS = 8
SPEED_MPS = 1.2
NS = 1_000_000_000

Message = RobotHealth | PoseMessage | FailureReport


@dataclass
class Known:
    """Generated events, to compare with the counted ones."""

    failures: Counter[tuple[str, str]] = field(default_factory=Counter)
    suspected: Counter[tuple[str, str]] = field(default_factory=Counter)
    driving_s: Counter[tuple[str, str]] = field(default_factory=Counter)
    health: int = 0
    estimates: int = 0
    reports: int = 0

    def count(self, counter: Counter[tuple[str, str]], amount: float, **keys: str) -> None:
        """Adds to each marginal."""
        for axis, key in keys.items():
            counter[axis, key] += amount  # type: ignore[assignment]


class MadeRobot:
    """Drives to and fro along x through `tiles` of `tile_m`; fails with a chance of `rate_per_robot_day`, in some tile more often.

    ahead_s: error of its wall clock. bad_tile: tile in which it fails `bad_factor` times as often.
    """

    def __init__(
        self, site: str, name: str, rng: np.random.Generator, known: Known, *, version: int = 1,
        rate_per_robot_day: float = 2.0, tiles: int = 2, tile_m: float = 16.0, ahead_s: float = 0.0,
        bad_tile: int | None = None, bad_factor: float = 20.0, cause: str = "dark", suspected_share: float = 0.0,
    ) -> None:  # fmt: skip
        self.site, self.name, self.version = site, name, version
        self._rng, self._known = rng, known
        self._chance = rate_per_robot_day / 57600.0
        self._length_m, self._tile_m = tiles * tile_m, tile_m
        self._ahead_ns = round(ahead_s * NS)
        self._bad = (bad_tile, bad_factor)
        self.rate_factor = 1.0
        self._cause, self._suspected_share = cause, suspected_share
        self._way_m = float(rng.uniform(0, self._length_m))
        self._step = self._failures = self._blind = self._good = 0
        self._begun: tuple[int, int, str] | None = None

    @property
    def x_m(self) -> float:
        """Its position."""
        way_m = self._way_m % (2 * self._length_m)
        return min(max(1e-3, way_m if way_m < self._length_m else 2 * self._length_m - way_m), self._length_m - 1e-3)

    @property
    def tile(self) -> tuple[int, int]:
        """Its tile."""
        return int(self.x_m // self._tile_m), 0

    def second(self, now_ns: int) -> list[Message]:
        """Messages of the last second: two poses, one health, and a report if a failure is over."""
        said: list[Message] = [self._estimate(now_ns - NS // 2, 0.5), self._estimate(now_ns, 0.5)]
        status = self._fail(now_ns)
        if self._step > 0:
            key = f"{self.tile[0]},{self.tile[1]}"
            self._known.count(self._known.driving_s, 1.0, site="", robot=self.name, version=str(self.version), tile=key)
        self._step += 1
        said.append(self._health(now_ns, status))
        self._known.health += 1
        self._known.estimates += 2
        if self._begun is not None and self._blind == 0:
            said.append(self._report(now_ns))
        return said

    def _fail(self, now_ns: int) -> str:
        if self._blind > 0:
            self._blind -= 1
        elif self._good > 0:
            self._good -= 1
        elif self._step > 3:
            factor = self._bad[1] if self.tile[0] == self._bad[0] else 1.0
            if self._rng.random() < self._chance * factor * self.rate_factor:
                kind = "suspected" if self._rng.random() < self._suspected_share else "blind"
                self._begun = (now_ns, self._step, kind)
                self._place = (self.tile, self.x_m)
                self._blind, self._good = (BLIND_STEPS, GOOD_STEPS) if kind == "blind" else (0, GOOD_STEPS)
        return "LOST" if self._blind > 0 else "TRACKING"

    def _report(self, now_ns: int) -> FailureReport:
        begun_ns, _, kind = self._begun
        self._begun = None
        self._failures += 1
        counter = self._known.suspected if kind == "suspected" else self._known.failures
        keys = {"robot": self.name, "version": str(self.version), "tile": f"{self._place[0][0]},{self._place[0][1]}"}
        self._known.count(counter, 1, site="", cause=self._cause, **keys)
        self._known.reports += 1
        return FailureReport(
            site=self.site, robot=self.name, id=f"{self.name}-{self._failures}", stamp_ns=begun_ns,
            wall_ns=begun_ns + self._ahead_ns, duration_s=(now_ns - begun_ns) / NS, kind=kind,
            status="LOST" if kind == "blind" else "TRACKING", cause=self._cause, version=self.version, tile=self._place[0],
            map_from_base=Placement(position_m=(self._place[1], 1.0, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0)),
            innovation=30.0, inliers=12, fixes=(FixNote(stamp_ns=begun_ns, status="TRACKING", inliers=40),),
            thumbnails=(Thumbnail(stamp_ns=begun_ns, kind="frame", jpeg=b"\xff\xd8 not quite a picture \xff\xd9"),),
        )  # fmt: skip

    def _estimate(self, stamp_ns: int, dt_s: float) -> PoseMessage:
        self._way_m += SPEED_MPS * dt_s
        return PoseMessage(
            stamp_ns=stamp_ns, position_map_m=(self.x_m, 1.0, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0),
            cov_rot_trans=(0.0,) * 36, status="TRACKING", map_version=self.version,
        )  # fmt: skip

    def _health(self, now_ns: int, status: str) -> RobotHealth:
        return RobotHealth(
            site=self.site, robot=self.name, stamp_ns=now_ns, wall_ns=now_ns + self._ahead_ns, version=self.version,
            status=status,
            metrics={
                "speed_mps": SPEED_MPS, "radius_95_m": 0.02, "frames": 20 * self._step, "frames_dropped": self._step // 10,
                "frame_ms_mean": 18.0, "first_fix_s": 1.5, "fix_innovation": 5.0, "fix_innovation_m": 0.01,
                "landmarks_expected": 1000 * self._step, "landmarks_seen": 700 * self._step,
            },
        )  # fmt: skip


def drive(robots: list[MadeRobot], seconds: int, start_ns: int) -> Iterator[tuple[int, MadeRobot, Message]]:
    """Messages of the robots, second by second: time, robot, message."""
    for step in range(1, seconds + 1):
        now_ns = start_ns + step * NS
        for robot in robots:
            for message in robot.second(now_ns):
                yield now_ns, robot, message


def hear(
    fleet: Fleet, said: Iterable[tuple[int, MadeRobot, Message]], set_ns: Callable[[int], object]
) -> list[FailureReport]:
    """The server takes all of it, its clock set to each moment; the failures among it."""
    reports = []
    for now_ns, robot, message in said:
        set_ns(now_ns)
        if isinstance(message, RobotHealth):
            fleet.take_health(robot.site, robot.name, message)
        elif isinstance(message, PoseMessage):
            fleet.take_pose(robot.site, robot.name, message)
        else:
            assert fleet.take_failure(robot.site, robot.name, message).refused == ""
            reports.append(message)
    fleet.flush()
    return reports
