"""Pose graph optimization over SE(3): the best fit of poses to measured relative transforms, and the outlier loops."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.special import gammaincinv

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, se3_inverse, skew
from mapserver.survey.pose_graph.gnc import loop_weights

_FIXED_SIGMA = 1e-6
_INLIER_PROBABILITY = 0.999
_MAX_ITERATIONS = 100
_FIRST_ITERATIONS = 15  # before another start is considered


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


@dataclass(frozen=True, slots=True)
class PoseGraphResult:
    """Optimised map_from_body (K, 4, 4).

    loop_weights has one number for each loop edge in order: 1 accepted, 0 rejected; below 0.5 a loop did not affect the result. Costs are
    half the sum of squared normalised residuals of the accepted edges, at the start and at the result. iterations of the last solve.
    """

    map_from_body: Array
    loop_weights: Array
    cost_before: float
    cost_after: float
    iterations: int


def adjoint(target_from_source: Array) -> Array:
    """Return the (6, 6) matrix that maps a perturbation from source to target axes, rotation first. Source: Barfoot, 7.45."""
    rotation = target_from_source[:3, :3]
    carried = np.zeros((6, 6))
    carried[:3, :3] = carried[3:, 3:] = rotation
    carried[3:, :3] = skew(target_from_source[:3, 3]) @ rotation
    return carried


def optimize_pose_graph(map_from_body: Array, edges: Sequence[PoseEdge], *, robust: bool = True) -> PoseGraphResult:
    """Return the poses of K keyframes with the best fit to the edges, from a start map_from_body (K, 4, 4); the first is unchanged.

    robust: loops that contradict the rest are rejected, by graduated non-convexity with truncated least squares in which all other edges
    are assumed true; a loop is consistent while its squared residual stays within the 0.999 of chi-square. If the
    result is less likely than its edges' covariances allow, a second start without initial values (chordal relaxation of the rotations) is
    tried, and the better result returned. Raises SurveyError for edges that leave a keyframe unconnected, have an invalid index or an
    invalid covariance. Source: Yang et al. 2020 (GNC); Carlone et al. 2015 (chordal start), as in gtsam.
    """
    check_edges(len(map_from_body), edges)
    begin = start = _values(map_from_body)
    loops = [index for index, edge in enumerate(edges) if edge.is_loop]
    weights = np.ones(len(loops))
    try:
        if robust and loops:
            graph = _graph(map_from_body, edges)
            doubtful, certain = [_with_noise(graph.at(n)) for n in loops], gtsam.NonlinearFactorGraph()
            for n in sorted(set(range(graph.size())) - set(loops)):
                certain.push_back(graph.at(n))
            # chi-square; scipy.stats takes half a second to import
            bound = float(2.0 * gammaincinv(3.0, _INLIER_PROBABILITY))
            weights, begin = loop_weights(certain, doubtful, start, bound)
        believed = dict(zip(loops, weights >= 0.5, strict=True))
        kept = [edge for index, edge in enumerate(edges) if believed.get(index, True)]
        graph = _graph(map_from_body, kept)
        optimum, iterations = _optimum(graph, begin, 6 * (len(kept) - len(map_from_body) + 1))
    except RuntimeError as error:
        raise SurveyError(
            f"the pose graph of {len(map_from_body)} keyframes and {len(edges)} edges cannot be solved "
            f"({str(error).strip().splitlines()[0]}); look for keyframes connected only by a wrong loop"
        ) from error
    solved = np.array([optimum.atPose3(k).matrix() for k in range(len(map_from_body))])
    solved = map_from_body[0] @ se3_inverse(solved[0]) @ solved  # the prior allows a deviation of 1e-6
    solved[0] = map_from_body[0]
    return PoseGraphResult(solved, weights, graph.error(start), graph.error(optimum), iterations)


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
    lost = sorted(set(range(count)) - _joined_to_first(edges)) if connected and count else []
    if lost:
        raise SurveyError(f"keyframes {lost[:10]} ({len(lost)} in all) have no edge towards keyframe 0; leave them out")


def _joined_to_first(edges: Sequence[PoseEdge]) -> set[int]:
    neighbours: dict[int, list[int]] = {}
    for edge in edges:
        neighbours.setdefault(edge.i, []).append(edge.j)
        neighbours.setdefault(edge.j, []).append(edge.i)
    found, ahead = {0}, [0]
    while ahead:
        new = [k for k in neighbours.get(ahead.pop(), []) if k not in found]
        found.update(new)
        ahead.extend(new)
    return found


def _is_covariance(cov: Array) -> bool:
    if not np.isfinite(cov).all():
        return False
    try:
        np.linalg.cholesky(cov)
    except np.linalg.LinAlgError:
        return False
    return True


def _values(map_from_body: Array) -> gtsam.Values:
    values = gtsam.Values()
    for k, map_from_k in enumerate(map_from_body):
        values.insert(k, gtsam.Pose3(map_from_k))
    return values


def _graph(map_from_body: Array, edges: Sequence[PoseEdge]) -> gtsam.NonlinearFactorGraph:
    """Return the edges as factors, in order, then the factor that fixes the first keyframe."""
    graph = gtsam.NonlinearFactorGraph()
    for edge in edges:
        j_from_i = adjoint(se3_inverse(edge.i_from_j))  # gtsam perturbs on the right, in the axes of j
        cov = j_from_i @ edge.cov_rot_trans @ j_from_i.T
        noise = gtsam.noiseModel.Gaussian.Covariance(0.5 * (cov + cov.T))
        graph.add(gtsam.BetweenFactorPose3(edge.i, edge.j, gtsam.Pose3(edge.i_from_j), noise))
    anchor = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED_SIGMA)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(map_from_body[0]), anchor))
    return graph


def _optimum(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, freedom: int) -> tuple[gtsam.Values, int]:
    """Return the lowest minimum found, and the iterations from its start."""
    best, spent = _descend(graph, start, _FIRST_ITERATIONS)
    if 2.0 * graph.error(best) > freedom + 5.0 * np.sqrt(2.0 * max(freedom, 1)):
        other, other_spent = _without_guess(graph, _FIRST_ITERATIONS)
        if other is not None and graph.error(other) < graph.error(best):
            best, spent = other, other_spent
    if spent < _FIRST_ITERATIONS:
        return best, spent
    best, more = _descend(graph, best, _MAX_ITERATIONS - spent)
    return best, spent + more


def _without_guess(graph: gtsam.NonlinearFactorGraph, iterations: int) -> tuple[gtsam.Values | None, int]:
    """Return the result from the chordal start, None if the graph is too badly conditioned for one."""
    try:
        return _descend(graph, gtsam.InitializePose3.initialize(graph), iterations)
    except RuntimeError:
        return None, 0


def _descend(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, iterations: int) -> tuple[gtsam.Values, int]:
    settings = gtsam.LevenbergMarquardtParams()
    settings.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    settings.setMaxIterations(iterations)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, settings)
    return optimizer.optimize(), int(optimizer.iterations())


def _with_noise(factor: gtsam.NonlinearFactor) -> gtsam.NoiseModelFactor:
    assert isinstance(factor, gtsam.NoiseModelFactor)
    return factor
