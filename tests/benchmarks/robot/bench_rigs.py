"""Rigs with a second pair that looks back, without pictures: surveys by one pair and by both, robots against the survey's direction and
with the pair in front covered.

`PYTHONPATH=tests python tests/benchmarks/robot/bench_rigs.py [--seed SEED] [--count N] [--lens NAME]`: for each of N sites from SEED on,
ATE of the surveys and their seconds of CPU; shares of frames that are TRACKING, the largest error of one, and frames that are TRACKING
more than 0.3 m off.
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


def views(
    robot: str, seed: int, day: int, covered_s: tuple[float, float] = (0.0, 0.0), lens: str | None = None
) -> list[EstimatorSession]:
    """Both views of a robot of the small loop; covered_s: of the pair in front."""
    session = prepare(Order("small-loop", seed=seed, day=day, robot=robot, rig="front-rear", lens=lens))
    session.renderer.close()
    field = LandmarkField(session.world)
    return [EstimatorSession(session, field=field, covered_s=covered_s), EstimatorSession(session, field=field, view=1)]


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
    name = "a rear pair" if others else "one pair"
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
    return f"{share:6.1%} tracking, at most {1000 * max(errors, default=0.0):.0f} mm off, {wrong} frames wrong"


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=1)
    parser.add_argument("--lens")
    chosen = parser.parse_args()
    for seed in range(chosen.seed, chosen.seed + chosen.count):
        front, rear = views("survey", seed, 0, lens=chosen.lens)
        of_front, of_both = (surveyed(seed, front, others) for others in ([], [rear]))
        against = views("opposite-1", seed, 1, lens=chosen.lens)
        covered = views("runner-1", seed, 1, _COVERED_S, lens=chosen.lens)
        for name, view, robot, others in (
            ("against the survey, one pair on both", of_front, against[0], []),
            ("against the survey, a rear pair on the robot", of_front, against[0], against[1:]),
            ("against the survey, a rear pair on the survey's robot", of_both, against[0], []),
            ("front covered for 20 s, one pair", of_both, covered[0], []),
            ("front covered for 20 s, a rear pair", of_both, covered[0], covered[1:]),
        ):
            estimates = estimator_loop.run_localizer(robot, view, others=others)
            print(f"site {seed}, {name}: {told(estimates, robot)}", flush=True)


if __name__ == "__main__":
    main()
