"""Marginal covariances of relative transforms in a pose graph, for frequent queries by the loop gate.

Perturbing every keyframe in map axes (map_from_body -> Exp(x_k) @ map_from_body) makes each edge a measurement of the difference x_j
- x_i: odometry a chain of independent steps, every other edge a rank-6 update of it (recursive least squares). So a query costs a few small
matrix products without factorisation, and an accepted loop is an update. First order, exact for the linearised graph.
"""

from collections.abc import Sequence

import numpy as np
import scipy

from fleetmap.geometry import Array, Indices, Mask, se3_adjoint, se3_inverse, se3_log, so3_left_jacobian
from mapserver.survey.pose_graph.pose_graph import PoseEdge, check_edges, optimize_pose_graph

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
    turns = scipy.spatial.transform.Rotation.from_rotvec(perturbations[:, :3]).as_matrix()
    shifts = perturbations[:, 3:] + 0.5 * np.cross(perturbations[:, :3], perturbations[:, 3:])
    moved = map_from_body.copy()
    moved[:, :3, :3] = turns @ map_from_body[:, :3, :3]
    moved[:, :3, 3] = np.einsum("kij,kj->ki", turns, map_from_body[:, :3, 3]) + shifts
    return moved


_FIRST_CAPACITY = 16
_ROWS = 256  # updated at once by a measurement


class ChainCovariance:
    """Joint covariance of x_0 = 0, x_1, ..., each one step from the previous one, after measurements of x_j - x_i.

    Only the ends of measurements are stored in full, as anchors. Between two of them a place is interpolated by the share of
    its steps' covariance in that of the whole interval, plus a bridge unaffected by measurements: the chain is
    Gauss-Markov, so nothing is approximated. Memory and the cost of a measurement grow with the square of the anchors, a query with its
    number of places; the length of the chain does not matter.
    """

    def __init__(self, sums: Array) -> None:
        """sums (K, 6, 6): covariance of each x_k before any measurement, sums[0] = 0."""
        self._sums = np.ascontiguousarray(sums)
        count = len(sums)
        self._anchors = [0]  # keyframes in order of becoming anchors; the index is the slot in the joint covariance
        self._joint = np.zeros((6 * _FIRST_CAPACITY, 6 * _FIRST_CAPACITY))
        self._starts = np.zeros(count, np.int64)  # the last anchor at or before each place
        self._before = np.zeros(count, np.int64)  # its slot
        self._after = np.zeros(count, np.int64)  # the next one's slot; after the last anchor the same with share 0
        self._shares = np.zeros((count, 6, 6))

    def of_differences(self, i: int, js: Indices) -> Array:
        """Return (M, 6, 6) covariances of x_j - x_i for each j of js (M,)."""
        before, after = self._crossing(i, self._before[js]), self._crossing(i, self._after[js])
        cross = before + (after - before) @ self._shares[js].transpose(0, 2, 1)
        near = np.flatnonzero(self._starts[js] == self._starts[i])
        cross[near] += self._bridges(i, js[near])
        own = self._covariances(np.append(js, i))
        return np.asarray(own[:-1] + own[-1] - cross - cross.transpose(0, 2, 1))

    def measure(self, i: int, j: int, cov: Array) -> Array:
        """Update by a measurement of x_j - x_i with cov (6, 6).

        Returns the gain (K, 6, 6): displacement of each place per innovation of the measurement.
        """
        a, b = (6 * self._anchor(k) for k in (i, j))
        size = 6 * len(self._anchors)
        row = self._joint[b : b + 6, :size] - self._joint[a : a + 6, :size]
        innovation = row[:, b : b + 6] - row[:, a : a + 6] + cov
        root = np.linalg.cholesky(0.5 * (innovation + innovation.T))
        half = np.linalg.solve(root, row)
        for start in range(0, size, _ROWS):  # the whole product would need as much memory as the matrix
            self._joint[start : min(start + _ROWS, size), :size] -= half[:, start : start + _ROWS].T @ half
        gains = np.linalg.solve(root.T, half).T.reshape(-1, 6, 6)
        before, after = gains[self._before], gains[self._after]
        return np.asarray(before + self._shares @ (after - before))

    def _crossing(self, k: int, slots: Indices) -> Array:
        """Return (M, 6, 6) covariance of place k with the anchors in some slots (M,)."""
        blocks = self._joint.reshape(len(self._joint) // 6, 6, -1, 6)
        before, after = blocks[self._before[k], :, slots], blocks[self._after[k], :, slots]
        return np.asarray(before + self._shares[k] @ (after - before))

    def _covariances(self, ks: Indices) -> Array:
        """Return (M, 6, 6) covariance of each single place."""
        blocks = self._joint.reshape(len(self._joint) // 6, 6, -1, 6)
        a, b, shares = self._before[ks], self._after[ks], self._shares[ks]
        first, last, both = blocks[a, :, a], blocks[b, :, b], blocks[b, :, a]
        shift = shares @ (both - first)
        spread = shares @ (last - both - both.transpose(0, 2, 1) + first) @ shares.transpose(0, 2, 1)
        walked = self._sums[ks] - self._sums[self._starts[ks]]
        return np.asarray(first + shift + shift.transpose(0, 2, 1) + spread + walked - shares @ walked)

    def _bridges(self, i: int, js: Indices) -> Array:
        """Return (M, 6, 6) covariances of place i with places between the same anchors, beyond those by the anchors."""
        start = self._sums[self._starts[i]]
        walked_i, walked_j = self._sums[i] - start, self._sums[js] - start
        ahead = (js >= i)[:, None, None]
        onward, back = walked_i - self._shares[i] @ walked_j, walked_j - walked_i @ self._shares[js].transpose(0, 2, 1)
        return np.asarray(np.where(ahead, onward, back))

    def _anchor(self, k: int) -> int:
        """Return the slot of place k, made an anchor if needed."""
        if self._starts[k] == k:
            return int(self._before[k])
        slot = len(self._anchors)
        if len(self._joint) < 6 * (slot + 1):
            capacity = slot + max(slot // 4, _FIRST_CAPACITY)  # by a quarter, as memory goes with the square
            grown = np.zeros((6 * capacity,) * 2)
            grown[: 6 * slot, : 6 * slot] = self._joint
            self._joint = grown
        row = self._crossing(k, np.arange(slot)).transpose(1, 0, 2).reshape(6, -1)
        own = self._covariances(np.array([k]))[0]
        here = slice(6 * slot, 6 * slot + 6)
        self._joint[here, : 6 * slot], self._joint[: 6 * slot, here] = row, row.T
        self._joint[here, here] = 0.5 * (own + own.T)
        # It is the end of the interval before it and the start of the one after it.
        start, had_end = int(self._starts[k]), self._after[k] != self._before[k]
        end = self._anchors[self._after[k]] if had_end else len(self._sums)
        self._anchors.append(k)
        self._share(start, k, slot)
        self._starts[k:end] = k
        self._before[k:end] = slot
        if had_end:
            self._share(k, end, int(self._after[k]))
        else:
            self._after[k:end] = slot
        return slot

    def _share(self, start: int, end: int, slot: int) -> None:
        """Assign the places from start until before end to these two anchors; slot is that of the end."""
        way = self._sums[start:end] - self._sums[start]
        whole = self._sums[end] - self._sums[start]
        self._shares[start:end] = np.linalg.solve(whole, way).transpose(0, 2, 1)
        self._after[start:end] = slot
