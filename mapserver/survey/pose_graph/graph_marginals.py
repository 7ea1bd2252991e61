"""Marginal covariances of relative transforms in a pose graph, for frequent queries by the loop gate.

Perturbing every keyframe in map axes (map_from_body -> Exp(x_k) @ map_from_body) makes each edge a measurement of the difference x_j
- x_i: odometry a chain of independent steps, every other edge a rank-6 update of it (recursive least squares). So a query costs a few small
matrix products without factorisation, and an accepted loop is an update. First order, exact for the linearised graph.
"""

from collections.abc import Sequence

import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

from fleetmap.features.matching import Indices
from fleetmap.geometry import Array, se3_adjoint, se3_inverse, se3_log, so3_left_jacobian
from mapserver.survey.pose_graph.chain_covariance import ChainCovariance
from mapserver.survey.pose_graph.pose_graph import PoseEdge, check_edges, optimize_pose_graph
from mapserver.survey.state import Mask

CHI2_3_0999 = 16.266  # 0.999 of chi-square with 3 degrees of freedom: a position
CHI2_6_0999 = 22.458  # with 6: a pose
_FIRST_ORDER_RAD = 0.5  # a loop that rotates the graph further must not be added to first order


class GraphMarginals:
    """Covariances of relative transforms in the graph of `edges`, linearised at map_from_body (K, 4, 4).

    All covariances (6, 6) are rotation first, of a perturbation in the axes of i: true i_from_j = Exp(x) @ i_from_j,
    as in PoseEdge. Some edge joins every keyframe with the next. Loops count in full: pass accepted ones only.
    Memory grows with the square of the edges beyond the chain, 1.2 kB times, and not with K.
    """

    def __init__(self, map_from_body: Array, edges: Sequence[PoseEdge]) -> None:
        """Raises SurveyError as `check_edges`."""
        check_edges(len(map_from_body), edges)
        self._linearise(map_from_body, edges)

    def _linearise(self, map_from_body: Array, edges: Sequence[PoseEdge]) -> None:
        self.linearised_at, self._edges = map_from_body, list(edges)
        # Relative to the middle of the site: far from the origin, rotations would cause large rounding errors.
        self._middle_m = map_from_body[:, :3, 3].mean(axis=0)
        self._map_from_body = map_from_body.copy()
        self._map_from_body[:, :3, 3] -= self._middle_m
        chain, others = _chain_and_others(len(map_from_body), edges)
        steps = [np.zeros((6, 6)), *(self._cov_map(edge) for edge in chain)]
        self._covariance = ChainCovariance(np.cumsum(steps, axis=0))
        self.learned = 0  # edges besides those of the chain
        for edge in others:
            self._measure(edge)

    @property
    def map_from_body(self) -> Array:
        """(K, 4, 4) poses of the keyframes by all added edges, to first order."""
        placed = self._map_from_body.copy()
        placed[:, :3, 3] += self._middle_m
        return placed

    def add(self, edge: PoseEdge) -> None:
        """Add an edge, such as a loop just accepted: it narrows the covariances and moves the graph.

        Narrowing alone would refuse the next true loop, at a place whose drift this one has shown.
        """
        check_edges(len(self._map_from_body), [edge], connected=False)
        self._edges.append(edge)
        if np.linalg.norm(self._innovation(edge)[:3]) > _FIRST_ORDER_RAD:
            solved = optimize_pose_graph(self.map_from_body, self._edges, robust=False)
            self._linearise(solved.map_from_body, self._edges)
            return
        said_map = se3_adjoint(self._map_from_body[edge.i]) @ self._innovation(edge)
        self._map_from_body = _moved(self._map_from_body, self._measure(edge) @ said_map)

    def relative_cov(self, i: int, j: int) -> Array:
        """Return (6, 6) covariance of i_from_j."""
        return np.asarray(self.relative_covs(i, np.array([j]))[0])

    def relative_covs(self, i: int, js: Indices) -> Array:
        """Return (M, 6, 6) covariances of i_from_j for each j of js (M,)."""
        cov_map = self._covariance.of_differences(i, js)
        i_from_map = se3_adjoint(se3_inverse(self._map_from_body[i]))
        return np.asarray(i_from_map @ cov_map @ i_from_map.T)

    def gate(self, i: int, js: Indices, reach_m: float | Array, sigmas: Array) -> tuple[Mask, Mask]:
        """Return (M,) which keyframes js are `reachable`, and for which i_from_j is known to sigmas (6,) in all directions at once.

        Both by one query of the covariances.
        """
        covariances = self.relative_covs(i, js)
        known = np.linalg.eigvalsh(covariances / (sigmas[:, None] * sigmas))[:, -1] < 1.0
        return self.reachable(i, js, reach_m, covariances), known

    def reachable(self, i: int, js: Indices, reach_m: float | Array, covariances: Array | None = None) -> Mask:
        """Return (M,) True if keyframe j may be within `reach_m` of keyframe i, given the uncertainty of their distance.

        True if (distance - reach)^2 / variance of the distance is within 0.999 of chi-square: no position within the reach is
        nearer than that in Mahalanobis distance, so no possible one is excluded. covariances: `relative_covs`, if known.
        """
        covariances = self.relative_covs(i, js) if covariances is None else covariances
        positions_map = self._map_from_body[:, :3, 3]
        apart = (positions_map[js] - positions_map[i]) @ self._map_from_body[i, :3, :3]  # in the axes of i
        distance_m = np.linalg.norm(apart, axis=1)
        beyond_m = np.maximum(distance_m - reach_m, 0.0)
        direction = apart / np.maximum(distance_m, 1e-12)[:, None]
        # A perturbation (r, t) moves j by r x apart + t; the first part is perpendicular to the direction.
        variance = np.einsum("ma,mab,mb->m", direction, covariances[:, 3:, 3:], direction)
        return np.asarray(beyond_m**2 <= CHI2_3_0999 * variance)

    def innovation_squared(self, edge: PoseEdge) -> float:
        """Return the squared Mahalanobis distance, 6 degrees of freedom, of a measured edge from the graph's prediction.

        The graph must not contain the edge yet. Compare with CHI2_6_0999.
        """
        innovation = self._innovation(edge)
        cov = self.relative_cov(edge.i, edge.j) + edge.cov_rot_trans
        return float(innovation @ np.linalg.solve(cov, innovation))

    def innovations_squared_beside(self, edge: PoseEdge, steps_map: Array) -> Array:
        """Return (M,) `innovation_squared` for an edge that puts keyframe i elsewhere: shifted by each of steps_map (M, 3)."""
        innovation = self._innovation(edge)
        # A step changes only the innovation's translation, and its logarithm is linear in that.
        map_from_j = self._map_from_body[edge.j]
        away = steps_map @ (edge.i_from_j[:3, :3] @ map_from_j[:3, :3].T).T
        beside = np.tile(innovation, (len(steps_map), 1))
        beside[:, 3:] -= np.linalg.solve(so3_left_jacobian(innovation[:3]), away.T).T
        cov = self.relative_cov(edge.i, edge.j) + edge.cov_rot_trans
        return np.asarray(np.einsum("ma,am->m", beside, np.linalg.solve(cov, beside.T)))

    def gain(self, edge: PoseEdge, enough: Array) -> float:
        """Return the largest variance ratio of the graph's prediction to the edge, counting from a cov_rot_trans (6, 6) that
        is accurate `enough`: below 1 the edge adds little.
        """
        return float(np.max(scipy.linalg.eigvalsh(self.relative_cov(edge.i, edge.j), edge.cov_rot_trans + enough)))

    def _innovation(self, edge: PoseEdge) -> Array:
        """Return (6,) innovation of a measured edge against the graph, in the axes of i."""
        j_from_i = se3_inverse(self._map_from_body[edge.j]) @ self._map_from_body[edge.i]
        return se3_log(edge.i_from_j @ j_from_i)

    def _cov_map(self, edge: PoseEdge) -> Array:
        """Return (6, 6) covariance of an edge, of a perturbation in map axes."""
        map_from_i = se3_adjoint(self._map_from_body[edge.i])
        return np.asarray(map_from_i @ edge.cov_rot_trans @ map_from_i.T)

    def _measure(self, edge: PoseEdge) -> Array:
        """Return (K, 6, 6) displacement of each keyframe per innovation of the edge, which is then part of the graph."""
        self.learned += 1
        return self._covariance.measure(edge.i, edge.j, self._cov_map(edge))


