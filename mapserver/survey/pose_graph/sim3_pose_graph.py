"""Pose graph optimization over Sim(3): poses and scales of keyframes whose scale drifts. Source: Strasdat et al. 2010.

A similarity maps x to scale * R x + t; keyframe k has map_from_k.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.special import gammaincinv

from fleetmap.geometry import Array
from mapserver.survey.pose_graph.gnc import improved, squared_residuals

_FIXED_SIGMA = 1e-6
_INLIER_PROBABILITY = 0.999
_MAX_ITERATIONS = 50
_ROUND_ITERATIONS = 4  # while the loops' weights still change


@dataclass(frozen=True, slots=True)
class SimilarityEdge:
    """Measurement: a point x of keyframe j is at scale * R x + t for keyframe i; i_from_j (4, 4) contains R and t.

    cov (7, 7) of the error: rotation, translation in lengths of i, logarithm of the scale. Loops may be wrong, other edges are true.
    """

    i: int
    j: int
    i_from_j: Array
    scale: float
    cov: Array
    is_loop: bool


@dataclass(frozen=True, slots=True)
class SimilarityResult:
    """Optimised poses map_from_body (K, 4, 4), the keyframes' scales (K,), and the loops' weights in order (1 accepted, 0 not)."""

    map_from_body: Array
    scales: Array
    loop_weights: Array


def optimize_similarities(map_from_body: Array, edges: Sequence[SimilarityEdge]) -> SimilarityResult:
    """Return the similarities with the best fit to the edges, from a start map_from_body (K, 4, 4) of scale 1; the first
    keyframe and its scale are unchanged.

    Loops that contradict the rest are rejected, all other edges assumed true: by graduated non-convexity with Geman and McClure's
    cost, which accepts all loops at first; one with a squared residual within 0.999 of chi-square counts in full.
    Edges must connect all keyframes with valid covariances; otherwise it does not terminate.
    Sources: Strasdat et al. 2010 (Sim(3) graphs), Yang et al. 2020 (GNC).
    """
    state, certain, loops = gtsam.Values(), gtsam.NonlinearFactorGraph(), list[gtsam.NoiseModelFactor]()
    for k, placed in enumerate(map_from_body):
        state.insert(k, gtsam.Similarity3(gtsam.Rot3(placed[:3, :3]), placed[:3, 3], 1.0))
    anchor = gtsam.noiseModel.Isotropic.Sigma(7, _FIXED_SIGMA)
    certain.add(gtsam.PriorFactorSimilarity3(0, state.atSimilarity3(0), anchor))
    for edge in edges:
        factor = _factor(edge)
        if edge.is_loop:
            loops.append(factor)
        else:
            certain.add(factor)
    weights = np.ones(len(loops))
    state = improved(certain, loops, weights, state, _MAX_ITERATIONS)
    if loops:
        limit = float(2.0 * gammaincinv(3.5, _INLIER_PROBABILITY))  # chi-square of seven freedoms
        squares = squared_residuals(loops, state)
        control = max(2.0 * float(squares.max()) / limit, 1.0)
        while True:
            weights = (control * limit / (squares + control * limit)) ** 2
            state = improved(certain, loops, weights, state, _ROUND_ITERATIONS)
            squares = squared_residuals(loops, state)
            if control == 1.0:
                break
            control = max(control / 1.6, 1.0)
        for _ in range(2):
            weights = (squares <= limit).astype(np.float64)
            state = improved(certain, loops, weights, state, _MAX_ITERATIONS)
            squares = squared_residuals(loops, state)
    solved = np.tile(np.eye(4), (len(map_from_body), 1, 1))
    scales = np.empty(len(solved))
    for k in range(len(solved)):
        found = state.atSimilarity3(k)
        scales[k] = found.scale()
        solved[k, :3, :3], solved[k, :3, 3] = found.rotation().matrix(), scales[k] * found.translation()
    return SimilarityResult(solved, scales, weights)


def _factor(edge: SimilarityEdge) -> gtsam.NoiseModelFactor:
    """Return the edge in gtsam's form: Similarity3(R, t, s) maps x to s (R x + t), and errors are in the axes of j."""
    measured = gtsam.Similarity3(gtsam.Rot3(edge.i_from_j[:3, :3]), edge.i_from_j[:3, 3] / edge.scale, edge.scale)
    j_from_i = measured.inverse().AdjointMap()
    cov = j_from_i @ edge.cov @ j_from_i.T
    noise = gtsam.noiseModel.Gaussian.Covariance(0.5 * (cov + cov.T))
    return gtsam.BetweenFactorSimilarity3(edge.i, edge.j, measured, noise)
