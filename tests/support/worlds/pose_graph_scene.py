"""A drive of several laps as a pose graph with known truth, for tests."""

from collections.abc import Iterable, Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, se3, se3_exp, se3_inverse, so3_exp
from mapserver.survey.pose_graph.pose_graph import PoseEdge

ODOMETRY_COV = np.diag([0.002**2, 0.002**2, 0.004**2, 0.02**2, 0.015**2, 0.01**2])
LOOP_COV = np.diag([0.003**2] * 3 + [0.02**2] * 3)


class Drive(NamedTuple):
    """truth and start map_from_body (K, 4, 4); edges: odometry, then loops; wrong (loops,)."""

    truth: Array
    start: Array
    edges: list[PoseEdge]
    wrong: np.ndarray


def measured(rng: np.random.Generator, truth: Array, i: int, j: int, cov: Array, *, is_loop: bool) -> PoseEdge:
    """A measurement whose error has that covariance, in the axes of i."""
    error = rng.multivariate_normal(np.zeros(6), cov)
    return PoseEdge(i, j, se3_exp(error) @ se3_inverse(truth[i]) @ truth[j], cov, is_loop)


def driven(steps: Sequence[Array], start: Array | None = None) -> Array:
    """Places (K + 1, 4, 4) after steps, one after the other."""
    return np.array([*accumulate(steps, np.matmul, initial=np.eye(4) if start is None else start)])


def chain_of(places: Array, covariances: Iterable[Array]) -> list[PoseEdge]:
    """The edges from each of some places (K, 4, 4) to the next."""
    steps = zip(se3_inverse(places[:-1]) @ places[1:], covariances, strict=False)
    return [PoseEdge(k, k + 1, step, cov, is_loop=False) for k, (step, cov) in enumerate(steps)]


def make_drive(rng: np.random.Generator, count: int = 80, laps: int = 2, loops: int = 12, wrong: int = 0) -> Drive:
    """Laps of a 10 m circle with some pitch; loops join a keyframe with the same place of another lap."""
    lap = count // laps
    angle = 2.0 * np.pi * np.arange(count) / lap
    truth = np.array(
        [
            se3(
                so3_exp(np.array([0.0, 0.0, a + np.pi / 2])) @ so3_exp(np.array([0.0, 0.2 * np.sin(3 * a), 0.0])),
                np.array([10 * np.cos(a), 10 * np.sin(a), 0.5 * np.sin(a)]),
            )
            for a in angle
        ]
    )
    edges = [measured(rng, truth, k, k + 1, ODOMETRY_COV, is_loop=False) for k in range(count - 1)]
    start = driven([edge.i_from_j for edge in edges], truth[0])
    later = rng.choice(np.arange(lap, count), loops, replace=False)
    is_wrong = np.arange(loops) < wrong
    for j, bad in zip(later.tolist(), is_wrong, strict=True):
        edge = measured(rng, truth, j - lap, j, LOOP_COV, is_loop=True)
        far = se3_exp(np.array([0.0, 0.1, 0.3, 2.0, -3.0, 0.2])) if bad else np.eye(4)
        edges.append(PoseEdge(edge.i, edge.j, far @ edge.i_from_j, LOOP_COV, True))
    return Drive(truth, start, edges, is_wrong)
