"""Inner loops of the vocabulary tree: descent of binary descriptors to the words."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching_kernels import FAR, Packed, hamming
from fleetmap.numerics.kernel import kernel


@kernel
def descend(
    packed: Packed,
    centres: Packed,
    first_child: NDArray[np.int32],
    child_count: NDArray[np.int32],
    word_of_node: NDArray[np.int32],
) -> NDArray[np.int32]:
    """(N,) word of each descriptor."""
    words = np.empty(len(packed), np.int32)
    for i in range(len(packed)):
        node = 0
        while child_count[node] > 0:
            best, nearest = FAR, 0
            for child in range(first_child[node], first_child[node] + child_count[node]):
                distance = hamming(packed, i, centres, child)
                if distance < best:
                    best, nearest = distance, child
            node = nearest
        words[i] = word_of_node[node]
    return words


@kernel
def two_nearest(packed: Packed, centres: Packed) -> NDArray[np.int32]:
    """(N, 2) numbers of the nearest centre and the second nearest, the same twice for one centre, 0 for none. Ties: lower number."""
    found = np.zeros((len(packed), 2), np.int32)
    for i in range(len(packed)):
        best, runner_up = FAR, FAR + 1
        for c in range(len(centres)):
            distance = hamming(packed, i, centres, c)
            if distance < best:
                best, runner_up = distance, best
                found[i, 0], found[i, 1] = c, found[i, 0]
            elif distance < runner_up:
                runner_up = distance
                found[i, 1] = c
    return found
