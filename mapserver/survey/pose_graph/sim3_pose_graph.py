"""Pose graph over Sim(3), for keyframes whose scale drifts as nothing observes it. Source: Strasdat et al. 2010.

A similarity maps x to scale * R x + t; keyframe k has map_from_k.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import scipy

from fleetmap.geometry import Array, transform_points
from mapserver.survey.pose_graph.pose_graph import PoseEdge, check_edges, improved, squared_residuals

if TYPE_CHECKING:
    import gtsam

_FIXED_SIGMA = 1e-6
_INLIER_PROBABILITY = 0.999
_MAX_ITERATIONS = 50
_ROUND_ITERATIONS = 4  # while the loops' weights still change
_MIN_SHARED = 8  # least points with depth in both keyframes to measure the scale
_CORRELATION = 3.0  # depths of one keyframe share the errors of its neighbours
_UNKNOWN_SIGMA = 1.0


def measured_log_scale(points_i: Array, points_j: Array, j_from_i: Array) -> tuple[float, float]:
    """Return the logarithm of j's lengths per length of i, and its sigma, from points (N, 3) known in both cameras (NaN if not).

    j_from_i was measured in lengths of i; the median over the points' distances, robust to half of them being wrong.
    """
    ratio = np.linalg.norm(points_j, axis=1) / np.linalg.norm(transform_points(j_from_i, points_i), axis=1)
    ratio = np.log(ratio[np.isfinite(ratio) & (ratio > 0)])
    if len(ratio) < _MIN_SHARED:
        return 0.0, _UNKNOWN_SIGMA
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - middle)))
    return middle, _CORRELATION * max(spread, 1e-3) / np.sqrt(len(ratio))


def gate_covariances(chain: list[PoseEdge], scale_walk: float) -> list[PoseEdge]:
    """Return the chain's edges for the position gate: widened by the effect of scale drift on the path so far.

    A scale that walks by `scale_walk` for each keyframe shifts the end of n edges of length l by about scale_walk n^1.5 l / sqrt 3;
    independent edges add up to as much if each has scale_walk times the path so far.
    """
    widened, way_m = [], 0.0
    for edge in chain:
        way_m += float(np.linalg.norm(edge.i_from_j[:3, 3]))
        sigma = scale_walk * way_m / np.sqrt(3.0)
        cov = edge.cov_rot_trans + np.diag([0.0] * 3 + [sigma**2] * 3)
        widened.append(PoseEdge(edge.i, edge.j, edge.i_from_j, cov, edge.is_loop))
    return widened


def solve_scaled(
    map_from_body: Array,
    chain: list[PoseEdge],
    loops: list[PoseEdge],
    scales: dict[tuple[int, int], tuple[float, float]],
    scale_walk: float,
) -> tuple[Array, Array]:
    """Return the bodies (K, 4, 4) with the best fit to chain and loops, and the loops' weights in order (1 accepted, 0 not).

    map_from_body (K, 4, 4): a start of scale 1; the first keyframe and its scale are unchanged. scales: for loop (i, j) the logarithm of
    i's lengths per length of j, with sigma. Scales are contained in the distances of places. Loops that contradict the rest are rejected,
    all other edges assumed true: by graduated non-convexity with Geman and McClure's cost, which accepts all loops at first; one with a
    squared residual within 0.999 of chi-square counts in full. SurveyError as `check_edges`. Source: Yang et al. 2020 (GNC).
    """
    import gtsam

    check_edges(len(map_from_body), [*chain, *loops])
    state, certain = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for k, placed in enumerate(map_from_body):
        state.insert(k, gtsam.Similarity3(gtsam.Rot3(placed[:3, :3]), placed[:3, 3], 1.0))
    anchor = gtsam.noiseModel.Isotropic.Sigma(7, _FIXED_SIGMA)
    certain.add(gtsam.PriorFactorSimilarity3(0, state.atSimilarity3(0), anchor))
    for edge in chain:
        certain.add(_factor(edge, 0.0, scale_walk))
    doubtful = [_factor(edge, *scales.get((edge.i, edge.j), (0.0, _UNKNOWN_SIGMA))) for edge in loops]
    weights = np.ones(len(loops))
    state = improved(certain, doubtful, weights, state, _MAX_ITERATIONS)
    if loops:
        limit = float(2.0 * scipy.special.gammaincinv(3.5, _INLIER_PROBABILITY))  # chi-square of seven freedoms
        squares = squared_residuals(doubtful, state)
        control = max(2.0 * float(squares.max()) / limit, 1.0)
        while True:
            weights = (control * limit / (squares + control * limit)) ** 2
            state = improved(certain, doubtful, weights, state, _ROUND_ITERATIONS)
            squares = squared_residuals(doubtful, state)
            if control == 1.0:
                break
            control = max(control / 1.6, 1.0)
        for _ in range(2):
            weights = (squares <= limit).astype(np.float64)
            state = improved(certain, doubtful, weights, state, _MAX_ITERATIONS)
            squares = squared_residuals(doubtful, state)
    solved = np.tile(np.eye(4), (len(map_from_body), 1, 1))
    for k in range(len(solved)):
        found = state.atSimilarity3(k)
        solved[k, :3, :3], solved[k, :3, 3] = found.rotation().matrix(), found.scale() * found.translation()
    return solved, weights


def _factor(edge: PoseEdge, log_scale: float, sigma: float) -> gtsam.NoiseModelFactor:
    """Return an edge with the logarithm of i's lengths per length of j; its i_from_j and covariance have lengths of j.

    gtsam's Similarity3(R, t, s) maps x to s (R x + t), and its errors are in the axes of j.
    """
    import gtsam

    scale = float(np.exp(log_scale))
    carry = np.diag([1.0] * 3 + [scale] * 3)
    cov = np.zeros((7, 7))
    cov[:6, :6] = carry @ edge.cov_rot_trans @ carry + 1e-12 * np.eye(6)
    cov[6, 6] = sigma**2
    measured = gtsam.Similarity3(gtsam.Rot3(edge.i_from_j[:3, :3]), edge.i_from_j[:3, 3], scale)
    j_from_i = measured.inverse().AdjointMap()
    cov = j_from_i @ cov @ j_from_i.T
    noise = gtsam.noiseModel.Gaussian.Covariance(0.5 * (cov + cov.T))
    return gtsam.BetweenFactorSimilarity3(edge.i, edge.j, measured, noise)
