"""Two places laid over each other: which landmarks are one thing, and what the cells around the others say."""

import math

import numpy as np
from numpy.typing import NDArray

from fleetmap.features.matching_kernels import Packed, hamming
from fleetmap.geometry import Array
from fleetmap.numerics.kernel import inner_kernel, kernel

Flags = NDArray[np.bool_]


@inner_kernel
def cell_of(x: float, y: float, z: float, cell_m: float, shift: float) -> int:
    """A number for the cell that holds a point; the lattice is moved by a share of the cell."""
    column, row, floor = math.floor(x / cell_m + shift), math.floor(y / cell_m + shift), math.floor(z / cell_m + shift)
    return (int(column) * 2097169 + int(row)) * 8209 + int(floor)


@inner_kernel
def slot_of(cell: int, slots: int) -> int:
    """Where in a table of a power of two cells are looked for first."""
    mixed = np.uint64(cell) * np.uint64(0x9E3779B97F4A7C15)
    return int(mixed >> np.uint64(32)) & (slots - 1)


@kernel
def mark_alike(
    points: Array, looks: Packed, other_points: Array, other_looks: Packed, reach_m: float, max_bits: int, alike: Flags,
    other_alike: Flags,
) -> None:  # fmt: skip
    """Sets the flags of landmarks (N), (M) that have one of the other place within reach_m (per axis) that looks the same."""
    slots = 1 << math.ceil(math.log2(2.0 * max(len(other_points), 8)))
    heads, following = np.full(slots, -1, np.int32), np.full(len(other_points), -1, np.int32)
    size_m = 2.0 * reach_m
    for m in range(len(other_points)):
        slot = slot_of(cell_of(other_points[m, 0], other_points[m, 1], other_points[m, 2], size_m, 0.0), slots)
        following[m], heads[slot] = heads[slot], m
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        for corner in range(8):  # cells are twice the reach wide, so that the corners of its cube lie in all that count
            ax, ay, az = (
                x + (reach_m if corner & 1 else -reach_m),
                y + (reach_m if corner & 2 else -reach_m),
                z + (reach_m if corner & 4 else -reach_m),
            )
            m = heads[slot_of(cell_of(ax, ay, az, size_m, 0.0), slots)]
            while m >= 0:
                if (
                    abs(other_points[m, 0] - x) <= reach_m
                    and abs(other_points[m, 1] - y) <= reach_m
                    and abs(other_points[m, 2] - z) <= reach_m
                    and hamming(looks, n, other_looks, m) <= max_bits
                ):
                    alike[n] = other_alike[m] = True
                m = following[m]


@kernel
def add_to_cells(
    points: Array, scores: Array, alike: Flags, side: int, cell_m: float, shift: float, cells: NDArray[np.int64],
    middles: Array, sums: Array,
) -> None:  # fmt: skip
    """Adds one place's landmarks that are not alike to the table: (slots, 2, 3) sums of the scores (N, 2), and how many there are.

    cells (slots,), middles (slots, 3): which cell a slot stands for, and that cell's middle.
    """
    slots = len(cells)
    for n in range(len(points)):
        if alike[n]:
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
def cell_evidence(sums: Array, least: float, taken_share: float, different_share: float, odd_share: float) -> float:
    """What one cell (2, 3) says for the first place against the second, a logarithm.

    There stands the same in both, or was taken away (taken_share) wherever the robot is; or (different_share) only one
    of them has it, and then it is the right one, but for an odd_share. Fewer than `least` landmarks are not missed.
    """
    there, other_there = sums[0, 0], sums[1, 0]
    gone = sums[0, 1] if sums[0, 2] >= least else min(there, sums[0, 1])
    other_gone = sums[1, 1] if sums[1, 2] >= least else min(other_there, sums[1, 1])
    same = log_sum(1.0 - taken_share, there + other_there, taken_share, gone + other_gone)
    first, second = there + other_gone, gone + other_there
    for_first = log_sum(1.0 - odd_share, first, odd_share, second)
    for_second = log_sum(1.0 - odd_share, second, odd_share, first)
    return log_sum(1.0 - different_share, same, different_share, for_first) - log_sum(
        1.0 - different_share, same, different_share, for_second
    )


@kernel
def speak(
    sums: Array, middles: Array, lattice: int, block_m: float, least: float, taken_share: float, different_share: float,
    odd_share: float, quiet: float, blocks: NDArray[np.int64], count: int, said: Array,
) -> int:  # fmt: skip
    """Adds what the cells (slots, 2, 3) of one lattice say to the blocks in which their middles lie.

    Of each cell only what is beyond `quiet`: hundreds that say next to nothing must not add up. blocks (room,) and said (room, lattices):
    those held so far, `count` of them; returns how many are then.
    """
    for slot in range(len(sums)):
        if sums[slot, 0, 2] == 0.0 or sums[slot, 1, 2] == 0.0:
            continue
        found = cell_evidence(sums[slot], least, taken_share, different_share, odd_share)
        if abs(found) <= quiet:
            continue
        block = cell_of(middles[slot, 0], middles[slot, 1], middles[slot, 2], block_m, 0.0)
        at = 0
        while at < count and blocks[at] != block:
            at += 1
        if at == count:
            if count == len(blocks):
                continue  # as many as ever stand around a robot; what is left out makes it no surer
            blocks[at], count = block, count + 1
        said[at, lattice] += found - quiet if found > 0.0 else found + quiet
    return count
