"""How well the pose graph knows where one keyframe is seen from another: what the loop gate asks, very often.

Perturbing every keyframe in map axes (map_from_body -> Exp(x_k) @ map_from_body) makes each edge a measurement of the
plain difference x_j - x_i. The covariance of a difference along a tree of edges is then a difference of sums from the
root, and every other edge lowers it by a rank-6 update (recursive least squares). So a query costs a few small matrix
products, with no factorisation, and an accepted loop is added without starting again. First order, exact for the
linearised graph.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fleetmap.features.matching_kernels import Indices
from fleetmap.geometry import Array, se3_inverse, se3_log
from mapserver.survey.graph_marginals_kernels import common_ancestors
from mapserver.survey.pose_graph import PoseEdge, adjoint, check_edges

CHI2_3_0999 = 16.266  # 0.999 of chi-square with 3 degrees of freedom: a place
CHI2_6_0999 = 22.458  # with 6: a place and a direction


class GraphMarginals:
    """Covariances of relative transforms in the graph of `edges`, linearised at map_from_body (K, 4, 4).

    All covariances (6, 6) are rotation first, of a perturbation in the axes of i: true i_from_j = Exp(x) @ i_from_j,
    as in PoseEdge. Loops count in full: pass those that are believed. Takes 288 bytes for each keyframe and loop.
    """

    def __init__(self, map_from_body: Array, edges: Sequence[PoseEdge]) -> None:
        """Raises SurveyError as `check_edges`."""
        check_edges(len(map_from_body), edges)
        # Seen from the middle of the site: far from the origin, turns would drown everything else in rounding.
        self._middle_m = map_from_body[:, :3, 3].mean(axis=0)
        self._map_from_body = map_from_body.copy()
        self._map_from_body[:, :3, 3] -= self._middle_m
        joined = self._joined(edges)
        tree = _spanning_tree(len(map_from_body), list(joined))
        self._parents, self._order = _rooted(len(map_from_body), tree)
        self._sums = np.zeros(
            (len(map_from_body), 6, 6)
        )  # covariance of each keyframe against the root, tree edges only
        for k in self._order[1:]:
            parent = int(self._parents[k])
            self._sums[k] = self._sums[parent] + joined[min(k, parent), max(k, parent)]
        others = [pair for pair in joined if pair not in set(tree)]
        self._updates = 0
        self._table = np.zeros((6 * len(others), 6 * len(map_from_body)))
        for i, j in others:
            self._update(i, j, joined[i, j])

    @property
    def map_from_body(self) -> Array:
        """(K, 4, 4) where the keyframes are by all edges that were added; to first order."""
        placed = self._map_from_body.copy()
        placed[:, :3, 3] += self._middle_m
        return placed

    @property
    def learned(self) -> int:
        """How many edges count besides those of the spanning tree."""
        return self._updates

    def add(self, edge: PoseEdge) -> None:
        """Takes one more edge into account, such as a loop just accepted: what it says narrows and moves the graph.

        Narrowing alone would refuse the next true loop of a place whose drift this one has shown.
        """
        check_edges(len(self._map_from_body), [edge], connected=False)
        said_map = adjoint(self._map_from_body[edge.i]) @ self._innovation(edge)
        gain = self._update(edge.i, edge.j, self._cov_map(edge))
        self._map_from_body = _moved(self._map_from_body, (gain @ said_map).reshape(-1, 6))

    def relative_cov(self, i: int, j: int) -> Array:
        """(6, 6) covariance of i_from_j."""
        return np.asarray(self.relative_covs(i, np.array([j]))[0])

    def relative_covs(self, i: int, js: Indices) -> Array:
        """(M, 6, 6) covariances of i_from_j for each j of js (M,)."""
        common = common_ancestors(self._parents, self._order, i)[js]
        cov_map = self._sums[i] + self._sums[js] - 2.0 * self._sums[common]
        if self._updates:
            table = self._table[: 6 * self._updates].reshape(6 * self._updates, -1, 6)
            learned = (table[:, js] - table[:, [i]]).transpose(1, 2, 0)
            cov_map -= learned @ learned.transpose(0, 2, 1)
        i_from_map = adjoint(se3_inverse(self._map_from_body[i]))
        return np.asarray(i_from_map @ cov_map @ i_from_map.T)

    def reachable(self, i: int, js: Indices, reach_m: float | Array, chi2: float = CHI2_3_0999) -> NDArray[np.bool_]:
        """(M,) whether keyframe j may be within `reach_m` of keyframe i, given how well their distance is known.

        True where (distance - reach)^2 / variance of the distance is at most `chi2`: no place inside the reach is
        nearer than that in Mahalanobis distance, so nothing that is possible is ruled out.
        """
        positions_map = self._map_from_body[:, :3, 3]
        apart = (positions_map[js] - positions_map[i]) @ self._map_from_body[i, :3, :3]  # in the axes of i
        distance_m = np.linalg.norm(apart, axis=1)
        beyond_m = np.maximum(distance_m - reach_m, 0.0)
        direction = apart / np.maximum(distance_m, 1e-12)[:, None]
        # A perturbation (r, t) moves j by r x apart + t, and the first part is across the direction.
        variance = np.einsum("ma,mab,mb->m", direction, self.relative_covs(i, js)[:, 3:, 3:], direction)
        return np.asarray(beyond_m**2 <= chi2 * variance)

    def innovation_squared(self, edge: PoseEdge) -> float:
        """Squared Mahalanobis distance, 6 degrees of freedom, of a measured edge from what the graph predicts.

        The graph must not hold the edge yet. Compare with CHI2_6_0999.
        """
        innovation = self._innovation(edge)
        cov = self.relative_cov(edge.i, edge.j) + edge.cov_rot_trans
        return float(innovation @ np.linalg.solve(cov, innovation))

    def gain(self, edge: PoseEdge) -> float:
        """Largest ratio of what the graph does not know to what the edge does not: below 1 the edge tells little."""
        return float(np.max(scipy.linalg.eigvalsh(self.relative_cov(edge.i, edge.j), edge.cov_rot_trans)))

    def _innovation(self, edge: PoseEdge) -> Array:
        """(6,) what a measured edge says against the graph, in the axes of i."""
        j_from_i = se3_inverse(self._map_from_body[edge.j]) @ self._map_from_body[edge.i]
        return se3_log(edge.i_from_j @ j_from_i)

    def _cov_map(self, edge: PoseEdge) -> Array:
        """(6, 6) covariance of an edge, of a perturbation in map axes."""
        map_from_i = adjoint(self._map_from_body[edge.i])
        return np.asarray(map_from_i @ edge.cov_rot_trans @ map_from_i.T)

    def _joined(self, edges: Sequence[PoseEdge]) -> dict[tuple[int, int], Array]:
        """Covariance of every pair in map axes, parallel edges made one; pairs with a safe edge come first."""
        parallel: dict[tuple[int, int], list[PoseEdge]] = {}
        for edge in sorted(edges, key=lambda edge: edge.is_loop):
            parallel.setdefault((min(edge.i, edge.j), max(edge.i, edge.j)), []).append(edge)
        return {pair: self._cov_map(self._one_of(bundle)) for pair, bundle in parallel.items()}

    def _one_of(self, parallel: list[PoseEdge]) -> PoseEdge:
        """One edge that knows what all of them know, in the axes of the first one's i, where numbers are small."""
        if len(parallel) == 1:
            return parallel[0]
        information = np.zeros((6, 6))
        i_from_map = se3_inverse(self._map_from_body[parallel[0].i])
        for edge in parallel:
            carried = adjoint(i_from_map @ self._map_from_body[edge.i])
            information += np.linalg.inv(carried @ edge.cov_rot_trans @ carried.T)
        return replace(parallel[0], cov_rot_trans=np.asarray(np.linalg.inv(information), np.float64))

    def _update(self, i: int, j: int, cov_map: Array) -> Array:
        """One more measured difference x_j - x_i: the rows that lower every covariance from now on.

        Returns the gain (6 K, 6): how far each keyframe moves by what the measurement says against the graph.
        """
        known = self._table[: 6 * self._updates]
        ancestors = [common_ancestors(self._parents, self._order, k) for k in (i, j)]
        shared = (self._sums[ancestors[1]] - self._sums[ancestors[0]]).transpose(1, 0, 2).reshape(6, -1)
        shared = shared - (_columns(known, j) - _columns(known, i)).T @ known
        innovation = _columns(shared, j) - _columns(shared, i) + cov_map
        root = np.linalg.cholesky(0.5 * (innovation + innovation.T))
        rows = np.linalg.solve(root, shared)
        if len(self._table) < 6 * (self._updates + 1):
            self._table = np.concatenate([self._table, np.zeros((max(len(self._table), 48), self._table.shape[1]))])
        self._table[6 * self._updates : 6 * (self._updates + 1)] = rows
        self._updates += 1
        return np.asarray(np.linalg.solve(root.T, rows).T)


