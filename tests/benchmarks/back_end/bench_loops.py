"""Accepted loops of simulated surveys without pictures against the truth, in units of their covariance and of the gate's.

Surveys of many seeds until there are so many loops. A loop's error has six degrees of freedom: `beyond` counts those outside the ellipsoid
that holds 0.9973 of a normal error, as three sigmas of one axis do; NEES is the squared error in sigmas by degree of freedom. The gate's is
that of the pose graph's prediction before the loop, which loops are tested against.
"""

from collections.abc import Iterator
from itertools import count
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from scipy.stats import chi2

from benchmarks.common.recorded_runs import Options, Results, benchmark
from benchmarks.common.simulated_survey import SimulatedSurvey, drawn_alignment, session_of, simulated_survey
from fleetmap.bow.vocabulary import default_vocabulary
from fleetmap.geometry import se3_inverse, se3_log
from fleetmap.sensors.samples import SensorSet
from mapserver.config import survey_settings
from mapserver.survey.loops.loops import LoopCloser
from mapserver.survey.pose_graph.pose_graph import PoseEdge
from mapserver.survey.stages import adjust_chain, close_loops
from mapserver.survey.survey_inputs import SurveyConfig, SurveyTools

SETTINGS = survey_settings(None, SensorSet.STEREO_INERTIAL)
BEYOND = float(chi2.ppf(0.9973, 6))
SITES = (
    ("five-aisles", "survey"),
    ("small-loop", "survey"),
    ("busy", "survey"),
    ("identical-aisles", "survey-both-ways"),
)


class Loop(NamedTuple):
    """An accepted loop: its error and the gate's before it, squared, in sigmas; metres from the truth."""

    squared: float
    gate_squared: float
    off_m: float


def accepted(survey: SimulatedSurvey) -> list[Loop]:
    """The loops of a survey that its pose graph keeps."""
    frames = [keyframe.frame_index for keyframe in survey.odometry.keyframes]
    truth, found = survey.map_from_body[frames], dict[tuple[int, int], Loop]()
    accept = LoopCloser._accept

    def noted(closer: LoopCloser, edge: PoseEdge) -> None:
        true = se3_inverse(truth[edge.i]) @ truth[edge.j]
        placed = closer._marginals.map_from_body
        predicted = se3_inverse(placed[edge.i]) @ placed[edge.j]
        gate, squared = closer._marginals.relative_cov(edge.i, edge.j), list[float]()
        for each, covariance in ((edge.i_from_j, edge.cov_rot_trans), (predicted, gate)):
            off = se3_log(true @ se3_inverse(each))
            squared.append(float(off @ np.linalg.solve(covariance, off)))
        found[edge.i, edge.j] = Loop(*squared, float(np.linalg.norm((true - edge.i_from_j)[:3, 3])))
        accept(closer, edge)

    tools = SurveyTools()
    with drawn_alignment(survey), patch.object(LoopCloser, "_accept", noted):
        chain = adjust_chain(survey.odometry, survey.inputs, SETTINGS, tools)
        _, loops = close_loops(chain, survey.inputs, SurveyConfig(SETTINGS, default_vocabulary()), tools)
    return [found[edge.i, edge.j] for edge in loops.edges]


def surveys(first: int) -> Iterator[list[Loop]]:
    """Each site in turn with a seed of its own."""
    for n in count():
        site, robot = SITES[n % len(SITES)]
        yield accepted(simulated_survey(session_of(site, [robot], seed=first + n), SETTINGS))


def summary(loops: list[Loop]) -> dict[str, Any]:
    """Figures of all loops."""
    own, gate, off_m = (np.array(column) for column in zip(*loops, strict=True))
    return {
        "loops": len(loops),
        "beyond": int((own > BEYOND).sum()),
        "gate_beyond": int((gate > BEYOND).sum()),
        "nees": float(own.mean() / 6),
        "gate_nees": float(gate.mean() / 6),
        "largest": float(own.max() / BEYOND),
        "off_median_m": float(np.median(off_m)),
        "off_max_m": float(off_m.max()),
    }


@benchmark(seed=40100, loops=1500)
def main(given: Options) -> Results:
    every = list[Loop]()
    for loops in surveys(given.seed):
        every += loops
        if len(every) >= given.loops:
            break
    return summary(every)
