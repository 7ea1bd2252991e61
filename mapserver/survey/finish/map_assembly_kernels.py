"""Inner loops of summing up a survey: what repeats itself, and which descriptor stands for a landmark."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching_kernels import hamming
from fleetmap.geometry import Array
from fleetmap.numerics.kernel import inner_kernel, kernel

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Packed = NDArray[np.uint64]


@inner_kernel
def _seen_together(keyframes: NDArray[np.int32], starts: Indices, a: int, b: int) -> bool:
    for n in range(starts[a], starts[a + 1]):
        for m in range(starts[b], starts[b + 1]):
            if keyframes[n] == keyframes[m]:
                return True
    return False


@kernel
def mark_duplicates(
    near: Indices,
    points_map: Array,
    sigmas_m: Array,
    starts: Indices,
    obs_keyframe: NDArray[np.int32],
    descriptors: Packed,
    most_bits: int,
    double: Mask,
) -> None:
    """Sets double (N,) for the less observed landmark of every near pair (P, 2), in their order, that could be one landmark.

    starts (N + 1,) delimits each landmark's obs_keyframe (M,); descriptors (N, 4) of their first observations.
    """
    for n in range(len(near)):
        a, b = near[n, 0], near[n, 1]
        if double[a] or double[b]:
            continue
        squared = 0.0
        for k in range(3):
            squared += (points_map[a, k] - points_map[b, k]) ** 2
        if squared > 9.0 * (sigmas_m[a] * sigmas_m[a] + sigmas_m[b] * sigmas_m[b]):
            continue
        if hamming(descriptors, a, descriptors, b) > most_bits or _seen_together(obs_keyframe, starts, a, b):
            continue
        double[b if starts[a + 1] - starts[a] >= starts[b + 1] - starts[b] else a] = True


@kernel
def mark_redundant(
    order: Indices,
    rows: Indices,
    row_starts: Indices,
    obs_landmark: NDArray[np.int32],
    obs_keyframe: NDArray[np.int32],
    octaves: Indices,
    starts: Indices,
    observers: int,
    share: float,
    gone: Mask,
) -> None:
    """Sets gone (K,) for keyframes, looked at in `order`, of whose observations others repeat a share.

    rows[row_starts[k] : row_starts[k + 1]] are keyframe k's observations that count; starts (N + 1,) delimits each landmark's.
    """
    for k in order:
        count, repeated = row_starts[k + 1] - row_starts[k], 0
        for at in range(row_starts[k], row_starts[k + 1]):
            row = rows[at]
            landmark, seen = obs_landmark[row], -1  # itself does not count
            for n in range(starts[landmark], starts[landmark + 1]):
                if octaves[n] <= octaves[row] + 1 and not gone[obs_keyframe[n]]:
                    seen += 1
            repeated += seen >= observers
        gone[k] = repeated >= share * count


@kernel
def medoids(descriptors: Packed, starts: Indices, chosen: Indices) -> None:
    """Fills chosen (N,) with the row of descriptors (M, 4) nearest to all others of its landmark; ties to the first."""
    for n in range(len(chosen)):
        best = np.int64(-1)
        for i in range(starts[n], starts[n + 1]):
            total = np.int64(0)
            for j in range(starts[n], starts[n + 1]):
                total += hamming(descriptors, i, descriptors, j)
            if best < 0 or total < best:
                best = total
                chosen[n] = i
