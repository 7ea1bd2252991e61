"""Rigs with further views, without pictures: surveys by one pair and by the rig, robots along and against the survey's direction and
with the pair in front covered.

`PYTHONPATH=tests python tests/benchmarks/robot/bench_rigs.py [--seed SEED] [--count N] [--rig NAME] [--lens NAME]`: for each of N sites
from SEED on, ATE of the surveys and their seconds of CPU; shares of frames that are TRACKING, errors of these (root mean square and
largest), and frames that are TRACKING more than 0.3 m off. NAME: of fleetsim's rigs.
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse
import time

import numpy as np

from benchmarks.common import estimator_loop
from benchmarks.common.simulated_survey import drawn_alignment, simulated_survey
from fleetmap.bow.shipped_vocabulary import default_vocabulary
from fleetmap.geometry import align_points, transform_points
from fleetmap.messages import Status
from fleetmap.relocalization.map_view import MapView
from fleetmap.sensors.samples import SensorSet
from fleetsim.recorder import Order, prepare
from locclient.localization.estimate import Estimate
from mapserver.config import survey_settings
from mapserver.survey.finish.map_transform import transform_map
from mapserver.survey.stages import survey_from
from mapserver.survey.survey_inputs import SurveyConfig
from mapserver.tiles.landmark_budget import choose_landmarks
from mapserver.tiles.tiling import TILE_SIZE_M, tiles_from_survey
from support.estimator.landmarks import LandmarkField
from support.estimator.simulated_run import EstimatorSession

_COVERED_S = (1.5, 21.5)
_WRONG_M = 0.3
_SETTINGS = survey_settings(None, SensorSet.STEREO_INERTIAL)


def views(order: Order, covered_s: tuple[float, float] = (0.0, 0.0)) -> list[EstimatorSession]:
    """All views of a robot; covered_s: of the pair in front."""
    session = prepare(order)
    session.renderer.close()
    field, further = LandmarkField(session.world), range(1, len(session.nominal.views))
    front = EstimatorSession(session, field=field, covered_s=covered_s)
    return [front, *(EstimatorSession(session, field=field, view=view) for view in further)]


def surveyed(seed: int, front: EstimatorSession, others: list[EstimatorSession]) -> MapView:
    """The map that robots get of a survey, laid on the truth; tells its error."""
    started_s = time.process_time()
    made = simulated_survey(front, _SETTINGS, others)
    with drawn_alignment(made):
        survey = survey_from(made.odometry, made.inputs, SurveyConfig(_SETTINGS, default_vocabulary()))
    spent_s = time.process_time() - started_s
    found, truth = survey.map.trajectory.positions_m, made.map_from_body[:, :3, 3]
    true_from_map, _ = align_points(truth, found)
    ate_m = np.sqrt(np.square(transform_points(true_from_map, found) - truth).sum(axis=1).mean())
    accepted = survey.loops.counts()["accepted"]
    name = "the rig" if others else "one pair"
    print(
        f"site {seed}, survey with {name}: ATE {1000 * ate_m:.1f} mm, {accepted} loops, {spent_s:.0f} s of CPU",
        flush=True,
    )
    placed = transform_map(survey.map, true_from_map)
    tiles = tiles_from_survey(placed, chosen=choose_landmarks(placed, _SETTINGS.budget, TILE_SIZE_M, None, ()))
    return MapView(tiles, default_vocabulary(), placed.camera.focal_px)


def told(estimates: list[Estimate], session: EstimatorSession) -> str:
    """The figures of a run in words."""
    share = np.mean([estimate.status is Status.TRACKING for estimate in estimates])
    tracking = [
        (e, truth) for e, truth in zip(estimates, session.map_from_body, strict=True) if e.status is Status.TRACKING
    ]
    errors = [
        float(np.linalg.norm(e.map_from_body[:3, 3] - t[:3, 3])) for e, t in tracking if e.map_from_body is not None
    ]
    wrong = sum(error > _WRONG_M for error in errors)
    rms_m = float(np.sqrt(np.mean(np.square(errors or [0.0]))))
    most_m = max(errors, default=0.0)
    return f"{share:6.1%} tracking, {1000 * rms_m:.1f} mm rms, at most {1000 * most_m:.0f} mm off, {wrong} frames wrong"


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=1)
    parser.add_argument("--rig", default="front-rear")
    parser.add_argument("--lens")
    chosen = parser.parse_args()
    for seed in range(chosen.seed, chosen.seed + chosen.count):

        def of(robot: str, day: int, seed: int = seed) -> Order:
            return Order("small-loop", seed=seed, day=day, robot=robot, rig=chosen.rig, lens=chosen.lens)

        front, *others = views(of("survey", 0))
        of_front, of_rig = (surveyed(seed, front, each) for each in ([], others))
        along, against = views(of("runner-1", 1)), views(of("opposite-1", 1))
        covered = views(of("runner-1", 1), _COVERED_S)
        for name, view, robot, used in (
            ("along the survey, one pair on both", of_front, along[0], []),
            ("along the survey, the rig on the robot", of_front, along[0], along[1:]),
            ("along the survey, the rig on both", of_rig, along[0], along[1:]),
            ("along the survey, the rig on the survey's robot", of_rig, along[0], []),
            ("against the survey, one pair on both", of_front, against[0], []),
            ("against the survey, the rig on the robot", of_front, against[0], against[1:]),
            ("against the survey, the rig on the survey's robot", of_rig, against[0], []),
            ("front covered for 20 s, one pair", of_rig, covered[0], []),
            ("front covered for 20 s, the rig", of_rig, covered[0], covered[1:]),
        ):
            estimates = estimator_loop.run_localizer(robot, view, others=used)
            print(f"site {seed}, {name}: {told(estimates, robot)}", flush=True)


if __name__ == "__main__":
    main()
