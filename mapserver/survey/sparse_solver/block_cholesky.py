"""Cholesky factorisation of large sparse symmetric matrices whose unknowns come in blocks, such as poses: that of the core."""

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from fleetmap import core
from fleetmap.geometry import AnyArray


def block_cholesky(sizes: AnyArray, pairs: AnyArray) -> core.BlockCholesky:
    """The pattern of N nodes with sizes (N,) unknowns each, numbered one after the other, of which `pairs` (B, 2) are coupled."""
    sizes, pairs = np.asarray(sizes, np.int64), np.ascontiguousarray(pairs, np.int64).reshape(-1, 2)
    return core.BlockCholesky(sizes, pairs, _minimum_degree(len(sizes), pairs[pairs[:, 0] != pairs[:, 1]]))


def _minimum_degree(count: int, pairs: AnyArray) -> AnyArray:
    """(N,) nodes by minimum degree. SuperLU finds the order: that of a matrix with one unknown for each node costs next to nothing."""
    nodes = np.arange(count)
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    # Laplacian and unit: positive definite, whatever pairs there are.
    rows, cols = np.concatenate([nodes, ends[:, 0], ends[:, 0]]), np.concatenate([nodes, ends[:, 0], ends[:, 1]])
    values = np.concatenate([np.ones(count + len(ends)), np.full(len(ends), -1.0)])
    graph = scipy.sparse.csc_array((values, (rows, cols)), shape=(count, count))
    options = {"SymmetricMode": True}
    factor = scipy.sparse.linalg.splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.argsort(factor.perm_c)