def _chain_and_others(count: int, edges: Sequence[PoseEdge]) -> tuple[list[PoseEdge], list[PoseEdge]]:
    """Return one edge from each keyframe to the next, safe ones first, and the remaining ones."""
    chain: dict[int, PoseEdge] = {}
    others = []
    for edge in sorted(edges, key=lambda edge: edge.is_loop):
        first = min(edge.i, edge.j)
        if abs(edge.i - edge.j) == 1 and first not in chain:
            chain[first] = edge
        else:
            others.append(edge)
    assert len(chain) == count - 1, f"{len(chain)} of {count - 1} keyframes are joined with the next"
    return [chain[k] for k in range(count - 1)], others


def _moved(map_from_body: Array, perturbations: Array) -> Array:
    """Return Exp(x_k) @ map_from_body (K, 4, 4) for perturbations (K, 6), to second order in the translation."""
    turns = Rotation.from_rotvec(perturbations[:, :3]).as_matrix()
    shifts = perturbations[:, 3:] + 0.5 * np.cross(perturbations[:, :3], perturbations[:, 3:])
    moved = map_from_body.copy()
    moved[:, :3, :3] = turns @ map_from_body[:, :3, :3]
    moved[:, :3, 3] = np.einsum("kij,kj->ki", turns, map_from_body[:, :3, 3]) + shifts
    return moved
