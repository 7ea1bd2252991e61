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


class ChainFactors(NamedTuple):
    """Factors of S without its off-diagonal image blocks.

    sequence (P,): slots, each after its predecessor. link (P,): the edge to the predecessor, -1 for none. inverses (P, D, D) of the
    pivots, couplings (P, D, D) from the predecessor.
    """

    sequence: AnyArray
    link: AnyArray
    inverses: Array
    couplings: Array


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
def multiply(system: SystemArrays, x: Array, out: Array) -> None:
    """out = S x for x (P, D) that is zero where held."""
    blocks, row_ptr, cols, edge_slots, edge_blocks, damp, free = system
    count, size = free.shape
    for p in range(count):
        for a in range(size):
            out[p, a] = damp[p, a] * x[p, a]
    for p in range(count):
        for s in range(row_ptr[p], row_ptr[p + 1]):
            q, block = cols[s], blocks[s]
            for a in range(6):
                total = 0.0
                for b in range(6):
                    total += block[a, b] * x[q, b]
                out[p, a] += total
            if q != p:
                for a in range(6):
                    value = x[p, a]
                    for b in range(6):
                        out[q, b] += block[a, b] * value
    for e in range(len(edge_slots)):
        for side in range(2):
            p = edge_slots[e, side]
            if p < 0:
                continue
            for a in range(size):
                total = 0.0
                for other in range(2):
                    q = edge_slots[e, other]
                    if q >= 0:
                        for b in range(size):
                            total += edge_blocks[e, 15 * side + a, 15 * other + b] * x[q, b]
                out[p, a] += total
    for p in range(count):
        for a in range(size):
            if not free[p, a]:
                out[p, a] = 0.0


@kernel
def factor_chains(system: SystemArrays, factors: ChainFactors) -> None:
    """Factors S without its off-diagonal image blocks: block-diagonal but for the inertial chains.

    Fills inverses and couplings. Positive definite, since the images' block diagonal and the edges each are.
    """
    blocks, row_ptr, _, edge_slots, edge_blocks, damp, free = system
    sequence, link, inverses, couplings = factors
    count, size = free.shape
    for p in range(count):
        inverses[p] = 0.0
        couplings[p] = 0.0
        for a in range(6):
            for b in range(6):
                inverses[p, a, b] = blocks[row_ptr[p + 1] - 1, a, b]
        for a in range(size):
            inverses[p, a, a] += damp[p, a]
    for e in range(len(edge_slots)):
        for side in range(2):
            p = edge_slots[e, side]
            if p >= 0:
                for a in range(size):
                    for b in range(size):
                        inverses[p, a, b] += edge_blocks[e, 15 * side + a, 15 * side + b]
    for n in range(count):
        p = sequence[n]
        for a in range(size):
            for b in range(size):
                if not (free[p, a] and free[p, b]):
                    inverses[p, a, b] = 1.0 if a == b else 0.0
        e = link[p]
        if e >= 0:
            side = 1 if edge_slots[e, 1] == p else 0
            before = edge_slots[e, 1 - side]
            for a in range(size):
                for b in range(size):
                    if free[p, a] and free[before, b]:
                        couplings[p, a, b] = edge_blocks[e, 15 * side + a, 15 * (1 - side) + b]
            inverses[p] -= np.dot(np.dot(couplings[p], inverses[before]), couplings[p].T)
        inverses[p] = np.linalg.inv(inverses[p])


@kernel
def solve_chains(factors: ChainFactors, edge_slots: AnyArray, x: Array, out: Array) -> None:
    """out (P, D) = what `factor_chains` factored, applied inversely to x."""
    sequence, link, inverses, couplings = factors
    count, size = x.shape
    for n in range(count):
        p = sequence[n]
        for a in range(size):
            out[p, a] = x[p, a]
        e = link[p]
        if e >= 0:
            before = edge_slots[e, 0] if edge_slots[e, 1] == p else edge_slots[e, 1]
            for a in range(size):
                for b in range(size):
                    out[p, a] -= couplings[p, a, b] * out[before, b]
        # out now holds inverse pivot times the forward residual, which is all that successors need
        out[p] = np.dot(inverses[p], out[p])
    for n in range(count - 1, -1, -1):
        p = sequence[n]
        e = link[p]
        if e >= 0:
            before = edge_slots[e, 0] if edge_slots[e, 1] == p else edge_slots[e, 1]
            pull = np.dot(couplings[p].T, out[p])
            out[before] -= np.dot(inverses[before], pull)


@kernel
def conjugate_gradients(
    system: SystemArrays, factors: ChainFactors, rhs: Array, limits: tuple[float, int], x: Array
) -> int:
    """Solves S x = rhs from zero; returns the iterations, -1 where the preconditioned residual stays too large.

    Source: Saad, Iterative Methods for Sparse Linear Systems, algorithm 9.1.
    """
    tolerance, max_iterations = limits
    x[:, :] = 0.0
    residual, direction, image, preconditioned = rhs.copy(), np.empty_like(rhs), np.empty_like(rhs), np.empty_like(rhs)
    solve_chains(factors, system.edge_slots, residual, preconditioned)
    direction[:, :] = preconditioned
    size = np.sum(residual * preconditioned)
    enough = tolerance * tolerance * size
    if size == 0.0:
        return 0
    for iteration in range(max_iterations):
        multiply(system, direction, image)
        curvature = np.sum(direction * image)
        if not curvature > 0.0:
            return -1
        x += (size / curvature) * direction
        residual -= (size / curvature) * image
        solve_chains(factors, system.edge_slots, residual, preconditioned)
        smaller = np.sum(residual * preconditioned)
        if smaller <= enough:
            return iteration + 1
        direction *= smaller / size
        direction += preconditioned
        size = smaller
    return -1


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
