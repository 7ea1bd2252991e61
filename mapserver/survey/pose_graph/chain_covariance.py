"""Covariances along a chain of independent steps with measured differences between distant links: low memory, fast queries."""

import numpy as np

from fleetmap.features.matching import Indices
from fleetmap.geometry import Array

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
        self._split(k, slot)
        return slot

    def _split(self, k: int, slot: int) -> None:
        """Make place k the end of the interval before it and the start of the one after it."""
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

    def _share(self, start: int, end: int, slot: int) -> None:
        """Assign the places from start until before end to these two anchors; slot is that of the end."""
        way = self._sums[start:end] - self._sums[start]
        whole = self._sums[end] - self._sums[start]
        self._shares[start:end] = np.linalg.solve(whole, way).transpose(0, 2, 1)
        self._after[start:end] = slot
