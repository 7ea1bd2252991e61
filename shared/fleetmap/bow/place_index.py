"""Ranking of places by appearance: an inverted file over bag-of-words vectors."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import place_index_kernels
from fleetmap.bow.vocabulary import BowVector

_FIRST_CAPACITY = 64
_SMALLEST_TAIL = 64
_TAIL_SHARE = 8  # the tail is sorted in when it holds more than an eighth of the places


class PlaceIndex:
    """Places and their vectors, growing.

    Postings are sorted by word; the newest places wait unsorted in a tail that is compared one by one and sorted in
    when it has grown, so that adding stays cheap. What a query returns does not depend on when that happened.
    """

    def __init__(self, word_count: int) -> None:
        """An empty index for the words of one vocabulary."""
        self._word_count = word_count
        self._place_ids, self._count = np.zeros(_FIRST_CAPACITY, np.int64), 0
        self._known: set[int] = set()
        self._starts = np.zeros(word_count + 1, np.int64)
        self._slots = np.zeros(0, np.int32)
        self._weights = np.zeros(0, np.float32)
        self._sorted_places = 0
        self._tail = _Tail()

    def __len__(self) -> int:
        return self._count

    @property
    def place_ids(self) -> NDArray[np.int64]:
        """(P,) ids in the order in which they were added: what a candidates mask goes along."""
        return self._place_ids[: self._count]

    def add(self, place_id: int, vector: BowVector) -> None:
        """Adds a place; its id must be new."""
        assert place_id not in self._known, place_id
        assert len(vector) == 0 or vector.word_ids[-1] < self._word_count
        self._known.add(place_id)
        if self._count == len(self._place_ids):
            self._place_ids = np.concatenate([self._place_ids, np.zeros_like(self._place_ids)])
        self._place_ids[self._count] = place_id
        self._count += 1
        self._tail.append(vector)
        if len(self._tail) > max(_SMALLEST_TAIL, self._sorted_places // _TAIL_SHARE):
            self._sort_tail_in()

    def query(
        self, vector: BowVector, candidates_mask: NDArray[np.bool_] | None = None, top_k: int = 10
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Ids and scores of the up to `top_k` most similar places, best first; those that share no word are left out.

        candidates_mask (P,) in the order of `place_ids` says which may be returned. The score is 1 - |a - b|_1 / 2, in
        0..1, 1 for equal vectors (DBoW2's L1 score). Ties go to the lower id.
        """
        scores = self.scores(vector)
        if candidates_mask is not None:
            assert candidates_mask.shape == scores.shape
            scores = np.where(candidates_mask, scores, 0.0)
        found = np.flatnonzero(scores > 0.0)
        if len(found) > top_k:
            least = np.partition(scores[found], len(found) - top_k)[len(found) - top_k]
            found = found[scores[found] >= least]
        ids = self.place_ids[found]
        order = np.lexsort((ids, -scores[found]))[:top_k]
        return ids[order], scores[found][order]

    def scores(self, vector: BowVector) -> NDArray[np.float64]:
        """(P,) score of every place, in the order of `place_ids`."""
        scores = np.zeros(len(self), np.float64)
        place_index_kernels.add_sorted_scores(
            vector.word_ids, vector.weights, self._starts, self._slots, self._weights, scores
        )
        if len(self._tail):
            spread = np.zeros(self._word_count, np.float32)
            spread[vector.word_ids] = vector.weights
            place_index_kernels.add_tail_scores(spread, *self._tail.flat, scores[self._sorted_places :])
        return scores

    def _sort_tail_in(self) -> None:
        self._starts, self._slots, self._weights = place_index_kernels.merged_postings(
            self._starts, self._slots, self._weights, self._sorted_places, *self._tail.flat
        )
        self._sorted_places = len(self)
        self._tail.clear()


class _Tail:
    """Vectors one after the other, in arrays with room for more: a new one copies none of those before."""

    def __init__(self) -> None:
        self._count = 0
        self._bounds = np.zeros(_FIRST_CAPACITY, np.int64)
        self._word_ids, self._weights = np.zeros(0, np.int32), np.zeros(0, np.float32)

    def __len__(self) -> int:
        return self._count

    @property
    def flat(self) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
        """Bounds (len + 1,), word ids and weights of the vectors."""
        end = self._bounds[self._count]
        return self._bounds[: self._count + 1], self._word_ids[:end], self._weights[:end]

    def append(self, vector: BowVector) -> None:
        """Takes one more."""
        first = int(self._bounds[self._count])
        end = first + len(vector)
        if end > len(self._word_ids):
            more = end + len(self._word_ids)
            self._word_ids, self._weights = np.resize(self._word_ids, more), np.resize(self._weights, more)
        if self._count + 1 == len(self._bounds):
            self._bounds = np.resize(self._bounds, 2 * len(self._bounds))
        self._word_ids[first:end], self._weights[first:end] = vector.word_ids, vector.weights
        self._count += 1
        self._bounds[self._count] = end

    def clear(self) -> None:
        """Forgets all of them, and keeps the room."""
        self._count = 0
