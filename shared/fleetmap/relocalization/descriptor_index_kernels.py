"""Inner loops of the descriptor index."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching_kernels import Indices, Packed, hamming
from fleetmap.numerics.kernel import kernel


@kernel
def nearest_cells(packed: Packed, centres: Packed, count: int) -> NDArray[np.int32]:
    """(N, count) numbers of the centres nearest to each descriptor, the nearest first; -1 where there are fewer. Ties: lower number."""
    found = np.full((len(packed), count), -1, np.int32)
    distances = np.empty(count, np.int64)
    for i in range(len(packed)):
        held = 0
        for c in range(len(centres)):
            distance = hamming(packed, i, centres, c)
            if held == count and distance >= distances[held - 1]:
                continue
            at = held if held < count else count - 1
            while at > 0 and distances[at - 1] > distance:
                distances[at], found[i, at] = distances[at - 1], found[i, at - 1]
                at -= 1
            distances[at], found[i, at] = distance, c
            held = min(held + 1, count)
    return found


@kernel
def mark_near(
    packed: Packed, cells: NDArray[np.int32], held: Packed, starts: Indices, max_bits: int, is_near: NDArray[np.bool_]
) -> None:
    """Marks what is held within max_bits of any of the descriptors, as far as it lies in the cells (N, P) that are asked for each.

    held (M, 4): by cell, those of cell c from starts[c] to starts[c + 1].
    """
    for i in range(len(packed)):
        for p in range(cells.shape[1]):
            cell = cells[i, p]
            if cell < 0:
                break
            for j in range(starts[cell], starts[cell + 1]):
                if not is_near[j] and hamming(packed, i, held, j) <= max_bits:
                    is_near[j] = True
