"""Ranking of places by appearance: an inverted file over bag-of-words vectors."""

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.bow.vocabulary import BowVector

_FIRST_CAPACITY = 64


class PlaceIndex:
    """Growing index of places and their bag-of-words vectors."""

    def __init__(self, word_count: int) -> None:
        """Create an empty index for the words of one vocabulary."""
        self._place_ids, self._count = np.zeros(_FIRST_CAPACITY, np.int64), 0
        self._known: set[int] = set()
        self._file = core.InvertedFile(word_count)

    def __len__(self) -> int:
        return self._count

    @property
    def place_ids(self) -> NDArray[np.int64]:
        """(P,) ids in the order of insertion, which is the order of a candidates mask."""
        return self._place_ids[: self._count]

    def add(self, place_id: int, vector: BowVector) -> None:
        """Add a place; its id must be new."""
        assert place_id not in self._known, place_id
        self._known.add(place_id)
        if self._count == len(self._place_ids):
            self._place_ids = np.concatenate([self._place_ids, np.zeros_like(self._place_ids)])
        self._place_ids[self._count] = place_id
        self._count += 1
        self._file.add(vector.word_ids, vector.weights)

    def query(
        self, vector: BowVector, candidates_mask: NDArray[np.bool_] | None = None, top_k: int = 10
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return ids and scores of the up to `top_k` most similar places, best first; places without a common word are left out.

        candidates_mask (P,), in the order of `place_ids`, marks the places that may be returned. The score is 1 - |a - b|_1 / 2, in
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
        return self._file.scores(vector.word_ids, vector.weights)
