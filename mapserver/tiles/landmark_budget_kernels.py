"""Greedy choice with diminishing returns: the landmark that helps its views most is next; and what repeats in a map."""

from heapq import heapify, heappop, heapreplace

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching_kernels import Packed, hamming
from fleetmap.geometry import Array
from fleetmap.numerics.kernel import inner_kernel, kernel


@kernel
def choose(
    candidates: NDArray[np.int64], starts: NDArray[np.int64], bins: NDArray[np.int64], weights: Array,
    cells: NDArray[np.int64], room: NDArray[np.int64], limit: int, counts: NDArray[np.int64], chosen: NDArray[np.bool_],
    needs: NDArray[np.int64], bins_per_view: int,
) -> int:  # fmt: skip
    """Number of candidates (rows of landmarks) chosen, at most `limit`; marks them in chosen (N,).

    Landmark n is seen in bins[starts[n]:starts[n + 1]]. It is worth weights[n] times the sum over them of 1 / (1 + how many
    were chosen there): the gain of a sum of harmonic numbers, which is submodular, so that a value that was computed earlier
    is an upper bound and only the best one has to be computed again (Minoux 1978). Only views that need more count, and what is
    worth nothing to any of them is not taken. counts (B,) of the bins, room (C,) of cells (N,), how many more fit, and
    needs (V,) of views, so many bins each, are carried on. Equal values: the smaller row first.
    """
    heap = [(-_gain(n, starts, bins, weights, counts, needs, bins_per_view), n) for n in candidates]
    heapify(heap)
    taken = 0
    while len(heap) > 0 and taken < limit:
        _, n = heap[0]
        if room[cells[n]] <= 0:
            heappop(heap)
            continue
        now = (-_gain(n, starts, bins, weights, counts, needs, bins_per_view), n)
        heapreplace(heap, now)
        if heap[0][1] != n:
            continue
        if now[0] >= 0.0:
            break
        heappop(heap)
        chosen[n] = True
        taken += 1
        room[cells[n]] -= 1
        for i in range(starts[n], starts[n + 1]):
            counts[bins[i]] += 1
            needs[bins[i] // bins_per_view] -= 1
    return taken


@kernel
def _gain(
    n: int, starts: NDArray[np.int64], bins: NDArray[np.int64], weights: Array, counts: NDArray[np.int64],
    needs: NDArray[np.int64], bins_per_view: int,
) -> float:  # fmt: skip
    total = 0.0
    for i in range(starts[n], starts[n + 1]):
        if needs[bins[i] // bins_per_view] > 0:
            total += 1.0 / (1.0 + counts[bins[i]])
    return float(weights[n] * total)


@kernel
def mark_repeated_near(
    descriptors: Packed, points_map: Array, order: NDArray[np.int64], reach: int, max_bits: int, height_m: float, own_m: float,
    repeated: NDArray[np.bool_],
) -> None:  # fmt: skip
    """As `mark_repeated`, of those alone that stand at most `reach` from each other in the order (N,): most have a twin there."""
    for a in range(len(order)):
        for b in range(a + 1, min(a + 1 + reach, len(order))):
            i, j = order[a], order[b]
            if not (repeated[i] and repeated[j]) and _looks_alike(
                i, j, descriptors, points_map, max_bits, height_m, own_m
            ):
                repeated[i] = repeated[j] = True


@kernel
def mark_repeated(
    descriptors: Packed,
    points_map: Array,
    most: int,
    max_bits: int,
    height_m: float,
    own_m: float,
    repeated: NDArray[np.bool_],
) -> None:
    """Marks in repeated (N,) what looks like something that stands as high and further off than own_m.

    descriptors (N, 4); points_map (N, 3) by rising z. Each is compared with at most about `most` others.
    """
    count, low, high = len(points_map), 0, 0
    for i in range(count):
        while points_map[low, 2] < points_map[i, 2] - height_m:
            low += 1
        while high < count and points_map[high, 2] <= points_map[i, 2] + height_m:
            high += 1
        step = max(1, (high - low) // most)
        for j in range(low + i % step, high, step):
            if repeated[i]:
                break
            if _looks_alike(i, j, descriptors, points_map, max_bits, height_m, own_m):
                repeated[i] = repeated[j] = True


@inner_kernel
def _looks_alike(
    i: int, j: int, descriptors: Packed, points_map: Array, max_bits: int, height_m: float, own_m: float
) -> bool:
    off_x, off_y = points_map[i, 0] - points_map[j, 0], points_map[i, 1] - points_map[j, 1]
    if off_x * off_x + off_y * off_y <= own_m * own_m or abs(points_map[i, 2] - points_map[j, 2]) > height_m:
        return False
    return hamming(descriptors, i, descriptors, j) <= max_bits
