"""Matching of binary descriptors: exhaustive, mutual, or near a predicted pixel."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.orb import Features
from fleetmap.geometry import Array, Indices

Descriptors = NDArray[np.uint8]
Packed = NDArray[np.uint64]
Distances = NDArray[np.int32]
FAR = 257  # more than any two descriptors can differ by


def packed(descriptors: Descriptors) -> Packed:
    """(N, 4) uint64 of descriptors (N, 32) uint8: the same bits as machine words, copied only if the core needs it."""
    assert descriptors.ndim == 2
    assert descriptors.shape[1] == 32
    assert descriptors.dtype == np.uint8
    # Bytes of a tile may be unaligned; words must not be.
    return np.require(np.ascontiguousarray(descriptors).view(np.uint64), requirements=["C", "A"])


def match_mutual(
    descriptors_a: Descriptors,
    descriptors_b: Descriptors,
    max_distance: int,
    ratio: float,
    nodes: tuple[NDArray[np.int32], NDArray[np.int32]] | None = None,
) -> Indices:
    """(P, 2) index pairs that are each other's nearest, by rising index in a.

    The distance is at most `max_distance` and below `ratio` times that of a's second nearest in b. Source: Lowe 2004.
    nodes: nearest two vocabulary nodes of each of a (A, 2) and nearest one of each of b (B,); only pairs with a common one are compared,
    which misses few matches. Source: direct index, Galvez-Lopez and Tardos 2012, section III-B.
    """
    if nodes is not None:
        ours, theirs = (np.ascontiguousarray(each, np.int32) for each in nodes)
        return core.mutual_within(packed(descriptors_a), ours, packed(descriptors_b), theirs, max_distance, ratio)
    return core.mutual(packed(descriptors_a), packed(descriptors_b), max_distance, ratio)


class Projected(NamedTuple):
    """Predicted pixels and appearance of A landmarks or features in an image.

    pixels (A, 2), NaN to exclude one from matching; radius_px (A,); descriptors (A, 32); octave_range (A, 2) lowest and
    highest octave, both included.
    """

    pixels: Array
    radius_px: Array
    descriptors: Descriptors
    octave_range: NDArray[np.integer]


def match_by_projection(
    projected: Projected, features: Features, max_distance: int, ratio: float
) -> tuple[Indices, Distances]:
    """(A,) index of the matching feature of each, -1 for none, and (A,) its distance, FAR for none.

    The distance is at most `max_distance` and below `ratio` times that of its nearest rival of the same octave: a corner
    found again on the next octave is no rival. Each feature goes to the nearest candidate that chose it, the others stay unmatched; ties
    to the lower index.
    """
    assert len(projected.pixels) == len(projected.radius_px) == len(projected.octave_range)
    wanted = np.ascontiguousarray(projected.pixels, np.float64), np.ascontiguousarray(projected.radius_px, np.float64)
    octave_range = np.ascontiguousarray(projected.octave_range, np.int64)
    pixels, octaves = np.ascontiguousarray(features.pixels, np.float64), np.ascontiguousarray(features.octaves, np.int8)
    ours, theirs = packed(projected.descriptors), packed(features.descriptors)
    return core.match_projected(*wanted, ours, octave_range, pixels, octaves, theirs, max_distance, ratio)
