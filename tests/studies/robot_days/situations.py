"""What a robot-day of 16 hours holds: situations, how much of each, and where that figure comes from."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from fleetsim.motion.routes import Route
from fleetsim.scene.movers import Mover
from fleetsim.sensors.faults import Fault
from studies.robot_days.site import LAYOUT, Trip, random_route
from support.estimator.simulated_run import Smudge

Prior = Literal["dock", "none", "wrong aisle"]
_EVENT_S, _FIRST_S, _EVENTS = 12.0, 8.0, 3
_EVENT_TRIP_M, _TRIP_M = 60.0, 110.0


@dataclass(frozen=True, slots=True)
class Situation:
    """per_day: hours, or events, of it in a robot-day, with the source of that. trip: one drive of it.

    days: nights since the survey that made the map, one for each batch in turn. batches: at most so many; what weighs most is driven
    most. events: in one trip; 0 where the whole trip counts, by
    its hours. prior: what the robot is told where it begins.
    """

    name: str
    per_day: float
    source: str
    trip: Callable[[np.random.Generator], Trip]
    days: tuple[int, ...] = (1,)
    batches: int = 1
    events: int = 0
    prior: Prior = "dock"


def _driving(rng: np.random.Generator) -> Trip:
    return Trip((random_route(rng, _TRIP_M, stop_s=float(rng.uniform(3.0, 8.0))),))


def _fault(name: str, shortest_s: float, longest_s: float) -> Callable[[np.random.Generator], Trip]:
    """One event each twelve seconds of driving, of a random length."""

    def trip(rng: np.random.Generator) -> Trip:
        begins = _FIRST_S + _EVENT_S * np.arange(_EVENTS) + rng.uniform(-2.0, 2.0, _EVENTS)
        lasts = rng.uniform(shortest_s, longest_s, _EVENTS)
        faults = tuple(Fault(name, float(b), float(b + n)) for b, n in zip(begins, lasts, strict=True))
        return Trip((random_route(rng, _EVENT_TRIP_M),), faults=faults)

    return trip


def _start(rng: np.random.Generator) -> Trip:
    return Trip((random_route(rng, 45.0),))


def _dock(rng: np.random.Generator) -> Trip:
    """Down an aisle, up to the end wall, and a wait there, with nothing but the wall ahead."""
    aisle, at_right = int(rng.integers(LAYOUT.aisles)), bool(rng.integers(2))
    y_m, wall_m = LAYOUT.aisle_y_m(aisle), LAYOUT.length_m if at_right else 0.0
    inward = -1.0 if at_right else 1.0
    start, stop = wall_m + inward * float(rng.uniform(20.0, 28.0)), wall_m + inward * float(rng.uniform(1.5, 1.8))
    return Trip((Route(((start, y_m), (stop, y_m)), rest_s=12.0),))


def _carried(rng: np.random.Generator) -> Trip:
    return Trip((random_route(rng, 15.0), random_route(rng, 45.0)))


def _met(kind: str, count: int, speed_mps: float, beside_m: float) -> Callable[[np.random.Generator], Trip]:
    """So many people or vehicles that go to and fro in the robot's first aisle, past which it drives."""

    def trip(rng: np.random.Generator) -> Trip:
        route = random_route(rng, 45.0)
        (start_x, y_m), (end_x, _) = route.way_points_map[:2]
        middle_y = LAYOUT.aisle_y_m(LAYOUT.chunk_at(start_x, y_m)[1])
        movers = []
        for _ in range(count):
            x_m, reach_m = float(rng.uniform(*sorted((start_x, end_x)))), float(rng.uniform(1.0, 4.0))
            side_y = middle_y + (beside_m if y_m < middle_y else -beside_m)
            stations = ((x_m - reach_m, side_y), (x_m + reach_m, side_y))
            movers.append(Mover(kind, stations, speed_mps, float(rng.uniform(0.0, 4 * reach_m))))
        return Trip((route,), movers=tuple(movers))

    return trip


def _smudged(rng: np.random.Generator) -> Trip:
    smudge = Smudge(float(rng.uniform(0, 640)), float(rng.uniform(0, 480)), float(rng.uniform(60.0, 160.0)))
    return replace(_driving(rng), smudge=smudge)


_GUESS = "assumption"
SITUATIONS = {
    s.name: s
    for s in (
        Situation("driving, stock 1 night old", 13.6, "assumption: 85 % of it", _driving),
        Situation("driving, 2 or 3 nights old", 1.6, "assumption: 10 %", _driving, (3, 2)),
        Situation("driving, 4 to 7 nights old", 0.8, "assumption: 5 %", _driving, (7, 5, 4, 6)),
        Situation("driving, a smudge on the lens", 0.16, "assumption: 1 % of it", _smudged),
        Situation("people met in the aisle", 200, _GUESS, _met("person", 2, 1.2, 0.75), events=2),
        Situation("a forklift met in the aisle", 60, _GUESS, _met("forklift", 1, 0.8, 0.6), events=1),
        Situation("a person right in front for 1 to 4 s", 20, _GUESS, _fault("person-in-front", 1.0, 4.0), events=_EVENTS),
        Situation("glare for 1 to 2 s", 10, _GUESS, _fault("over-exposure", 1.0, 2.0), events=_EVENTS),
        Situation("docking", 16, "assumption: once an hour", _dock, events=1),
        Situation("black for 1 to 2 s", 2, _GUESS, _fault("camera-dark", 1.0, 2.0), events=_EVENTS),
        Situation("no frames for 0.3 to 1.5 s", 1, _GUESS, _fault("frames-dropped", 0.3, 1.5), events=_EVENTS),
        Situation("no IMU for 0.2 to 0.5 s", 0.5, _GUESS, _fault("imu-gap", 0.2, 0.5), events=_EVENTS),
        Situation("wheels slip for 1 to 3 s", 20, _GUESS, _fault("wheel-slip", 1.0, 3.0), events=_EVENTS),
        Situation("restart anywhere, told nothing", 0.2, _GUESS, _start, events=1, prior="none"),
        Situation("restart, told a wrong aisle", 0.02, "assumption: one restart in ten", _start, events=1, prior="wrong aisle"),
        Situation("carried while it runs", 0.02, "assumption: once in 50 robot-days", _carried, events=1),
    )
}  # fmt: skip
