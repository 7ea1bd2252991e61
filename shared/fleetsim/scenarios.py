"""The scenarios, smallest first. To add one: a line in SCENARIOS."""

from dataclasses import dataclass, replace
from math import pi

import msgspec

from fleetmap.errors import chosen
from fleetsim.motion import Route
from fleetsim.scene.layout import Layout
from fleetsim.scene.movers import Mover, patrol
from fleetsim.sensors import ROBOTS, Fault, RobotKind


@dataclass(frozen=True, slots=True)
class Run:
    """One robot's drive. Several routes: the robot is carried from the end of one to the start of the next.

    storeys: on which the routes are; from one to the next the robot rides a lift, which is dark. is_sharp: without motion blur, as
    a survey at leisure with a short exposure.
    """

    robot: str
    routes: tuple[Route, ...]
    rate_hz: float = 15.0
    is_sharp: bool = False
    faults: tuple[Fault, ...] = ()
    zone_period_s: float = 0.0
    storeys: tuple[int, ...] = (0,)

    @property
    def kind(self) -> RobotKind:
        """The robot's model."""
        return ROBOTS[self.robot]


@dataclass(frozen=True, slots=True)
class Scenario:
    """A site with the runs that can be recorded in it, the first one by default."""

    description: str
    layout: Layout
    runs: dict[str, Run]
    movers: tuple[Mover, ...] = ()

    def run(self, name: str | None) -> tuple[str, Run]:
        """The named run, the first one for None; UsageError naming the known ones."""
        if name is None:
            return next(iter(self.runs.items()))
        return name, chosen("robot", name, self.runs)


_END_M = 2.7  # distance of the robots' routes from the end walls
_OVERLAP_M = 8.0  # driven again at the end of a route


def _loop(layout: Layout, first: int, last: int, *, shift_m: float = 0.0) -> Route:
    """Up one aisle, down another, and on along the first again."""
    y0, y1 = layout.aisle_y_m(first) + shift_m, layout.aisle_y_m(last) + shift_m
    left, right = layout.dock_m + _END_M, layout.length_m - _END_M
    return Route(((left, y0), (right, y0), (right, y1), (left, y1), (left, y0), (left + _OVERLAP_M, y0)))


def _zigzag(layout: Layout, left: float) -> list[tuple[float, float]]:
    """Way points through every aisle in turn, from `left` to the right end and back along the next one."""
    ends = left, layout.length_m - _END_M
    return [(end, layout.aisle_y_m(aisle)) for aisle in range(layout.aisles) for end in ends[:: -1 if aisle % 2 else 1]]


def _snake(layout: Layout) -> Route:
    """Route through every aisle, of an even number, and into the first one again."""
    points = _zigzag(layout, _END_M)
    return Route((*points, points[0], (_END_M + _OVERLAP_M, points[0][1])))


def _both_ways(layout: Layout) -> Route:
    """Every aisle twice, once in each direction. For six aisles."""
    left, right = _END_M, layout.length_m - _END_M
    y = [layout.aisle_y_m(aisle) for aisle in range(6)]
    points = [(left, y[0])]
    for out, back in ((0, 1), (2, 3), (4, 5), (1, 0), (3, 2), (5, 4)):
        points += [(left, y[out])] if points[-1] != (left, y[out]) else []
        points += [(right, y[out]), (right, y[back]), (left, y[back])]
    return Route(tuple(points))


def _small_loop() -> Scenario:
    layout = Layout(aisles=2, bays=4)
    y0, y1 = layout.aisle_y_m(0), layout.aisle_y_m(1)
    left, right = _END_M, layout.length_m - _END_M
    first = Route(((left + 0.3, y0 - 0.3), (right + 0.2, y0 - 0.3), (right + 0.2, y1 + 0.3), (11.0, y1 + 0.3)))
    second = Route(((16.0, y1 - 0.25), (left - 0.2, y1 - 0.25), (left - 0.2, y0 + 0.25), (15.0, y0 + 0.25)))
    runs = {
        "survey": Run("surveyor", (_loop(layout, 0, 1),), is_sharp=True),
        "tote-1": Run("tote", (first,)),
        "tote-2": Run("tote", (second,)),
        "runner-1": Run("runner", (first,)),
        "opposite-1": Run("runner", (Route(first.way_points_map[::-1]),)),
    }
    return Scenario("a loop through two aisles; what `make demo` records", layout, runs)


def _clip() -> Scenario:
    layout = Layout(aisles=2, bays=4)
    y = layout.aisle_y_m(0)
    straight = Route(((5.0, y), (8.0, y)), rest_s=0.5)
    turn = Route(((3.0, y - 0.2), (5.0, y - 0.2), (9.0, y + 0.2)), rest_s=0.5)
    runs = {
        "survey": Run("surveyor", (straight,), is_sharp=True),
        "tote-1": Run("tote", (turn,)),
        "carried": Run("tote", (turn, straight)),
    }
    return Scenario("three metres of one aisle, for tests and first looks", layout, runs)


def _five_aisles() -> Scenario:
    layout = Layout(aisles=5, bays=4)
    runs = {
        "survey": Run("surveyor", (_loop(layout, 0, 4),), is_sharp=True),
        "tote-1": Run("tote", (_loop(layout, 0, 4, shift_m=0.2),)),
    }
    return Scenario("a loop around five aisles, 80 m: what surveys are judged by", layout, runs)


