"""What a robot-day of 16 hours holds: situations, how much of each, and where that figure comes from."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np

from fleetsim.motion import Route
from fleetsim.scene.movers import patrol
from fleetsim.sensors import Fault
from studies.robot_days.site import LAYOUT, Trip, random_route
from support.estimator.simulated_run import Smudge

Prior = Literal["dock", "none", "wrong aisle"]
_FIRST_S, _RECOVERS_S, _LAST_S = 8.0, 6.0, 90.0  # of events in a drive: the first, from one's end to the next, the last
_TRIP_M, _SHORT_M = 110.0, 45.0
_LEG_M = 8.0  # a stretch of aisle in which others are met is at least so long
_WAYS, _OWN = 7001, 7002  # streams of random numbers
TripOf = Callable[[Route, np.random.Generator], Trip]


@dataclass(frozen=True, slots=True)
class Situation:
    """per_day: hours, or events, of it in a robot-day, with the source of that. trip: a drive along a way, with what is random in it.

    kind: what its drives are counted by. days: nights since the survey that made the map, one for each drive in turn. drives: of a
    whole run; what weighs most is driven most. length_m: of the way; those of one length share their ways. prior: what the robot is
    told where it begins.
    """

    name: str
    per_day: float
    source: str
    trip: TripOf
    drives: int
    kind: Literal["hours", "events"] = "events"
    days: tuple[int, ...] = (1,)
    length_m: float = _TRIP_M
    prior: Prior = "dock"

    def day(self, number: int) -> int:
        """Nights since the survey, of the drive of that number."""
        return self.days[number % len(self.days)]

    def trip_of(self, seed: int, number: int) -> Trip:
        """Its drive of that number."""
        on_way = np.random.default_rng([seed, _WAYS, int(self.length_m), number])
        way = random_route(
            on_way, self.length_m, stop_s=float(on_way.uniform(3.0, 8.0)) if self.length_m >= _TRIP_M else 0.0
        )
        trip = self.trip(way, np.random.default_rng([seed, _OWN, zlib.crc32(self.name.encode()), number]))
        return trip._replace(name=trip.name or f"way-{self.length_m:g}-{number}")


def _driving(way: Route, rng: np.random.Generator) -> Trip:
    return Trip("", (way,))


def _fault(name: str, shortest_s: float, longest_s: float, way: Route, rng: np.random.Generator) -> Trip:
    """Events of a random length, each long enough after the last one for a robot to have recovered: five seconds of good tracking end
    a failure."""
    faults, begins = [], _FIRST_S + float(rng.uniform(0.0, 2.0))
    while begins < _LAST_S:
        ends = begins + float(rng.uniform(shortest_s, longest_s))
        faults.append(Fault(name, begins, ends))
        begins = ends + _RECOVERS_S + float(rng.uniform(0.0, 2.0))
    return Trip("", (way,), faults=tuple(faults))


def _dock(way: Route, rng: np.random.Generator) -> Trip:
    """Down an aisle, up to the end wall, and a wait there, with nothing but the wall ahead."""
    aisle, at_right = int(rng.integers(LAYOUT.aisles)), bool(rng.integers(2))
    y_m, wall_m = LAYOUT.aisle_y_m(aisle), LAYOUT.length_m if at_right else 0.0
    inward = -1.0 if at_right else 1.0
    start, stop = wall_m + inward * float(rng.uniform(14.0, 20.0)), wall_m + inward * float(rng.uniform(1.5, 1.8))
    return Trip(f"dock-{aisle}-{start:.3f}", (Route(((start, y_m), (stop, y_m)), rest_s=8.0),))


def _carried(way: Route, rng: np.random.Generator) -> Trip:
    before = random_route(rng, 10.0)
    return Trip(f"carried-{before.way_points_map[0][0]:.3f}", (before, way))


def _met(kind: str, count: int, speed_mps: float, beside_m: float, way: Route, rng: np.random.Generator) -> Trip:
    """So many people or vehicles that go to and fro in each aisle that the robot passes."""
    movers = []
    for (start_x, y_m), (end_x, end_y) in pairwise(way.way_points_map):
        if y_m != end_y or abs(end_x - start_x) < _LEG_M:
            continue
        middle_y = LAYOUT.aisle_y_m(LAYOUT.chunk_at(start_x, y_m)[1])
        side_y = middle_y + (beside_m if y_m < middle_y else -beside_m)
        for _ in range(count):
            x_m, reach_m = float(rng.uniform(*sorted((start_x, end_x)))), float(rng.uniform(1.0, 4.0))
            stations = ((x_m - reach_m, side_y), (x_m + reach_m, side_y))
            movers.append(patrol(kind, stations, speed_mps, float(rng.uniform(0.0, 4 * reach_m))))
    return Trip("", (way,), movers=tuple(movers))


def _smudged(way: Route, rng: np.random.Generator) -> Trip:
    smudge = Smudge(float(rng.uniform(0, 640)), float(rng.uniform(0, 480)), float(rng.uniform(60.0, 160.0)))
    return Trip("", (way,), smudge=smudge)


_GUESS = "assumption"
SITUATIONS = {
    s.name: s
    for s in (
        Situation("driving, stock 1 night old", 13.6, "assumption: 85 % of it", _driving, 24, "hours"),
        Situation("driving, 2 or 3 nights old", 1.6, "assumption: 10 %", _driving, 8, "hours", (3, 2)),
        Situation("driving, 4 to 7 nights old", 0.8, "assumption: 5 %", _driving, 8, "hours", (7, 5)),
        Situation("driving, a smudge on the lens", 0.16, "assumption: 1 % of it", _smudged, 8, "hours"),
        Situation("people met in the aisle", 200, _GUESS, partial(_met, "person", 2, 1.2, 0.75), 16),
        Situation("a forklift met in the aisle", 60, _GUESS, partial(_met, "forklift", 1, 0.8, 0.6), 12),
        Situation("a person right in front for 1 to 4 s", 20, _GUESS, partial(_fault, "person-in-front", 1.0, 4.0), 12),
        Situation("glare for 1 to 2 s", 10, _GUESS, partial(_fault, "over-exposure", 1.0, 2.0), 8),
        Situation("docking", 16, "assumption: once an hour", _dock, 16, length_m=0.0),
        Situation("black for 1 to 2 s", 2, _GUESS, partial(_fault, "camera-dark", 1.0, 2.0), 8),
        Situation("no frames for 0.3 to 1.5 s", 1, _GUESS, partial(_fault, "frames-dropped", 0.3, 1.5), 8),
        Situation("no IMU for 0.2 to 0.5 s", 0.5, _GUESS, partial(_fault, "imu-gap", 0.2, 0.5), 8),
        Situation("wheels slip for 1 to 3 s", 20, _GUESS, partial(_fault, "wheel-slip", 1.0, 3.0), 8),
        Situation("restart anywhere, told nothing", 0.2, _GUESS, _driving, 32, length_m=_SHORT_M, prior="none"),
        Situation(
            "restart, told a wrong aisle", 0.02, "assumption: one restart in ten", _driving, 16, length_m=_SHORT_M, prior="wrong aisle"
        ),
        Situation("carried while it runs", 0.02, "assumption: once in 50 robot-days", _carried, 8, length_m=_SHORT_M),
    )
}  # fmt: skip
