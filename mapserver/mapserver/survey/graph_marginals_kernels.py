"""Inner loop of the graph's covariances."""

import numpy as np

from fleetmap.features.matching_kernels import Indices
from fleetmap.kernel import kernel


@kernel
def common_ancestors(parents: Indices, order: Indices, k: int) -> Indices:
    """(K,) lowest common ancestor of node k and every node; parents (K,), -1 for the root; order (K,) root first."""
    on_path = np.zeros(len(parents), np.bool_)
    node = k
    while node >= 0:
        on_path[node] = True
        node = parents[node]
    common = np.empty(len(parents), np.int64)
    for node in order:
        common[node] = node if on_path[node] else common[parents[node]]
    return common
