"""Inner loops of the vocabulary tree: clustering of binary descriptors, and descent to the words."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching_kernels import FAR, Indices, Packed, hamming
from fleetmap.geometry import Array
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


@kernel
def seed_centres(packed: Packed, members: Indices, branching: int, uniforms: Array) -> Packed:
    """Up to `branching` distinct members, spread out; fewer where there are fewer. Source: Arthur 2007 (k-means++)."""
    centres = np.empty((branching, 4), np.uint64)
    squared = np.full(len(members), FAR * FAR, np.int64)
    chosen = 0
    pick = int(uniforms[0] * len(members))
    while True:
        centres[chosen] = packed[members[pick]]
        chosen += 1
        total = 0
        for m in range(len(members)):
            distance = hamming(packed, members[m], centres, chosen - 1)
            squared[m] = min(squared[m], distance * distance)
            total += squared[m]
        if chosen == branching or total == 0:
            return centres[:chosen].copy()
        target, passed = uniforms[chosen] * total, 0
        for m in range(len(members)):
            passed += squared[m]
            if passed > target:
                pick = m
                break


@kernel
def cluster(packed: Packed, members: Indices, centres: Packed, iterations: int) -> Indices:
    """Label (len(members),) of the nearest centre after refining `centres` in place. Source: Grana 2013 (k-majority).

    A centre is the bit-wise majority of its members (ties: 0). One that nobody belongs to stays where it is.
    """
    labels = np.full(len(members), -1, np.int64)
    for _ in range(iterations):
        ones = np.zeros((len(centres), 256), np.int64)
        counts = np.zeros(len(centres), np.int64)
        changed = False
        for m in range(len(members)):
            best, nearest = FAR, 0
            for c in range(len(centres)):
                distance = hamming(packed, members[m], centres, c)
                if distance < best:
                    best, nearest = distance, c
            changed = changed or labels[m] != nearest
            labels[m] = nearest
            counts[nearest] += 1
            for word in range(4):
                bits = packed[members[m], word]
                for bit in range(64):
                    ones[nearest, 64 * word + bit] += np.int64((bits >> np.uint64(bit)) & np.uint64(1))
        if not changed:
            break
        for c in range(len(centres)):
            for word in range(4):
                majority = np.uint64(0)
                for bit in range(64):
                    if 2 * ones[c, 64 * word + bit] > counts[c]:
                        majority |= np.uint64(1) << np.uint64(bit)
                if counts[c] > 0:
                    centres[c, word] = majority
    return labels