def _busy() -> Scenario:
    layout = Layout(aisles=4, bays=9)
    y = [layout.aisle_y_m(aisle) for aisle in range(4)]
    middle, right = layout.length_m / 2, layout.length_m - _END_M
    movers = (
        patrol("person", ((8.0, y[0] + 0.8), (24.0, y[0] + 0.8)), 0.9),
        patrol("person", ((6.0, y[1] - 0.8), (20.0, y[1] - 0.8)), 1.1, 5.0),
        patrol("forklift", ((middle, y[2] + 0.7), (middle + 9, y[2] + 0.7)), 0.8),
        patrol("robot", ((4.0, y[3] - 0.7), (right, y[3] - 0.7)), 1.2),
        patrol("robot", ((9.0, y[0] - 0.8), (18.0, y[0] - 0.8)), 0.7),
    )
    passing = Route(((_END_M, y[0]), (right, y[0]), (right, y[1]), (_END_M, y[1])), stops=((1, 2.0),))
    runs = {
        "survey": Run("surveyor", (_snake(layout),), is_sharp=True),
        "tote-1": Run("tote", (passing,), zone_period_s=15.0),
        "pallet-1": Run("pallet-mover", (_loop(layout, 2, 3),), zone_period_s=15.0),
    }
    return Scenario("four aisles with people, a forklift and other robots", layout, runs, movers)


def _identical() -> Scenario:
    layout = Layout(aisles=6, bays=8, has_landmarks=False, are_aisles_identical=True)
    runs = {
        "survey": Run("surveyor", (_snake(layout),), is_sharp=True, zone_period_s=20.0),
        "survey-both-ways": Run("surveyor", (_both_ways(layout),), is_sharp=True, zone_period_s=20.0),
        "tote-1": Run("tote", (_loop(layout, 1, 2),), zone_period_s=20.0),
        "runner-1": Run("runner", (_loop(layout, 2, 1),), zone_period_s=20.0),
    }
    return Scenario("six aisles that look the same until stock is moved: aliasing", layout, runs)


def _marker_loop() -> Scenario:
    """Distances between its two markers give the scale of a survey."""
    loop = _small_loop()
    (x_m, end_m), (y0, y1) = (0.02, loop.layout.length_m - 0.02), (loop.layout.aisle_y_m(aisle) for aisle in (0, 1))
    markers = ((1, end_m, y0 - 0.6, 1.0, pi), (2, x_m, y1 + 0.6, 1.0, 0.0))  # beside the pallets
    layout = msgspec.structs.replace(loop.layout, markers=markers)
    return replace(loop, description="the small loop with a marker at each end", layout=layout)


def _marked_ends() -> Scenario:
    alike = _identical()
    marked = Layout(aisles=6, bays=8, are_aisles_identical=True)
    return replace(alike, description="the same with different signs, posters and pallets at their ends", layout=marked)


def _two_floors() -> Scenario:
    """Two small loops above each other; the lift stands between the aisles at their right end."""
    loop = _small_loop()
    first = loop.runs["tote-1"].routes[0].way_points_map
    lift = (first[1][0], loop.layout.width_m / 2)
    ride = Route((*first[:2], lift)), Route((lift, *first[2:]))
    survey = loop.runs["survey"]
    runs = {"ground": survey, "upper": replace(survey, storeys=(1,)), "tote-1": Run("tote", ride, storeys=(0, 1))}
    return replace(loop, description="two small loops above each other, and a lift that the robot rides", runs=runs)


def _faulty() -> Scenario:
    base = _small_loop()
    loop = base.runs["tote-1"].routes
    names = {
        "dark": Fault("camera-dark", 8.0, 10.0),
        "frozen": Fault("camera-frozen", 8.0, 11.0),
        "dropped": Fault("frames-dropped", 8.0, 9.5),
        "late": Fault("frames-late", 8.0, 12.0),
        "imu-gap": Fault("imu-gap", 8.0, 8.4),
        "imu-spike": Fault("imu-spike", 8.0, 8.1),
        "glare": Fault("over-exposure", 8.0, 11.0),
        "person": Fault("person-in-front", 8.0, 12.0),
        "slip": Fault("wheel-slip", 8.0, 11.0),
    }
    runs = {"survey": base.runs["survey"]} | {name: Run("tote", loop, faults=(fault,)) for name, fault in names.items()}
    runs["kidnapped"] = Run("tote", (loop[0], base.runs["tote-2"].routes[0]))
    return replace(base, description="the small loop with one fault per robot, eight seconds in", runs=runs)


def _fulfilment_centre() -> Scenario:
    layout = Layout(aisles=30, bays=33, aisle_width_m=2.3, dock_m=46.2, cross_bays=(11, 22), are_aisles_identical=True)
    left = layout.dock_m + _END_M
    across = layout.bay_x_m(layout.cross_bays[0]) + layout.bay_m / 2
    y = [layout.aisle_y_m(aisle) for aisle in range(layout.aisles)]
    # Along the ends on the docks' side and back through a cross aisle, which ties the aisles together, then every aisle once.
    points = [(left, y[0]), (left, y[-1]), (across, y[-1]), (across, y[1]), (left, y[1]), *_zigzag(layout, left)]
    runs = {
        "survey": Run("surveyor", (Route(tuple(points)),), is_sharp=True, zone_period_s=20.0),
        "tote-1": Run("tote", (_loop(layout, 13, 16, shift_m=0.2),), zone_period_s=20.0),
    }
    return Scenario("a centre of 20,000 m2: 30 like aisles, cross aisles, packing stations", layout, runs)


# Functions, so that listing them builds nothing.
SCENARIOS = {
    "clip": _clip,
    "small-loop": _small_loop,
    "faults": _faulty,
    "marker-loop": _marker_loop,
    "two-floors": _two_floors,
    "five-aisles": _five_aisles,
    "busy": _busy,
    "identical-aisles": _identical,
    "marked-ends": _marked_ends,
    "fulfilment-centre": _fulfilment_centre,
}
