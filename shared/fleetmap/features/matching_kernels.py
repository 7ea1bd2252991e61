"""Inner loops of binary descriptor matching. Descriptors are (N, 4) uint64: 256 bits."""

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import inner_kernel, kernel

Packed = NDArray[np.uint64]
Indices = NDArray[np.int64]
Distances = NDArray[np.int32]
FAR = 257  # more than any two descriptors can differ by
_CELL_PX = 24.0
_MOST_CELLS = 512  # per side, however wild the coordinates


def _popcount64(typing_context: Any, value: Any) -> Any:
    """The processor's population count, which numpy code inside numba has no name for."""
    return types.int64(types.uint64), lambda context, builder, signature, arguments: builder.ctpop(arguments[0])


popcount64 = cast(Callable[[np.uint64], int], intrinsic(_popcount64))


@inner_kernel
def hamming(a: Packed, i: int, b: Packed, j: int) -> int:
    """Number of bits in which row i of a and row j of b differ."""
    return (
        popcount64(a[i, 0] ^ b[j, 0])
        + popcount64(a[i, 1] ^ b[j, 1])
        + popcount64(a[i, 2] ^ b[j, 2])
        + popcount64(a[i, 3] ^ b[j, 3])
    )


@kernel
def grid_cells(pixels: Array) -> tuple[Array, Indices, Indices, Indices]:
    """Pixels (N, 2) sorted into square cells; those that are not finite are left out.

    Returns (origin x, origin y, cell size), (columns, rows), starts (cells + 1,) and members (N,) of the cells.
    """
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for n in range(len(pixels)):
        if np.isfinite(pixels[n, 0]) and np.isfinite(pixels[n, 1]):
            low_x, high_x = min(low_x, pixels[n, 0]), max(high_x, pixels[n, 0])
            low_y, high_y = min(low_y, pixels[n, 1]), max(high_y, pixels[n, 1])
    if low_x > high_x:
        return np.array([0.0, 0.0, 1.0]), np.array([0, 0]), np.zeros(1, np.int64), np.zeros(0, np.int64)
    size = max(_CELL_PX, max(high_x - low_x, high_y - low_y) / _MOST_CELLS)
    columns, rows = int((high_x - low_x) / size) + 1, int((high_y - low_y) / size) + 1
    cell = np.full(len(pixels), -1, np.int64)
    starts = np.zeros(columns * rows + 1, np.int64)
    for n in range(len(pixels)):
        if np.isfinite(pixels[n, 0]) and np.isfinite(pixels[n, 1]):
            cell[n] = int((pixels[n, 1] - low_y) / size) * columns + int((pixels[n, 0] - low_x) / size)
            starts[cell[n] + 1] += 1
    starts = np.cumsum(starts)
    members = np.empty(starts[-1], np.int64)
    filled = starts[:-1].copy()
    for n in range(len(pixels)):
        if cell[n] >= 0:
            members[filled[cell[n]]] = n
            filled[cell[n]] += 1
    return np.array([low_x, low_y, size]), np.array([columns, rows]), starts, members


@inner_kernel
def _cell_of(coordinate: float, origin: float, size: float, count: int) -> int:
    return int(min(max(np.floor((coordinate - origin) / size), -1.0), float(count)))


@kernel
def by_projection(
    predicted: Array,
    radius: Array,
    a: Packed,
    octave_range: NDArray[np.int64],
    pixels: Array,
    octaves: NDArray[np.int8],
    b: Packed,
    max_distance: int,
    ratio: float,
) -> tuple[Indices, Distances]:
    """As `matching.match_by_projection`, on packed descriptors."""
    grid, shape, starts, members = grid_cells(pixels)
    columns, rows = shape[0], shape[1]
    index = np.full(len(a), -1, np.int64)
    distances = np.full(len(a), FAR, np.int32)
    owner = np.full(len(b), -1, np.int64)
    competitors = np.full(256, FAR, np.int32)  # per octave: the smallest distance of a feature that was not the best
    touched, untouched = 256, -1
    for i in range(len(a)):
        x, y, reach = predicted[i, 0], predicted[i, 1], radius[i]
        if not (np.isfinite(x) and np.isfinite(y) and reach >= 0.0):
            continue
        first_column = max(_cell_of(x - reach, grid[0], grid[2], columns), 0)
        last_column = min(_cell_of(x + reach, grid[0], grid[2], columns), columns - 1)
        first_row = max(_cell_of(y - reach, grid[1], grid[2], rows), 0)
        last_row = min(_cell_of(y + reach, grid[1], grid[2], rows), rows - 1)
        best, found = FAR, -1
        for k in range(touched, untouched + 1):
            competitors[k] = FAR
        touched, untouched = 256, -1
        for row in range(first_row, last_row + 1):
            for slot in range(starts[row * columns + first_column], starts[row * columns + last_column + 1]):
                j = members[slot]
                octave = int(octaves[j])
                dx, dy = pixels[j, 0] - x, pixels[j, 1] - y
                if dx * dx + dy * dy > reach * reach or octave < octave_range[i, 0] or octave > octave_range[i, 1]:
                    continue
                distance = hamming(a, i, b, j)
                if distance < best or (distance == best and j < found):
                    if found >= 0:
                        before = int(octaves[found]) + 128
                        competitors[before] = min(competitors[before], best)
                        touched, untouched = min(touched, before), max(untouched, before)
                    best, found = distance, j
                else:
                    competitors[octave + 128] = min(competitors[octave + 128], distance)
                    touched, untouched = min(touched, octave + 128), max(untouched, octave + 128)
        if found < 0 or best > max_distance or not best < ratio * competitors[int(octaves[found]) + 128]:
            continue
        holder = owner[found]
        if holder >= 0 and distances[holder] <= best:
            continue
        if holder >= 0:
            index[holder], distances[holder] = -1, FAR
        owner[found], index[i], distances[i] = i, found, best
    return index, distances
