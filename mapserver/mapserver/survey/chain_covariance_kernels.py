"""Inner loops of a chain's covariances: between the anchors every place is an interpolation plus a bridge of its own."""

import numpy as np

from fleetmap.features.matching_kernels import Indices
from fleetmap.geometry import Array
from fleetmap.kernel import kernel
from fleetmap.linear_kernels import matmul, matmul_nt


@kernel
def interpolated(rows_before: Array, rows_after: Array, share: Array) -> Array:
    """(6, n) rows of a place that lies that share (6, 6) of the way from one anchor to the next."""
    return np.asarray(rows_before + matmul(share, rows_after - rows_before))


@kernel
def anchor_row(k: int, joint: Array, before: Indices, after: Indices, shares: Array) -> Array:
    """(6, 6 m) covariance of place k with every anchor."""
    a, b = 6 * before[k], 6 * after[k]
    return interpolated(joint[a : a + 6], joint[b : b + 6], shares[k])


@kernel
def _with_place(row: Array, k: int, before: Indices, after: Indices, shares: Array) -> Array:
    """(6, 6) covariance of what has that row (6, 6 m) with place k, bridges left out."""
    a, b = 6 * before[k], 6 * after[k]
    at_a, at_b = row[:, a : a + 6], row[:, b : b + 6]
    return np.asarray(at_a + matmul_nt(at_b - at_a, shares[k]))


@kernel
def _bridge(k: int, other: int, sums: Array, starts: Indices, shares: Array) -> Array:
    """(6, 6) covariance that places k <= other between the same anchors have beyond what the anchors say."""
    start = sums[starts[k]]
    return np.asarray(sums[k] - start - matmul(shares[k], sums[other] - start))


@kernel
def place_covariance(
    k: int, joint: Array, sums: Array, starts: Indices, before: Indices, after: Indices, shares: Array
) -> Array:
    """(6, 6) covariance of place k."""
    a, b = 6 * before[k], 6 * after[k]
    row_a = _with_place(joint[a : a + 6], k, before, after, shares)
    row_b = _with_place(joint[b : b + 6], k, before, after, shares)
    return np.asarray(interpolated(row_a, row_b, shares[k]) + _bridge(k, k, sums, starts, shares))


@kernel
def difference_covariances(
    i: int, js: Indices, joint: Array, sums: Array, starts: Indices, before: Indices, after: Indices, shares: Array
) -> Array:
    """(M, 6, 6) covariances of x_j - x_i for each j of js; see ChainCovariance for the rest."""
    row = anchor_row(i, joint, before, after, shares)
    own = place_covariance(i, joint, sums, starts, before, after, shares)
    out = np.empty((len(js), 6, 6))
    for n in range(len(js)):
        j = js[n]
        cross = _with_place(row, j, before, after, shares)
        if starts[i] == starts[j]:
            if i <= j:
                cross = cross + _bridge(i, j, sums, starts, shares)
            else:
                cross = cross + _bridge(j, i, sums, starts, shares).T
        out[n] = own + place_covariance(j, joint, sums, starts, before, after, shares) - cross - cross.T
    return out


@kernel
def lower(joint: Array, half: Array) -> None:
    """Takes half.T @ half, half (6, n), off the symmetric joint (n, n) in place."""
    n = half.shape[1]
    for i in range(n):
        for c in range(6):
            x = half[c, i]
            if x != 0.0:
                for j in range(n):
                    joint[i, j] -= x * half[c, j]
