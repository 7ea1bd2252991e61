"""Pose graph optimization over SE(3): the best fit of poses to measured relative transforms, and the outlier loops.

gtsam is imported where it is used: a tenth of a second that builds without loops do not need.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, se3_adjoint, se3_inverse

if TYPE_CHECKING:
    import gtsam

_FIXED_SIGMA = 1e-6
_INLIER_PROBABILITY = 0.999
_MAX_ITERATIONS = 100
_FIRST_ITERATIONS = 15  # before another start is considered
_GROWTH = 1.6  # of the control parameter, from almost convex to truncated
_STEPS = 2  # Levenberg-Marquardt iterations between two updates of the weights
_MAX_UPDATES = 150
_UNSURE = 1e-3  # a weight this near to 0 or 1 counts as decided


@dataclass(frozen=True, slots=True)
class PoseEdge:
    """A measured i_from_j (4, 4) between keyframes i and j.

    cov_rot_trans (6, 6) is that of a perturbation in the axes of i: true i_from_j = Exp(perturbation) @ i_from_j.
    Loops may be wrong, other edges are assumed true.
    """

    i: int
    j: int
    i_from_j: Array
    cov_rot_trans: Array
    is_loop: bool


class PoseGraphResult(NamedTuple):
    """Optimised map_from_body (K, 4, 4).

    loop_weights has one number for each loop edge in order: 1 accepted, 0 rejected; below 0.5 a loop did not affect the result. cost: half
    the sum of squared normalised residuals of the accepted edges.
    """

    map_from_body: Array
    loop_weights: Array
    cost: float


def optimize_pose_graph(map_from_body: Array, edges: Sequence[PoseEdge], *, robust: bool = True) -> PoseGraphResult:
    """Return the poses of K keyframes with the best fit to the edges, from a start map_from_body (K, 4, 4); the first is unchanged.

    robust: loops that contradict the rest are rejected, by graduated non-convexity with truncated least squares in which all other edges
    are assumed true; a loop is consistent while its squared residual stays within the 0.999 of chi-square. If the
    result is less likely than its edges' covariances allow, a second start without initial values (chordal relaxation of the rotations) is
    tried, and the better result returned. Raises SurveyError for edges that leave a keyframe unconnected, have an invalid index or an
    invalid covariance. Source: Yang et al. 2020 (GNC); Carlone et al. 2015 (chordal start), as in gtsam.
    """
    import gtsam

    check_edges(len(map_from_body), edges)
    start = gtsam.Values()
    for k, map_from_k in enumerate(map_from_body):
        start.insert(k, gtsam.Pose3(map_from_k))
    loops = [edge for edge in edges if edge.is_loop]
    weights = np.ones(len(loops))
    try:
        if robust and loops:
            certain = _graph(map_from_body, [edge for edge in edges if not edge.is_loop])
            # chi-square; scipy.stats takes half a second to import
            bound = float(2.0 * scipy.special.gammaincinv(3.0, _INLIER_PROBABILITY))
            weights, start = loop_weights(certain, [_factor(edge) for edge in loops], start, bound)
        believed = iter(weights >= 0.5)
        kept = [edge for edge in edges if not edge.is_loop or next(believed)]
        graph = _graph(map_from_body, kept)
        optimum, spent = descended(graph, start, _FIRST_ITERATIONS)
        freedom = 6 * (len(kept) - len(map_from_body) + 1)
        if 2.0 * graph.error(optimum) > freedom + 5.0 * np.sqrt(2.0 * max(freedom, 1)):
            with suppress(RuntimeError):  # the graph may be too badly conditioned for a chordal start
                other = descended(graph, gtsam.InitializePose3.initialize(graph), _FIRST_ITERATIONS)
                if graph.error(other[0]) < graph.error(optimum):
                    optimum, spent = other
        if spent >= _FIRST_ITERATIONS:
            optimum = descended(graph, optimum, _MAX_ITERATIONS - spent)[0]
    except RuntimeError as error:
        raise SurveyError(
            f"the pose graph of {len(map_from_body)} keyframes and {len(edges)} edges cannot be solved "
            f"({str(error).strip().splitlines()[0]}); look for keyframes connected only by a wrong loop"
        ) from error
    solved = np.array([optimum.atPose3(k).matrix() for k in range(len(map_from_body))])
    solved = map_from_body[0] @ se3_inverse(solved[0]) @ solved  # the prior allows a deviation of 1e-6
    solved[0] = map_from_body[0]
    return PoseGraphResult(solved, weights, graph.error(optimum))


def check_edges(count: int, edges: Sequence[PoseEdge], *, connected: bool = True) -> None:
    """Raise SurveyError unless every edge joins two of `count` keyframes with a valid covariance.

    connected: also raise unless they join all keyframes.
    """
    for edge in edges:
        if not (0 <= edge.i < count and 0 <= edge.j < count and edge.i != edge.j):
            raise SurveyError(f"edge {edge.i}-{edge.j} does not join two of the {count} keyframes; drop it")
        if not np.isfinite(edge.i_from_j).all() or not _is_covariance(edge.cov_rot_trans):
            raise SurveyError(
                f"edge {edge.i}-{edge.j}: its transform or covariance (diagonal {np.diag(edge.cov_rot_trans)}) is not "
                "finite and positive; drop the edge"
            )
    if not connected:
        return
    ends = np.array([(edge.i, edge.j) for edge in edges], np.int64).reshape(-1, 2).T
    joined = scipy.sparse.coo_array((np.ones(len(edges)), ends), (count, count))
    _, part = scipy.sparse.csgraph.connected_components(joined, directed=False)
    lost = np.flatnonzero(part != part[:1]).tolist()
    if lost:
        raise SurveyError(f"keyframes {lost[:10]} ({len(lost)} in all) have no edge towards keyframe 0; leave them out")


def _is_covariance(cov: Array) -> bool:
    if not np.isfinite(cov).all():
        return False
    try:
        np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        return False
    return True


def _graph(map_from_body: Array, edges: Sequence[PoseEdge]) -> gtsam.NonlinearFactorGraph:
    """Return the edges as factors, in order, then the factor that fixes the first keyframe."""
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    for edge in edges:
        graph.add(_factor(edge))
    anchor = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED_SIGMA)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(map_from_body[0]), anchor))
    return graph


def _factor(edge: PoseEdge) -> gtsam.NoiseModelFactor:
    import gtsam

    j_from_i = se3_adjoint(se3_inverse(edge.i_from_j))  # gtsam perturbs on the right, in the axes of j
    cov = j_from_i @ edge.cov_rot_trans @ j_from_i.T
    noise = gtsam.noiseModel.Gaussian.Covariance(0.5 * (cov + cov.T))
    return gtsam.BetweenFactorPose3(edge.i, edge.j, gtsam.Pose3(edge.i_from_j), noise)


def loop_weights(
    certain: gtsam.NonlinearFactorGraph, loops: list[gtsam.NoiseModelFactor], start: gtsam.Values, bound: float
) -> tuple[Array, gtsam.Values]:
    """Return the weight (len(loops),) of each loop, 1 accepted and 0 not, and the resulting poses of the keyframes.

    `certain`: all edges assumed true. A loop is consistent while its squared residual stays within `bound`. Each step makes the cost a
    little less convex and continues from the last result, so the whole costs little more than one solve. It starts near
    `start`, with weights that keep the better half of the loops active, and, if loops are rejected, again with all loops active; the
    lower truncated cost is returned. Source: Yang et al. 2020, Graduated non-convexity for robust spatial perception.
    Own code, because `gtsam.GncLMOptimizer`, with the same known inliers and bound, solves to convergence at each step: of parking-garage
    (1,661 poses, one wrong loop more for 20) it had no result in 57 CPU s, where this ends after 13.4. Drives of 80 poses
    (tests/mapserver/survey/pose_graph/test_pose_graph.py) take both of them 0.14 s and end at the same cost.
    """
    squared = squared_residuals(loops, start)
    if (squared <= bound).all():
        return np.ones(len(loops)), start
    found: list[tuple[float, Array, gtsam.Values]] = []
    for reach in (4.0 * float(np.median(squared)), 2.0 * float(squared.max())):
        control, values = min(bound / max(reach - bound, bound), 1.0), start
        for _ in range(_MAX_UPDATES):
            weights = truncated_weights(squared_residuals(loops, values), bound, control)
            values = improved(certain, loops, weights, values, _STEPS)
            if (np.minimum(weights, 1.0 - weights) < _UNSURE).all() and control > 1.0:
                break
            control *= _GROWTH
        cost = certain.error(values) + 0.5 * float(np.minimum(squared_residuals(loops, values), bound).sum())
        found.append((cost, weights, values))
        if weights.min() > 0.5:
            break
    return min(found, key=lambda one: one[0])[1:]


def truncated_weights(squared: Array, bound: float, control: float) -> Array:
    """Return weights of squared residuals under the surrogate of truncated least squares. Source: Yang et al. 2020, eq. 14."""
    between = np.sqrt(bound * control * (control + 1.0) / np.maximum(squared, 1e-12)) - control
    weights = np.where(squared >= bound * (control + 1.0) / control, 0.0, between)
    return np.asarray(np.where(squared <= bound * control / (control + 1.0), 1.0, np.clip(weights, 0.0, 1.0)))


def squared_residuals(loops: list[gtsam.NoiseModelFactor], values: gtsam.Values) -> Array:
    """Return (len(loops),) squared residuals in sigmas."""
    return 2.0 * np.array([loop.error(values) for loop in loops])


def improved(
    certain: gtsam.NonlinearFactorGraph,
    loops: list[gtsam.NoiseModelFactor],
    weights: Array,
    values: gtsam.Values,
    steps: int,
) -> gtsam.Values:
    """Return the values after some steps of Levenberg-Marquardt with weighted loops."""
    import gtsam

    graph = gtsam.NonlinearFactorGraph(certain)
    for loop, weight in zip(loops, weights, strict=True):
        if weight >= 1.0 - _UNSURE:
            graph.push_back(loop)
        elif weight > 0.0:  # however small: a distant true loop starts with the bound's share of its square
            noise = loop.noiseModel()
            assert isinstance(noise, gtsam.noiseModel.Gaussian)
            weaker = gtsam.noiseModel.Gaussian.SqrtInformation(noise.R() * np.sqrt(weight))
            graph.push_back(loop.cloneWithNewNoiseModel(weaker))
    return descended(graph, values, steps)[0]


def descended(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, steps: int) -> tuple[gtsam.Values, int]:
    """Return the values after at most `steps` of Levenberg-Marquardt, and their number."""
    import gtsam

    settings = gtsam.LevenbergMarquardtParams()
    settings.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    settings.setMaxIterations(steps)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, settings)
    return optimizer.optimize(), int(optimizer.iterations())
