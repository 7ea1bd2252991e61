"""Elimination order of blocks of unknowns, for little fill-in."""

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from fleetmap.geometry import AnyArray


def minimum_degree(count: int, pairs: AnyArray) -> AnyArray:
    """Return (N,) nodes in minimum degree order; `pairs` (B, 2) are coupled nodes.

    SuperLU computes the order from a matrix with one unknown per node, at negligible cost.
    """
    nodes, pairs = np.arange(count), pairs[pairs[:, 0] != pairs[:, 1]]
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    # Laplacian plus identity: positive definite for any pairs.
    rows, cols = np.concatenate([nodes, ends[:, 0], ends[:, 0]]), np.concatenate([nodes, ends[:, 0], ends[:, 1]])
    values = np.concatenate([np.ones(count + len(ends)), np.full(len(ends), -1.0)])
    graph = scipy.sparse.csc_array((values, (rows, cols)), shape=(count, count))
    options = {"SymmetricMode": True}
    factor = scipy.sparse.linalg.splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.argsort(factor.perm_c)
