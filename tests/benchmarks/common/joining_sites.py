"""Sites, their maps and sessions in them without pictures, as the test of joining takes them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.estimator_loop import is_new_place, run_odometry, seen, survey_map
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.relocalization.map_view import MapView
from fleetmap.relocalization.relocalizer import Relocalizer
from fleetmap.sensors.samples import SensorSet
from fleetsim import recorder
from fleetsim.motion import Route
from fleetsim.scenarios import SCENARIOS, Run
from fleetsim.scene.world import World
from mapserver.config import survey_settings
from mapserver.survey.merge.confirmation import firm_landmarks
from mapserver.survey.merge.guided_matching import session_relocalization
from mapserver.survey.merge.membership import MembershipTest, SessionKeyframes
from mapserver.survey.odometry_pass import FrameChain
from mapserver.survey.pose_graph.odometry_factors import chain_edges
from support.estimator.landmarks import LandmarkField, Landmarks
from support.estimator.simulated_run import EstimatorSession, unpictured

SETTINGS = survey_settings(None, SensorSet.STEREO_INERTIAL)
RATE_HZ = 7.5
_SHARED_ABOVE_M = 3.0


@dataclass(frozen=True, slots=True)
class Site:
    """A building: a scenario's layout with its stock by a seed."""

    scenario: str
    seed: int

    def route(self, *, is_reversed: bool = False) -> Route:
        """The survey's route."""
        points = next(iter(SCENARIOS[self.scenario]().runs.values())).routes[0].way_points_map
        return Route(points[::-1] if is_reversed else points)


@dataclass(frozen=True)
class Drive:
    """A session before anyone says where it belongs: the visit without docks, and map_from_body (K, 4, 4) of its keyframes."""

    visit: SessionKeyframes
    map_from_body: Array

    def docks(self, shift_m: float = 0.0, turn_rad: float = 0.0) -> Array:
        """map_from_survey as docks of its own building say, put wrong by a shift and a turn."""
        true = self.map_from_body[0] @ se3_inverse(self.visit.survey_from_body[0])
        turn = so3_exp(np.array([0.0, 0.0, turn_rad]))
        return se3(turn, np.array([shift_m, -0.6 * shift_m, 0.0])) @ true


@dataclass(frozen=True)
class SiteMap:
    """A site's map as the test takes it, at its true places."""

    relocalizer: Relocalizer
    firm: NDArray[np.bool_]

    def test(self, drive: Drive, docks: Array | None) -> MembershipTest:
        """The test of a drive in it."""
        return MembershipTest(
            self.relocalizer, self.firm, replace(drive.visit, map_from_survey=docks), SETTINGS.sessions
        )


def cut(route: Route, start_m: float, length_m: float) -> Route:
    """A part of a route, by metres along its way points."""
    points = np.array(route.way_points_map)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    end_m = min(start_m + length_m, along[-1])
    inner = points[(along > start_m + 1.0) & (along < end_m - 1.0)]
    ends = [np.array([np.interp(at, along, points[:, axis]) for axis in range(2)]) for at in (start_m, end_m)]
    return Route(tuple((float(x), float(y)) for x, y in [ends[0], *inner, ends[1]]))


def length_m(route: Route) -> float:
    """Of its way points."""
    return float(np.linalg.norm(np.diff(np.array(route.way_points_map), axis=0), axis=1).sum())


class _OwnLooks(LandmarkField):
    """Landmarks that look as one building's do: textures are painted by its seed, which their numbers alone do not say.

    What halls share stays alike in all of them: in pictures of two buildings of one layout that is what lies above the racks.
    """

    def __init__(self, world: World) -> None:
        super().__init__(world)
        self._paint = np.uint64((world.seed + 1) * 0x9E3779B97F4A7C15 & (1 << 64) - 1)

    def chunk(self, column: int, row: int) -> Landmarks:
        """As the field's, made once."""
        is_new = (column, row) not in self._chunks
        marks = super().chunk(column, row)
        if is_new:
            marks.keys[marks.points_map[:, 2] < _SHARED_ABOVE_M, 0] ^= self._paint
        return marks


@lru_cache(maxsize=6)
def _field(scenario: str, seed: int, day: int) -> LandmarkField:
    return _OwnLooks(_world(scenario, seed, day))


@lru_cache(maxsize=6)
def _world(scenario: str, seed: int, day: int) -> World:
    return World(SCENARIOS[scenario]().layout, seed=seed, day=day, workers=None)


def session(site: Site, day: int, route: Route, name: str, robot: str = "surveyor") -> EstimatorSession:
    """A run of a robot of this name along a route on a day; names make noise of their own."""
    here = replace(SCENARIOS[site.scenario](), runs={name: Run(robot, (route,), rate_hz=RATE_HZ)})
    world = _world(site.scenario, site.seed, day)
    with patch.object(recorder, "World", lambda *_, **__: world):
        prepared = unpictured(recorder.Order(f"{site.scenario}-joining", seed=site.seed, day=day), here)
    return EstimatorSession(prepared, field=_field(site.scenario, site.seed, day))


def drive(run: EstimatorSession) -> Drive:
    """The session as its odometry and features show it, a keyframe each 0.4 m or 0.2 rad."""
    trajectory = FrameChain()
    for estimate in run_odometry(run):
        trajectory.append(estimate)
    placed = trajectory.odom_from_body()
    frames: list[int] = []
    for frame in range(len(run)):
        if not frames or is_new_place(placed[frames[-1]], placed[frame]):
            frames.append(frame)
    known: dict[str, Any] = {"covariances": trajectory.covariances(), "inertial": trajectory.estimates[-1].inertial}
    guess: Any = SimpleNamespace(keyframe_frames=frames, odom_from_body=placed, **known)
    state: Any = SimpleNamespace(map_from_body=placed[frames])
    keyframes = [seen(run, frame) for frame in frames]
    visit = SessionKeyframes(keyframes, placed[frames], chain_edges(guess, state), run.camera, run.body_from_cam[None])
    return Drive(visit, run.map_from_body[frames])


def site_map(run: EstimatorSession) -> SiteMap:
    """The map that a run makes."""
    tiles, vocabulary = survey_map(run, np.random.default_rng(run.session.order.seed))
    view = MapView(tiles, vocabulary, run.camera.focal_px)
    firm = firm_landmarks(len(view.points_map), np.concatenate(view.place_rows).astype(np.int32))
    return SiteMap(Relocalizer(view, run.camera, session_relocalization(SETTINGS)), firm)


def error_m(placed_map_from_body: Array, true_map_from_body: Array, ks: Sequence[int]) -> float:
    """Median distance from the truth of keyframes ks."""
    off = placed_map_from_body[list(ks), :3, 3] - true_map_from_body[list(ks), :3, 3]
    return float(np.median(np.linalg.norm(off, axis=1)))
