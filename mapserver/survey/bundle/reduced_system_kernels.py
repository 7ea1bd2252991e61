"""Inner loops of the reduced system S: blocks (B, 6, 6) of poses by row, inertial edges (E, 30, 30) and a diagonal.

P slots of D = 6 or 15 unknowns. `free` (P, D) tells which move; held ones keep a unit diagonal and a zero step.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import AnyArray, Array
from fleetmap.numerics.kernel import inner_kernel, kernel

Mask = NDArray[np.bool_]
Indices = NDArray[np.int32]


class SystemArrays(NamedTuple):
    """S: row p's blocks are row_ptr[p]:row_ptr[p + 1] with columns cols; edge_slots (E, 2); diagonal damp and mask free (P, D)."""

    blocks: Array
    row_ptr: AnyArray
    cols: AnyArray
    edge_slots: AnyArray
    edge_blocks: Array
    damp: Array
    free: Mask


class BlockPlaces(NamedTuple):
    """Where the blocks of S belong among the values of its sparse factor, as in BlockCholesky.places; -1 first for those of held keyframes.

    images (B, 3); edges (E, 10, 3) of pairs of pose i, motion i, pose j and motion j, row by row of a lower triangle; diagonal (P, parts,
    3) of poses, and of motions where there are any.
    """

    images: AnyArray
    edges: AnyArray
    diagonal: AnyArray


@kernel
def fill_lower(system: SystemArrays, lower: Array) -> None:
    """Adds S to the zeroed dense `lower` (PD, PD); only its lower triangle is complete."""
    blocks, row_ptr, cols, edge_slots, edge_blocks, damp, free = system
    count, size = free.shape
    width = blocks.shape[1]
    for p in range(count):
        for s in range(row_ptr[p], row_ptr[p + 1]):
            q = cols[s]
            for a in range(width):
                for b in range(width):
                    if free[p, a] and free[q, b]:
                        lower[p * size + a, q * size + b] += blocks[s, a, b]
        for a in range(size):
            lower[p * size + a, p * size + a] += damp[p, a] if free[p, a] else 1.0
    for e in range(len(edge_slots)):
        for x in range(2):
            for y in range(2):
                p, q = edge_slots[e, x], edge_slots[e, y]
                if p < 0 or q < 0 or q > p:
                    continue
                for a in range(size):
                    for b in range(size):
                        if free[p, a] and free[q, b]:
                            lower[p * size + a, q * size + b] += edge_blocks[e, 15 * x + a, 15 * y + b]


@kernel
def fill_blocks(system: SystemArrays, places: BlockPlaces, values: Array) -> None:
    """Adds S to the zeroed values of its sparse factor; unknowns that are held have a one on the diagonal."""
    blocks, row_ptr, cols, edge_slots, edge_blocks, damp, free = system
    images, edges, diagonal = places
    (count, size), width = free.shape, blocks.shape[1]
    for p in range(count):
        for s in range(row_ptr[p], row_ptr[p + 1]):
            first, down, right = images[s]
            for a in range(width):
                for b in range(width):
                    if free[p, a] and free[cols[s], b]:
                        values[first + a * down + b * right] += blocks[s, a, b]
        for a in range(size):
            part = 0 if a < width else 1
            first, down, right = diagonal[p, part]
            values[first + (a - part * width) * (down + right)] += damp[p, a] if free[p, a] else 1.0
    for e in range(len(edge_slots)):
        pair = 0
        for x in range(4):
            for y in range(x + 1):
                first, down, right = edges[e, pair]
                pair += 1
                if first >= 0:
                    _add_part(edge_blocks[e], free, edge_slots[e], (x, y), (first, down, right), values)


@inner_kernel
def _add_part(
    block: Array, free: Mask, slots: AnyArray, part: tuple[int, int], place: tuple[int, int, int], values: Array
) -> None:
    """Adds what a (30, 30) block says of two of its four parts, the pose and the motion of either end."""
    (x, y), (first, down, right) = part, place
    above, left = 6 * (x % 2), 6 * (y % 2)
    for a in range(above, 15 if x % 2 else 6):
        for b in range(left, 15 if y % 2 else 6):
            if free[slots[x // 2], a] and free[slots[y // 2], b]:
                to = first + (a - above) * down + (b - left) * right
                values[to] += block[15 * (x // 2) + a, 15 * (y // 2) + b]