def _moved(map_from_body: Array, perturbations: Array) -> Array:
    """Exp(x_k) @ map_from_body (K, 4, 4) for perturbations (K, 6), to second order in the translation."""
    turns = Rotation.from_rotvec(perturbations[:, :3]).as_matrix()
    shifts = perturbations[:, 3:] + 0.5 * np.cross(perturbations[:, :3], perturbations[:, 3:])
    moved = map_from_body.copy()
    moved[:, :3, :3] = turns @ map_from_body[:, :3, :3]
    moved[:, :3, 3] = np.einsum("kij,kj->ki", turns, map_from_body[:, :3, 3]) + shifts
    return moved


def _columns(table: Array, k: int) -> Array:
    return table[:, 6 * k : 6 * (k + 1)]


def _spanning_tree(count: int, pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The first pairs that join all nodes without a ring. Source: Kruskal 1956."""
    group = list(range(count))

    def group_of(k: int) -> int:
        while group[k] != k:
            group[k] = group[group[k]]
            k = group[k]
        return k

    tree = []
    for i, j in pairs:
        if group_of(i) != group_of(j):
            group[group_of(i)] = group_of(j)
            tree.append((i, j))
    return tree


def _rooted(count: int, tree: list[tuple[int, int]]) -> tuple[Indices, Indices]:
    """Parent of every node (-1 for node 0) and an order in which parents come first."""
    neighbours: list[list[int]] = [[] for _ in range(count)]
    for i, j in tree:
        neighbours[i].append(j)
        neighbours[j].append(i)
    parents, order = np.full(count, -1, np.int64), [0]
    for k in order:  # grows while it is read
        for other in neighbours[k]:
            if other != parents[k]:
                parents[other] = k
                order.append(other)
    return parents, np.array(order, np.int64)
