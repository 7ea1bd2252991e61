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
def knn2(a: Packed, b: Packed, index: Indices, first: Distances, second: Distances) -> None:
    """Fills (A,) the nearest b (-1 none), its distance and the second smallest one (FAR none). Ties: lower index."""
    for i in range(len(a)):
        best, runner_up, found = FAR, FAR, -1
        for j in range(len(b)):
            distance = hamming(a, i, b, j)
            if distance < best:
                runner_up = best
                best, found = distance, j
            elif distance < runner_up:
                runner_up = distance
        index[i], first[i], second[i] = found, best, runner_up


@kernel
def mutual(a: Packed, b: Packed, max_distance: int, ratio: float) -> Indices:
    """(P, 2) pairs that are each other's nearest and pass both thresholds, by index in a. Ties: lower index."""
    column_best = np.full(len(b), np.int64(FAR) << 32)  # distance, then the row: ties go to the lower one
    index = np.full(len(a), -1, np.int64)
    words = b.T.copy()  # and distances of one row first, without a branch: both let the compiler use wide registers
    distances = np.empty(len(b), np.int64)
    for i in range(len(a)):
        a0, a1, a2, a3 = a[i, 0], a[i, 1], a[i, 2], a[i, 3]
        for j in range(len(b)):
            distances[j] = (
                popcount64(a0 ^ words[0, j])
                + popcount64(a1 ^ words[1, j])
                + popcount64(a2 ^ words[2, j])
                + popcount64(a3 ^ words[3, j])
            )
        for j in range(len(b)):
            column_best[j] = min(column_best[j], (distances[j] << 32) + i)
        best, runner_up, found = FAR, FAR, -1
        for j in range(len(b)):
            distance = distances[j]
            if distance < runner_up:
                if distance < best:
                    runner_up = best
                    best, found = distance, j
                else:
                    runner_up = distance
        if best <= max_distance and best < ratio * runner_up:
            index[i] = found
    pairs = np.empty((len(a), 2), np.int64)
    count = 0
    for i in range(len(a)):
        if index[i] >= 0 and column_best[index[i]] & 0xFFFFFFFF == i:
            pairs[count, 0], pairs[count, 1] = i, index[i]
            count += 1
    return pairs[:count].copy()


@kernel
def mutual_within(
    a: Packed, nodes_a: NDArray[np.int32], b: Packed, nodes_b: NDArray[np.int32], max_distance: int, ratio: float
) -> Indices:
    """As `mutual`, of rows of a with those of b whose node (B,) is one of their two (A, 2): of others it knows nothing."""
    if len(a) == 0 or len(b) == 0:
        return np.empty((0, 2), np.int64)
    order = np.argsort(nodes_b, kind="mergesort")
    starts = np.searchsorted(nodes_b[order], np.arange(max(nodes_a.max(), nodes_b.max()) + 2))
    all_words, all_column_best = b[order].T.copy(), np.full(len(b), np.int64(FAR) << 32)
    index, all_distances = np.full(len(a), -1, np.int64), np.empty(len(b), np.int64)
    for i in range(len(a)):
        a0, a1, a2, a3 = a[i, 0], a[i, 1], a[i, 2], a[i, 3]
        best, runner_up, found = FAR, FAR, -1
        for side in range(2 if nodes_a[i, 1] != nodes_a[i, 0] else 1):
            first, last = starts[nodes_a[i, side]], starts[nodes_a[i, side] + 1]
            words, distances = all_words[:, first:last], all_distances[first:last]
            column_best = all_column_best[first:last]
            for j in range(len(distances)):
                distances[j] = (
                    popcount64(a0 ^ words[0, j])
                    + popcount64(a1 ^ words[1, j])
                    + popcount64(a2 ^ words[2, j])
                    + popcount64(a3 ^ words[3, j])
                )
            for j in range(len(distances)):
                column_best[j] = min(column_best[j], (distances[j] << 32) + i)
            for j in range(len(distances)):
                distance = distances[j]
                if distance < runner_up:
                    if distance < best:
                        runner_up = best
                        best, found = distance, first + j
                    else:
                        runner_up = distance
        if best <= max_distance and best < ratio * runner_up:
            index[i] = found
    pairs, count = np.empty((len(a), 2), np.int64), 0
    for i in range(len(a)):
        if index[i] >= 0 and all_column_best[index[i]] & 0xFFFFFFFF == i:
            pairs[count, 0], pairs[count, 1] = i, order[index[i]]
            count += 1
    return pairs[:count].copy()


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
