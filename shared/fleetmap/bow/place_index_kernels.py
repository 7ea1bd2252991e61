"""Inner loops of the inverted file. A place's score is summed by rising word in both of them."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel

Bounds = NDArray[np.int64]
Ids = NDArray[np.int32]
Weights = NDArray[np.float32]


@kernel
def add_sorted_scores(
    word_ids: Ids, weights: Weights, starts: Bounds, slots: Ids, held: Weights, scores: Array
) -> None:
    """Adds the smaller of both weights for every word that the query shares with a place."""
    for w in range(len(word_ids)):
        weight = weights[w]
        for p in range(starts[word_ids[w]], starts[word_ids[w] + 1]):
            scores[slots[p]] += min(weight, held[p])


@kernel
def add_tail_scores(spread: Weights, bounds: Bounds, word_ids: Ids, weights: Weights, scores: Array) -> None:
    """As `add_sorted_scores` for places stored one after the other; `spread` holds the query's weight of every word."""
    for place in range(len(bounds) - 1):
        total = 0.0
        for p in range(bounds[place], bounds[place + 1]):
            total += min(spread[word_ids[p]], weights[p])
        scores[place] += total


@kernel
def merged_postings(
    starts: Bounds, slots: Ids, held: Weights, first_slot: int, bounds: Bounds, word_ids: Ids, weights: Weights
) -> tuple[Bounds, Ids, Weights]:
    """Postings by word of the old ones and of new places numbered from `first_slot`: a counting sort."""
    words = len(starts) - 1
    new_starts = starts.copy()
    added = np.zeros(words + 1, np.int64)
    for p in range(len(word_ids)):
        added[word_ids[p] + 1] += 1
    new_starts += np.cumsum(added)
    new_slots = np.empty(new_starts[-1], np.int32)
    new_held = np.empty(new_starts[-1], np.float32)
    filled = new_starts[:-1].copy()
    for w in range(words):
        for p in range(starts[w], starts[w + 1]):
            new_slots[filled[w]], new_held[filled[w]] = slots[p], held[p]
            filled[w] += 1
    for place in range(len(bounds) - 1):
        for p in range(bounds[place], bounds[place + 1]):
            w = word_ids[p]
            new_slots[filled[w]], new_held[filled[w]] = first_slot + place, weights[p]
            filled[w] += 1
    return new_starts, new_slots, new_held
