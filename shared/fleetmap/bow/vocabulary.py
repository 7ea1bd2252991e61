"""A tree of binary words: each descriptor goes down to the nearest child until it reaches a leaf, its word."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import vocabulary_kernels
from fleetmap.features.matching import Descriptors, packed
from fleetmap.features.matching_kernels import Indices, Packed

WordIds = NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class BowVector:
    """What a place looks like: word_ids (W,) rising, weights (W,) positive with sum 1 (both empty for no words)."""

    word_ids: WordIds
    weights: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.word_ids)


@dataclass(frozen=True, slots=True, eq=False)
class Vocabulary:
    """A tree of M nodes, breadth first from the root (node 0), with W leaves, numbered in that order: the words.

    centres (M, 4) uint64: medians of 256 bits, the root's unused. first_child and child_count (M,): a node's children
    are neighbours; none for a leaf. idf (W,): weight of each word, more for rarer ones.
    """

    centres: Packed
    first_child: NDArray[np.int32]
    child_count: NDArray[np.int32]
    idf: NDArray[np.float32]

    @property
    def word_count(self) -> int:
        """Number of words."""
        return len(self.idf)

    def words(self, descriptors: Descriptors) -> WordIds:
        """(N,) word of each descriptor (N, 32). Ties go to the lower node. Source: Nister and Stewenius 2006."""
        word_of_node = (np.cumsum(self.child_count == 0) - 1).astype(np.int32)
        return vocabulary_kernels.descend(
            packed(descriptors), self.centres, self.first_child, self.child_count, word_of_node
        )

    def branches(self, descriptors: Descriptors) -> NDArray[np.int32]:
        """(N, 2) the two children of the root that are nearest to each descriptor (N, 32), by their number; 0 without children."""
        children = self.centres[1 : 1 + int(self.child_count[0])]
        return vocabulary_kernels.two_nearest(packed(descriptors), children)

    def bow_vector(self, words: WordIds) -> BowVector:
        """The tf-idf vector of a place's words (N,), L1-normalised. Source: Galvez-Lopez and Tardos 2012 (DBoW2)."""
        word_ids, counts = np.unique(words, return_counts=True)
        assert len(word_ids) == 0 or (word_ids[0] >= 0 and word_ids[-1] < self.word_count)
        products = counts * self.idf[word_ids].astype(np.float64)
        used = products > 0.0
        weights = products[used] / max(float(products.sum()), 1e-300)
        return BowVector(word_ids[used].astype(np.int32), weights.astype(np.float32))


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
    centres = vocabulary_kernels.seed_centres(bits, members, branching, rng.random(branching))
    if len(centres) < 2:
        return []
    labels = vocabulary_kernels.cluster(bits, members, centres, _ITERATIONS)
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
