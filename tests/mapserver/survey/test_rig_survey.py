"""Surveys of a rig with a second pair, or a depth camera, that looks back, without pictures: all views observe into one state."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.common.estimator_loop import SETTINGS as ROBOT
from benchmarks.common.estimator_loop import SessionRelocalizer, blank
from benchmarks.common.simulated_survey import SimulatedSurvey, drawn_alignment, simulated_survey
from fleetmap.bow.vocabulary import default_vocabulary
from fleetmap.geometry import Array, se3_inverse, se3_log
from fleetmap.relocalization.map_view import MapView
from fleetmap.sensors.samples import SensorSet
from fleetmap.time_sliced import finished
from fleetsim.motion import Route
from fleetsim.recorder import Order
from fleetsim.scenarios import SCENARIOS
from mapserver.config import survey_settings
from mapserver.survey.stages import Survey
from mapserver.tiles.tiling import tiles_from_survey
from support.estimator.landmarks import LandmarkField
from support.estimator.simulated_run import EstimatorSession, unpictured

SETTINGS = survey_settings(None, SensorSet.STEREO_INERTIAL)
_ALONG = "along"  # one way
_BACK = "back"  # and back on the other side of the aisle


def driven(name: str, day: int = 0, rig: str = "front-rear") -> list[EstimatorSession]:
    """All views of a drive in an aisle."""
    base = SCENARIOS["clip"]()
    y = base.layout.aisle_y_m(0)
    way = ((4.5, y - 0.4), (8.5, y - 0.4)) + (((8.5, y + 0.4), (4.5, y + 0.4)) if name == _BACK else ())
    runs = {name: replace(base.runs["survey"], routes=(Route(way, rest_s=0.5),), rate_hz=5.0)}
    session = unpictured(Order("clip", seed=4, day=day, robot=name, rig=rig), replace(base, runs=runs))
    field = LandmarkField(session.world)
    return [EstimatorSession(session, field=field, view=view) for view in range(len(session.nominal.views))]


@lru_cache(maxsize=6)
def surveyed(name: str, views: int, rig: str = "front-rear") -> tuple[SimulatedSurvey, Survey]:
    first, *others = driven(name, rig=rig)[:views]
    made = simulated_survey(first, SETTINGS, others)
    with drawn_alignment(made):
        return made, made.surveyed(SETTINGS)


def steps_off_m(made: SimulatedSurvey, done: Survey) -> float:
    """Root mean square error of all frames' positions as seen from the middle one."""

    def from_middle(map_from_body: Array) -> Array:
        return (se3_inverse(map_from_body[len(map_from_body) // 2]) @ map_from_body)[:, :3, 3]

    off = from_middle(done.map.trajectory.frame_from_body) - from_middle(made.map_from_body)
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def found(robot: EstimatorSession, views: int, rig: str, within_m: float) -> int:
    """In how many frames of another day's view a robot finds itself by the landmarks of a survey's first views; never elsewhere."""
    made, done = surveyed(_ALONG, views, rig)
    shift = made.map_from_body[0] @ se3_inverse(done.map.trajectory.frame_from_body[0])  # the truth at its beginning
    tiles = tiles_from_survey(done.map.transformed(shift))
    view = MapView(tiles, default_vocabulary(), done.map.camera.focal_px)
    relocalizer = SessionRelocalizer(view, robot, ROBOT)
    count = 0
    for number in range(0, len(robot), 4):
        fixes = finished(relocalizer.anywhere(finished(relocalizer.extract(blank(robot, number)))))
        truth = robot.map_from_body[number] @ robot.body_from_cam
        assert all(np.linalg.norm(fix.map_from_cam[:3, 3] - truth[:3, 3]) < within_m for fix in fixes)
        count += len(fixes) > 0
    return count


@pytest.mark.parametrize("rig", ["front-rear", "front-depth"])
def test_a_robot_against_the_survey_finds_itself_by_landmarks_of_the_rear_view(rig: str) -> None:
    """What the rear pair shows on another day is what a robot with one pair would see that drives the other way."""
    facing_back = driven(_ALONG, day=1)[1]
    assert found(facing_back, 1, rig, 0.1) == 0
    assert found(facing_back, 2, rig, 0.1) >= 3


@pytest.mark.parametrize("rig", ["front-rear", "front-depth"])
def test_views_share_the_pose_of_their_keyframe(rig: str) -> None:
    made, done = surveyed(_ALONG, 2, rig)
    assert done.state.rig.kinds == ("stereo", "depth" if rig == "front-depth" else "stereo")
    places = done.map.map_from_body
    front, rear = done.state.rig.body_from_cam
    assert len(places) == 2 * len(made.odometry.keyframes) == 2 * len(done.state.map_from_body)
    np.testing.assert_allclose(places[1::2], places[0::2] @ rear @ se3_inverse(front), atol=1e-12)
    assert set(np.unique(done.map.obs_keyframe % 2)) == {0, 1}
    assert steps_off_m(made, done) <= steps_off_m(*surveyed(_ALONG, 1))


def test_single_cameras_at_the_sides_observe_landmarks_that_their_own_keyframes_triangulate() -> None:
    """Without a disparity in the adjustment; another day's robot finds itself by them where one pair left nothing to look at."""
    side = driven(_ALONG, day=1, rig="front-sides")[1]
    assert found(side, 1, "front-sides", 0.05) == 0
    assert found(side, 3, "front-sides", 0.05) >= 5
    made, done = surveyed(_ALONG, 3, "front-sides")
    seen = done.map.obs_keyframe % 3
    assert min(np.bincount(seen, minlength=3)) > 1000
    assert np.isnan(done.map.obs_pixels[seen > 0, 2]).all() and np.isfinite(done.map.obs_pixels[seen == 0, 2]).any()
    assert steps_off_m(made, done) <= steps_off_m(*surveyed(_ALONG, 1))


def test_the_way_back_is_tied_to_the_way_out_by_the_other_view() -> None:
    opposite = {}
    for views in (1, 2):
        made, done = surveyed(_BACK, views)
        ahead = made.map_from_body[made.odometry.keyframe_frames][:, :3, 0]
        across = [edge for edge in done.loops.edges if ahead[edge.i] @ ahead[edge.j] < -0.9]
        opposite[views] = len(across)
        for edge in across:
            frames = [made.odometry.keyframe_frames[k] for k in (edge.i, edge.j)]
            i_from_j = se3_inverse(made.map_from_body[frames[0]]) @ made.map_from_body[frames[1]]
            off = se3_log(i_from_j @ se3_inverse(edge.i_from_j))
            assert off @ np.linalg.solve(edge.cov_rot_trans, off) < chi2.ppf(0.9999, 6)
    assert opposite[1] == 0 and opposite[2] > 0, opposite
    assert steps_off_m(*surveyed(_BACK, 2)) <= steps_off_m(*surveyed(_BACK, 1))


@pytest.mark.parametrize("views", [1, 2])
def test_the_same_survey_gives_the_same_bytes(views: int) -> None:
    made, done = surveyed(_ALONG, views)
    with drawn_alignment(made):
        again = made.surveyed(SETTINGS)
    assert again.map.points_map.tobytes() == done.map.points_map.tobytes()
    assert again.map.map_from_body.tobytes() == done.map.map_from_body.tobytes()
