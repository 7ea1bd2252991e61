"""Robots with a second pair that looks back, without pictures: against the survey's direction, and with the pair in front covered.

`PYTHONPATH=tests python tests/benchmarks/robot/bench_rigs.py [--seed SEED] [--count N]`: for each of N sites from SEED on, shares of frames
that are TRACKING, the largest error of one, and frames that are TRACKING more than 0.3 m off.
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse

import numpy as np

from benchmarks.common import estimator_loop
from fleetmap.messages import Status
from fleetsim.recorder import Order, prepare
from locclient.localization.estimate import Estimate
from support.estimator.landmarks import LandmarkField
from support.estimator.simulated_run import EstimatorSession

_COVERED_S = (1.5, 21.5)
_WRONG_M = 0.3


def views(robot: str, seed: int, day: int, covered_s: tuple[float, float] = (0.0, 0.0)) -> list[EstimatorSession]:
    """Both views of a robot of the small loop; covered_s: of the pair in front."""
    session = prepare(Order("small-loop", seed=seed, day=day, robot=robot, rig="front-rear"))
    session.renderer.close()
    field = LandmarkField(session.world)
    return [EstimatorSession(session, field=field, covered_s=covered_s), EstimatorSession(session, field=field, view=1)]


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
    chosen = parser.parse_args()
    for seed in range(chosen.seed, chosen.seed + chosen.count):
        front, rear = views("survey", seed, 0)
        of_front, of_both = (
            estimator_loop.map_view(
                front, *estimator_loop.survey_map(front, np.random.default_rng(seed), others=others)
            )
            for others in ([], [rear])
        )
        against, covered = views("opposite-1", seed, 1), views("runner-1", seed, 1, _COVERED_S)
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
