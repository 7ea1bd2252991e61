"""Inner loops of the alias search: pairs that look alike anywhere in the map, and the votes that they give to places."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching_kernels import Packed, hamming
from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel

_MAX_BITS, _HEIGHT_M = 50, 0.3
Pairs = NDArray[np.int32]


@kernel
def alike(
    features: Packed, heights_m: Array, landmarks: Packed, points_map: Array, first: int, last: int, pairs: Pairs
) -> int:
    """Writes to pairs (C, 2) the features (F) and those of the landmarks [first, last) that look the same at the same height.

    Returns how many; what has no room is left out.
    """
    count = 0
    for j in range(first, last):
        for i in range(len(features)):
            if abs(points_map[j, 2] - heights_m[i]) > _HEIGHT_M or hamming(features, i, landmarks, j) > _MAX_BITS:
                continue
            if count == len(pairs):
                return count
            pairs[count, 0], pairs[count, 1] = i, j
            count += 1
    return count


@kernel
def vote(
    pairs: Pairs, offsets_m: Array, points_map: Array, low_m: Array, cell_m: float, last: Pairs, counts: Pairs
) -> None:
    """Fills counts (X, Y): the features that vote for a camera in a square of two cells' side that begins at the cell's corner.

    offsets_m (F, 2): from the camera to what each feature shows, turned as the camera would be. last (X, Y): of -1. Pairs must
    come with all those of one feature together.
    """
    columns, rows = counts.shape
    for k in range(len(pairs)):
        feature = pairs[k, 0]
        x = (points_map[pairs[k, 1], 0] - offsets_m[feature, 0] - low_m[0]) / cell_m
        y = (points_map[pairs[k, 1], 1] - offsets_m[feature, 1] - low_m[1]) / cell_m
        if not (1.0 <= x < columns and 1.0 <= y < rows):
            continue
        for column in (int(x) - 1, int(x)):
            for row in (int(y) - 1, int(y)):
                if last[column, row] != feature:
                    last[column, row] = feature
                    counts[column, row] += 1
