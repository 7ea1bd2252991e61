"""Loops of a survey with unobservable scale: measured with the drifted scale, and closed over similarities."""

import numpy as np

from fleetmap.geometry import Array, transform_points
from mapserver.survey.pose_graph.pose_graph import PoseEdge, check_edges
from mapserver.survey.pose_graph.sim3_pose_graph import SimilarityEdge, SimilarityResult, optimize_similarities

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
) -> SimilarityResult:
    """Return the bodies with the best fit to chain and loops, each loop with its measured change of scale.

    `scales`: for loop (i, j) the logarithm of i's lengths per length of j, with sigma. Scales are contained in the distances of places.
    SurveyError as `check_edges`.
    """
    check_edges(len(map_from_body), [*chain, *loops])
    edges = [_edge(edge, 0.0, scale_walk) for edge in chain]
    edges += [_edge(edge, *scales.get((edge.i, edge.j), (0.0, _UNKNOWN_SIGMA))) for edge in loops]
    return optimize_similarities(map_from_body, edges)


def _edge(edge: PoseEdge, log_scale: float, sigma: float) -> SimilarityEdge:
    """Convert the loop's i_from_j from lengths of j to lengths of i: its translation is multiplied by the scale."""
    scale = float(np.exp(log_scale))
    carry = np.diag([1.0] * 3 + [scale] * 3)
    cov = np.zeros((7, 7))
    cov[:6, :6] = carry @ edge.cov_rot_trans @ carry
    cov[6, 6] = sigma**2
    cov[:6, :6] += 1e-12 * np.eye(6)
    i_from_j = edge.i_from_j.copy()
    i_from_j[:3, 3] *= scale
    return SimilarityEdge(edge.i, edge.j, i_from_j, scale, cov, edge.is_loop)
