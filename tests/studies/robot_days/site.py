"""A block of the fulfilment centre, the map of its survey, and trips of robots through it; all at the estimator's level."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from benchmarks.common import estimator_loop
from benchmarks.robot.aliased_starts import RememberingSession, within_budget
from fleetmap.relocalization.map_view import MapView
from fleetsim.motion import Route
from fleetsim.recorder import Order, Session
from fleetsim.scenarios import Run, Scenario
from fleetsim.scene.layout import Layout
from fleetsim.scene.movers import Mover
from fleetsim.scene.world import World
from fleetsim.sensors import Fault
from support.estimator.landmarks import LandmarkField
from support.estimator.simulated_run import EstimatorSession, Smudge, unpictured

# Aisles, bays and cross aisles of the scenario fulfilment-centre, six of its sixty aisles, without its packing area.
LAYOUT = Layout(aisles=6, bays=33, aisle_width_m=2.3, cross_bays=(11, 22), are_aisles_identical=True)
NAME, DAY_S = "warehouse-block", 57_600.0
_SURVEY_RATE_HZ, _PLACE_EVERY_M = 5.0, 0.8
_END_M, _ASIDE_M = 2.7, 0.3
_REMEMBERED = 500  # stretches of half a metre: more than the longest drive has
Point = tuple[float, float]


class Trip(NamedTuple):
    """A robot's drive: its routes, one more for each time that it is carried, and what goes wrong on the way.

    name: of the way. Trips of one name share ripple, wear and noise, so that they differ in what goes wrong alone.
    """

    name: str
    routes: tuple[Route, ...]
    faults: tuple[Fault, ...] = ()
    movers: tuple[Mover, ...] = ()
    smudge: Smudge | None = None


def lines_x_m() -> list[float]:
    """Where robots change aisles: the ends and the cross aisles."""
    across = [LAYOUT.bay_x_m(bay) + LAYOUT.bay_m / 2 for bay in LAYOUT.cross_bays]
    return [LAYOUT.dock_m + _END_M, *across, LAYOUT.length_m - _END_M]


def survey_route() -> Route:
    """Every aisle and every line between aisles in both directions."""
    left, one, two, right = lines_x_m()
    y = [LAYOUT.aisle_y_m(aisle) for aisle in range(LAYOUT.aisles)]
    points = [(left, y[0])]
    for out, back in ((0, 1), (2, 3), (4, 5), (1, 0), (3, 2), (5, 4)):
        points += [(left, y[out])] if points[-1] != (left, y[out]) else []
        points += [(right, y[out]), (right, y[back]), (left, y[back])]
    down, up = ((left, 5), (one, 5), (one, 0), (two, 0)), ((two, 5), (right, 5), (right, 0), (one, 0))
    across = (*down, *up, (one, 5), (two, 5), (two, 0), (right, 0))
    return Route((*points, *((x, y[aisle]) for x, aisle in across)))


def random_route(rng: np.random.Generator, length_m: float, stop_s: float = 0.0) -> Route:
    """A walk through aisles and cross aisles from the middle of an aisle, at least so long; `stop_s`: one wait in its third leg."""
    xs, aisle = lines_x_m(), int(rng.integers(LAYOUT.aisles))
    segment, ahead = int(rng.integers(len(xs) - 1)), int(rng.choice((-1, 1)))
    start_x = float(rng.uniform(xs[segment] + 6.0, xs[segment + 1] - 6.0))
    y_m = LAYOUT.aisle_y_m(aisle) + float(rng.uniform(-_ASIDE_M, _ASIDE_M))
    points: list[Point] = [(start_x, y_m)]
    line, driven_m = segment + (ahead > 0), 0.0
    while driven_m < length_m:
        x_m = xs[line]
        goes_on = 0 <= line + ahead < len(xs)
        if goes_on and rng.random() < 0.4:
            line += ahead
        else:
            aisle = int(rng.choice([a for a in range(LAYOUT.aisles) if a != aisle]))
            points.append((x_m, y_m))
            driven_m += abs(points[-1][0] - points[-2][0])
            after_m = LAYOUT.aisle_y_m(aisle) + float(rng.uniform(-_ASIDE_M, _ASIDE_M))
            driven_m += abs(after_m - y_m)
            y_m = after_m
            points.append((x_m, y_m))
            ahead = int(rng.choice([way for way in (-1, 1) if 0 <= line + way < len(xs)]))
            line += ahead
    # The walk ends in the aisle that it has turned into.
    points.append((points[-1][0] + ahead * 8.0, y_m))
    stops: tuple[tuple[int, float], ...] = ()
    if stop_s:
        wait_x = start_x + 0.5 * (points[1][0] - start_x)
        points.insert(1, (wait_x, points[0][1]))
        stops = ((1, stop_s),)
    return Route(tuple(points), stops)


def prepared(seed: int, day: int, name: str, run: Run, movers: tuple[Mover, ...] = ()) -> Session:
    """A run ready but for pictures, of which there are none; motion's ripple and the sensors' errors follow from the name."""
    scenario = Scenario("a block of the fulfilment centre", LAYOUT, {name: run}, movers)
    return unpictured(Order(NAME, seed=seed, day=day), scenario)


@lru_cache(maxsize=3)
def surveyed_view(seed: int) -> MapView:
    """The map that robots get of a survey on day 0, when every aisle looks like every other.

    Minutes of CPU; true places with an error of 10 mm to each landmark, and no more landmarks than `mapserver` publishes.
    """
    run = Run("surveyor", (survey_route(),), rate_hz=_SURVEY_RATE_HZ, is_sharp=True)
    survey = EstimatorSession(prepared(seed, 0, "survey", run))
    rng = np.random.default_rng(seed)
    (tile,), vocabulary = estimator_loop.survey_map(survey, rng, every_m=_PLACE_EVERY_M)
    tile = within_budget(tile, survey.camera, survey.body_from_cam)
    return MapView([tile], vocabulary, survey.camera.focal_px)


@lru_cache(maxsize=2)
def _field(seed: int, day: int) -> LandmarkField:
    return LandmarkField(World(LAYOUT, seed=seed, day=day), remembered=_REMEMBERED)


def driven(seed: int, day: int, trip: Trip) -> RememberingSession:
    """The trip on a day, `day` nights after the survey."""
    run = Run("runner", trip.routes, faults=trip.faults)
    return RememberingSession(prepared(seed, day, trip.name, run, trip.movers), _field(seed, day), trip.smudge)
