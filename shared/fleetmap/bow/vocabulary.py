"""A tree of binary words: a descriptor descends to the nearest child until it reaches a leaf, which is its word."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.matching import Descriptors, Packed, packed

WordIds = NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class BowVector:
    """Appearance of a place: word_ids (W,) ascending, weights (W,) positive with sum 1 (both empty without words)."""

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
        return core.descend(packed(descriptors), self.centres, self.first_child, self.child_count, word_of_node)

    def branches(self, descriptors: Descriptors) -> NDArray[np.int32]:
        """(N, 2) numbers of the two children of the root nearest to each descriptor (N, 32); 0 without children."""
        children = self.centres[1 : 1 + int(self.child_count[0])]
        return core.two_nearest(packed(descriptors), children)

    def bow_vector(self, words: WordIds) -> BowVector:
        """The tf-idf vector of a place's words (N,), L1-normalised. Source: Galvez-Lopez and Tardos 2012 (DBoW2)."""
        word_ids, counts = np.unique(words, return_counts=True)
        assert len(word_ids) == 0 or (word_ids[0] >= 0 and word_ids[-1] < self.word_count)
        products = counts * self.idf[word_ids].astype(np.float64)
        used = products > 0.0
        weights = products[used] / max(float(products.sum()), 1e-300)
        return BowVector(word_ids[used].astype(np.int32), weights.astype(np.float32))
