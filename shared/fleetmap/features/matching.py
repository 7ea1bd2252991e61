"""Which binary descriptors belong together: exhaustive, mutual, or near a predicted pixel."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.features import matching_kernels
from fleetmap.features.matching_kernels import FAR, Distances, Indices, Packed
from fleetmap.geometry import Array

Descriptors = NDArray[np.uint8]

__all__ = ["FAR", "hamming_knn2", "match_by_projection", "match_mutual", "packed"]


def packed(descriptors: Descriptors) -> Packed:
    """(N, 4) uint64 of descriptors (N, 32) uint8: the same bits as machine words, copied only where kernels need it."""
    assert descriptors.ndim == 2
    assert descriptors.shape[1] == 32
    assert descriptors.dtype == np.uint8
    # Read-only or unaligned input (bytes of a tile) would make numba compile a second version of every kernel.
    return np.require(np.ascontiguousarray(descriptors).view(np.uint64), requirements=["C", "A", "W"])


def hamming_knn2(descriptors_a: Descriptors, descriptors_b: Descriptors) -> tuple[Indices, Distances, Distances]:
    """For every descriptor of a (A, 32): index of the nearest of b (B, 32), its distance, the second smallest distance.

    Index -1 and distance FAR where b holds too few. Ties go to the lower index.
    """
    count = len(descriptors_a)
    index, first, second = np.empty(count, np.int64), np.empty(count, np.int32), np.empty(count, np.int32)
    matching_kernels.knn2(packed(descriptors_a), packed(descriptors_b), index, first, second)
    return index, first, second


def match_mutual(descriptors_a: Descriptors, descriptors_b: Descriptors, max_distance: int, ratio: float) -> Indices:
    """(P, 2) index pairs that are each other's nearest, by rising index in a.

    The distance is at most `max_distance` and below `ratio` times that of a's second nearest in b. Source: Lowe 2004.
    """
    return matching_kernels.mutual(packed(descriptors_a), packed(descriptors_b), max_distance, float(ratio))


def match_by_projection(
    pixels_predicted: Array, radius_px: Array, descriptors_a: Descriptors, octave_range_a: NDArray[np.integer],
    pixels_b: Array, octaves_b: NDArray[np.integer], descriptors_b: Descriptors, max_distance: int, ratio: float,
) -> tuple[Indices, Distances]:  # fmt: skip
    """For every a its feature of b (index, -1 none) and their distance (FAR none), looked for around a predicted pixel.

    pixels_predicted (A, 2), NaN where a is not to be matched; radius_px (A,); octave_range_a (A, 2) lowest and highest
    octave, both included; pixels_b (B, 2); octaves_b (B,) within int8. The distance is at most `max_distance` and below
    `ratio` times that of its nearest rival of the same octave: a corner found again on the next octave is no rival.
    Each feature of b goes to the nearest a that chose it, the others go without; ties to the lower index.
    """
    assert len(pixels_predicted) == len(radius_px) == len(descriptors_a) == len(octave_range_a)
    assert len(pixels_b) == len(octaves_b) == len(descriptors_b)
    return matching_kernels.by_projection(
        np.ascontiguousarray(pixels_predicted, np.float64), np.ascontiguousarray(radius_px, np.float64),
        packed(descriptors_a), np.ascontiguousarray(octave_range_a, np.int64),
        np.ascontiguousarray(pixels_b, np.float64), np.ascontiguousarray(octaves_b, np.int8),
        packed(descriptors_b), max_distance, float(ratio),
    )  # fmt: skip
