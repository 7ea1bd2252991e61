"""Comparison of the landmarks of two places: which are one thing, and the log odds of the cells around the others."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching_kernels import Packed, hamming
from fleetmap.geometry import Array
from fleetmap.numerics.kernel import inner_kernel, kernel

Flags = NDArray[np.bool_]


class LandmarkSet(NamedTuple):
    """Landmarks of one place: points_odom (N, 3), packed descriptors, and is_shared (N,)."""

    points_odom: Array
    descriptors: Packed
    is_shared: Flags


class CellModel(NamedTuple):
    """Probabilities of what a cell may hold; see `cell_log_odds`."""

    least: float
    taken_share: float
    different_share: float
    odd_share: float
    threshold: float


class CellTable(NamedTuple):
    """A hash table of S slots. cells (S,), middles (S, 3): the cell of a slot and its middle. sums (S, 2, 3): of each place, the two
    log likelihoods and the number of landmarks."""

    cells: NDArray[np.int64]
    middles: Array
    sums: Array


@inner_kernel
def cell_of(x: float, y: float, z: float, cell_m: float, shift: float) -> int:
    """A number for the cell that holds a point; the lattice is shifted by a share of the cell."""
    column, row, floor = math.floor(x / cell_m + shift), math.floor(y / cell_m + shift), math.floor(z / cell_m + shift)
    return (int(column) * 2097169 + int(row)) * 8209 + int(floor)


@inner_kernel
def slot_of(cell: int, slots: int) -> int:
    """The first slot to probe in a table whose size is a power of two."""
    mixed = np.uint64(cell) * np.uint64(0x9E3779B97F4A7C15)
    return int(mixed >> np.uint64(32)) & (slots - 1)


@kernel
def mark_alike(one: LandmarkSet, other: LandmarkSet, reach_m: float, max_bits: int) -> None:
    """Sets is_shared of landmarks that have one of the other place within reach_m (per axis) that looks the same."""
    points, other_points = one.points_odom, other.points_odom
    slots = 1 << math.ceil(math.log2(2.0 * max(len(other_points), 8)))
    heads, following = np.full(slots, -1, np.int32), np.full(len(other_points), -1, np.int32)
    size_m = 2.0 * reach_m
    for m in range(len(other_points)):
        slot = slot_of(cell_of(other_points[m, 0], other_points[m, 1], other_points[m, 2], size_m, 0.0), slots)
        following[m], heads[slot] = heads[slot], m
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for corner in range(8):  # cells are twice the reach wide, so that the corners of its cube lie in all that count
            ax = x + (reach_m if corner & 1 else -reach_m)
            ay = y + (reach_m if corner & 2 else -reach_m)
            az = z + (reach_m if corner & 4 else -reach_m)
            m = heads[slot_of(cell_of(ax, ay, az, size_m, 0.0), slots)]
            while m >= 0:
                if (
                    abs(other_points[m, 0] - x) <= reach_m
                    and abs(other_points[m, 1] - y) <= reach_m
                    and abs(other_points[m, 2] - z) <= reach_m
                    and hamming(one.descriptors, n, other.descriptors, m) <= max_bits
                ):
                    one.is_shared[n] = other.is_shared[m] = True
                m = following[m]


@kernel
def add_to_cells(
    points: Array, scores: Array, skipped: Flags, side: int, lattice: tuple[float, float], table: CellTable
) -> None:
    """Adds the log likelihoods (N, 2) of one place's landmarks (N, 3) to their cells. lattice: cell size and shift."""
    cell_m, shift = lattice
    cells, middles, sums = table.cells, table.middles, table.sums
    slots = len(cells)
    for n in range(len(points)):
        if skipped[n]:
            continue
        cell = cell_of(points[n, 0], points[n, 1], points[n, 2], cell_m, shift)
        slot = slot_of(cell, slots)
        while sums[slot, 0, 2] + sums[slot, 1, 2] > 0.0 and cells[slot] != cell:
            slot = (slot + 1) & (slots - 1)
        cells[slot] = cell
        for k in range(3):
            middles[slot, k] = (math.floor(points[n, k] / cell_m + shift) + 0.5 - shift) * cell_m
        sums[slot, side, 0] += scores[n, 0]
        sums[slot, side, 1] += scores[n, 1]
        sums[slot, side, 2] += 1.0


@inner_kernel
def log_sum(weight: float, a: float, other_weight: float, b: float) -> float:
    """log(weight exp(a) + other_weight exp(b))."""
    top = max(a, b)
    return top + math.log(weight * math.exp(a - top) + other_weight * math.exp(b - top))


@inner_kernel
def cell_log_odds(sums: Array, model: CellModel) -> float:
    """Log odds of the first place against the second by one cell (2, 3).

    Both places have the same thing there, or it was taken away (taken_share) wherever the robot is; or (different_share) only one
    of them has it, and then it is the right one, but for an odd_share. The absence of fewer than `least` landmarks does not count.
    """
    taken, different, odd = model.taken_share, model.different_share, model.odd_share
    present, other_present = sums[0, 0], sums[1, 0]
    absent = sums[0, 1] if sums[0, 2] >= model.least else min(present, sums[0, 1])
    other_absent = sums[1, 1] if sums[1, 2] >= model.least else min(other_present, sums[1, 1])
    same = log_sum(1.0 - taken, present + other_present, taken, absent + other_absent)
    first, second = present + other_absent, absent + other_present
    for_first = log_sum(1.0 - odd, first, odd, second)
    for_second = log_sum(1.0 - odd, second, odd, first)
    by_first = log_sum(1.0 - different, same, different, for_first)
    return by_first - log_sum(1.0 - different, same, different, for_second)


@kernel
def add_block_log_odds(
    table: CellTable, model: CellModel, block_m: float, blocks: NDArray[np.int64], count: int, totals: Array
) -> int:
    """Adds the log odds of cells to the blocks that hold their middles, of each what is beyond the threshold.

    blocks, totals (room,): the blocks and their sums, `count` of them so far; returns how many there are then.
    """
    sums, middles = table.sums, table.middles
    for slot in range(len(sums)):
        if sums[slot, 0, 2] == 0.0 or sums[slot, 1, 2] == 0.0:
            continue
        found = cell_log_odds(sums[slot], model)
        if abs(found) <= model.threshold:
            continue
        block = cell_of(middles[slot, 0], middles[slot, 1], middles[slot, 2], block_m, 0.0)
        at = 0
        while at < count and blocks[at] != block:
            at += 1
        if at == count:
            if count == len(blocks):
                continue  # as many as ever stand around a robot; what is left out makes it no surer
            blocks[at], count = block, count + 1
        totals[at] += found - model.threshold if found > 0.0 else found + model.threshold
    return count
