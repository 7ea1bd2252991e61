"""Training of vocabularies: how the one that ships was made, and small ones for tests."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import Vocabulary
from fleetmap.features.matching import Descriptors, packed
from fleetmap.features.matching_kernels import FAR, Indices, Packed, hamming
from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel

_ITERATIONS = 8


def train_vocabulary(
    descriptors: Descriptors,
    branching: int,
    levels: int,
    rng: np.random.Generator,
    images: NDArray[np.integer] | None = None,
) -> Vocabulary:
    """A tree with at most `branching` children a node and `levels` levels below the root, of descriptors (N, 32).

    images (N,): which image each descriptor is from, for the words' rarity; without it, or with one image only, all
    words weigh the same. A node with no more members than `branching`, or with equal ones, stays a leaf; no descriptors
    at all make a vocabulary of one word. The same input and generator state give the same vocabulary.
    """
    assert 2 <= branching <= 64
    assert 1 <= levels < 16
    bits = packed(descriptors)
    centres, counts = [np.zeros((1, 4), np.uint64)], []
    layer = [np.arange(len(bits))]
    for _ in range(levels):
        below: list[Indices] = []
        for members in layer:
            groups = _split(bits, members, branching, rng)
            counts.append(len(groups))
            centres.extend(centre[None] for centre, _ in groups)
            below.extend(group for _, group in groups)
        layer = below
    counts.extend([0] * len(layer))
    child_count = np.array(counts, np.int32)
    first_child = (1 + np.cumsum(child_count) - child_count).astype(np.int32)
    first_child[child_count == 0] = 0
    tree = Vocabulary(
        np.concatenate(centres), first_child, child_count, np.ones(int((child_count == 0).sum()), np.float32)
    )
    return Vocabulary(tree.centres, first_child, child_count, _idf(tree, descriptors, images))


def _split(bits: Packed, members: Indices, branching: int, rng: np.random.Generator) -> list[tuple[Packed, Indices]]:
    """Centre and members of each child; none where the node is to stay a leaf."""
    if len(members) <= branching:
        return []
    centres = seed_centres(bits, members, branching, rng.random(branching))
    if len(centres) < 2:
        return []
    labels = cluster(bits, members, centres, _ITERATIONS)
    groups = [(centres[c], members[labels == c]) for c in range(len(centres))]
    kept = [(centre, group) for centre, group in groups if len(group) > 0]
    return kept if len(kept) > 1 else []


def _idf(tree: Vocabulary, descriptors: Descriptors, images: NDArray[np.integer] | None) -> NDArray[np.float32]:
    """log(1 + images / images with the word): as in text retrieval, but never 0, for sites of few images."""
    if images is None or len(images) == 0 or images.min() == images.max():
        return tree.idf
    assert len(images) == len(descriptors)
    numbers, image = np.unique(images, return_inverse=True)
    seen = np.unique(np.column_stack([tree.words(descriptors), image]), axis=0)[:, 0]
    holding = np.bincount(seen, minlength=tree.word_count)
    return np.log(1.0 + len(numbers) / np.maximum(holding, 1)).astype(np.float32)


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
