"""Covariances along a chain of independent steps with measured differences between far links: little memory, quick answers."""

import numpy as np

from fleetmap.features.matching_kernels import Indices
from fleetmap.geometry import Array
from mapserver.survey import chain_covariance_kernels as kernels

_FIRST_CAPACITY = 16


class ChainCovariance:
    """Joint covariance of x_0 = 0, x_1, ..., each a step on from the one before, after measurements of x_j - x_i.

    Only the ends of measurements are kept in full, as anchors. Between two of them a place is the share of the way that its
    steps' covariance has in the whole way's, plus a bridge which no measurement has touched: a Gauss-Markov chain, so
    nothing is approximated. Memory and a measurement cost go with the square of the anchors, an answer with their number;
    how long the chain is does not matter.
    """

    def __init__(self, sums: Array) -> None:
        """sums (K, 6, 6): covariance of each x_k before any measurement, sums[0] = 0."""
        self._sums = np.ascontiguousarray(sums)
        count = len(sums)
        self._anchors = [0]  # keyframes, in the order in which they became anchors: their slots in the joint covariance
        self._joint = np.zeros((6 * _FIRST_CAPACITY, 6 * _FIRST_CAPACITY))
        self._starts = np.zeros(count, np.int64)  # the last anchor at or before each place
        self._before = np.zeros(count, np.int64)  # its slot
        self._after = np.zeros(count, np.int64)  # the next one's slot; behind the last anchor the same with no share
        self._shares = np.zeros((count, 6, 6))

    def of_differences(self, i: int, js: Indices) -> Array:
        """(M, 6, 6) covariances of x_j - x_i for each j of js (M,)."""
        return kernels.difference_covariances(
            i, js, self._joint, self._sums, self._starts, self._before, self._after, self._shares
        )

    def measure(self, i: int, j: int, cov: Array) -> Array:
        """Takes a measurement of x_j - x_i with cov (6, 6) into account.

        Returns the gain (K, 6, 6): how far each place moves by what the measurement says against the prediction.
        """
        a, b = (6 * self._anchor(k) for k in (i, j))
        size = 6 * len(self._anchors)
        row = self._joint[b : b + 6, :size] - self._joint[a : a + 6, :size]
        innovation = row[:, b : b + 6] - row[:, a : a + 6] + cov
        root = np.linalg.cholesky(0.5 * (innovation + innovation.T))
        half = np.linalg.solve(root, row)
        kernels.lower(self._joint[:size, :size], half)
        gains = np.linalg.solve(root.T, half).T.reshape(-1, 6, 6)
        before, after = gains[self._before], gains[self._after]
        return np.asarray(before + self._shares @ (after - before))

    def _anchor(self, k: int) -> int:
        """The slot of place k, made an anchor if it is none yet."""
        if self._starts[k] == k:
            return int(self._before[k])
        slot = len(self._anchors)
        if len(self._joint) < 6 * (slot + 1):
            grown = np.zeros((2 * len(self._joint), 2 * len(self._joint)))
            grown[: 6 * slot, : 6 * slot] = self._joint
            self._joint = grown
        row = kernels.anchor_row(k, self._joint, self._before, self._after, self._shares)[:, : 6 * slot]
        own = kernels.place_covariance(
            k, self._joint, self._sums, self._starts, self._before, self._after, self._shares
        )
        here = slice(6 * slot, 6 * slot + 6)
        self._joint[here, : 6 * slot], self._joint[: 6 * slot, here] = row, row.T
        self._joint[here, here] = 0.5 * (own + own.T)
        self._split(k, slot)
        return slot

    def _split(self, k: int, slot: int) -> None:
        """Place k becomes the end of the stretch before it and the start of the one behind it."""
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
        """The places from start until before end lie between these two anchors; slot is that of the end."""
        way = self._sums[start:end] - self._sums[start]
        whole = self._sums[end] - self._sums[start]
        self._shares[start:end] = np.linalg.solve(whole, way).transpose(0, 2, 1)
        self._after[start:end] = slot
