"""In which order blocks of unknowns are eliminated, so that little fills in."""

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from fleetmap.geometry import AnyArray


def minimum_degree(count: int, pairs: AnyArray) -> AnyArray:
    """(N,) nodes by minimum degree, of which `pairs` (B, 2) are coupled.

    SuperLU finds the order: that of a matrix with one unknown for each node costs next to nothing.
    """
    nodes, pairs = np.arange(count), pairs[pairs[:, 0] != pairs[:, 1]]
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    # Laplacian and unit: positive definite, whatever pairs there are.
    rows, cols = np.concatenate([nodes, ends[:, 0], ends[:, 0]]), np.concatenate([nodes, ends[:, 0], ends[:, 1]])
    values = np.concatenate([np.ones(count + len(ends)), np.full(len(ends), -1.0)])
    graph = scipy.sparse.csc_array((values, (rows, cols)), shape=(count, count))
    options = {"SymmetricMode": True}
    factor = scipy.sparse.linalg.splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.argsort(factor.perm_c)
