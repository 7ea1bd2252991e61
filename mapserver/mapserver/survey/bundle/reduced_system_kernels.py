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


class Numbers(NamedTuple):
    """Where the numbers of a system come from, one after the other: image blocks, those `below` the diagonal mirrored, edges, diagonal.

    block_rows, cols (B,) of the blocks; below (b,) which lie beside the diagonal; edge_slots (E, 2), -1 for held keyframes; free (U,);
    place (U,) of each unknown in the matrix; size: unknowns of a slot.
    """

    block_rows: Indices
    cols: Indices
    below: AnyArray
    edge_slots: AnyArray
    free: Mask
    place: Indices
    size: int


@inner_kernel
def _row_and_column(numbers: Numbers, n: int) -> tuple[int, int]:
    """Where number n stands in the matrix, (-1, -1) for one of held unknowns; their diagonal stands."""
    block_rows, cols, below, edge_slots, free, place, size = numbers
    images, mirrored, along = 36 * len(block_rows), 36 * len(below), 900 * len(edge_slots)
    if n < images:
        s, entry = n // 36, n % 36
        row, col = size * block_rows[s] + entry // 6, size * cols[s] + entry % 6
    elif n < images + mirrored:
        s, entry = below[(n - images) // 36], (n - images) % 36
        row, col = size * cols[s] + entry % 6, size * block_rows[s] + entry // 6
    elif n < images + mirrored + along:
        e, entry = (n - images - mirrored) // 900, (n - images - mirrored) % 900
        p, q = edge_slots[e, entry // 450], edge_slots[e, entry % 30 // 15]
        if p < 0 or q < 0:
            return -1, -1
        row, col = size * p + entry // 30 % 15, size * q + entry % 15
    else:
        unknown = n - images - mirrored - along
        return place[unknown], place[unknown]
    if not (free[row] and free[col]):
        return -1, -1
    return place[row], place[col]


@kernel
def lay_out(numbers: Numbers) -> tuple[Indices, Indices, Indices]:
    """indptr (U + 1,) and indices of the CSC matrix, and to which of its values each number is added, -1 for none.

    The first number of each value has -2 less that place: it is added last, to what the others sum up to.
    """
    count = len(numbers.place)
    total = 36 * (len(numbers.block_rows) + len(numbers.below)) + 900 * len(numbers.edge_slots) + count
    starts = np.zeros(count + 1, np.int64)
    for n in range(total):
        _, col = _row_and_column(numbers, n)
        if col >= 0:
            starts[col + 1] += 1
    starts = np.cumsum(starts)
    by_column, filled = np.empty(starts[count], np.int32), starts[:count].copy()
    for n in range(total):
        _, col = _row_and_column(numbers, n)
        if col >= 0:
            by_column[filled[col]] = n
            filled[col] += 1
    indptr, indices = np.zeros(count + 1, np.int32), np.empty(len(by_column), np.int32)
    target, marked = np.full(total, -1, np.int32), np.full(count, -1, np.int32)
    at, found = np.empty(count, np.int32), np.empty(count, np.int32)
    for col in range(count):
        size = 0
        for number in by_column[starts[col] : starts[col + 1]]:
            row, _ = _row_and_column(numbers, number)
            if marked[row] != col:
                marked[row] = col
                found[size] = row
                size += 1
        first = indptr[col]
        indptr[col + 1] = first + size
        indices[first : first + size] = np.sort(found[:size])
        for k in range(first, first + size):
            at[indices[k]] = -2 - k
        for number in by_column[starts[col] : starts[col + 1]]:
            row, _ = _row_and_column(numbers, number)
            target[number] = at[row]
            if at[row] < 0:
                at[row] = -2 - at[row]
    return indptr, indices[: indptr[count]].copy(), target


@inner_kernel
def _add(number: float, target: int, is_first: bool, values: Array) -> None:
    place = -2 - target if is_first else target
    if place >= 0:
        values[place] += number


@kernel
def add_numbers(
    blocks: Array, below: AnyArray, edge_blocks: Array, damp: Array, target: Indices, values: Array
) -> None:
    """Adds the numbers of a system, in the order of `Numbers`, to the matrix's zeroed values."""
    for is_first in (False, True):
        n = 0
        for s in range(len(blocks)):
            for entry in range(36):
                _add(blocks[s, entry // 6, entry % 6], target[n + entry], is_first, values)
            n += 36
        for s in below:
            for entry in range(36):
                _add(blocks[s, entry // 6, entry % 6], target[n + entry], is_first, values)
            n += 36
        for e in range(len(edge_blocks)):
            for entry in range(900):
                _add(edge_blocks[e, entry // 30, entry % 30], target[n + entry], is_first, values)
            n += 900
        for p in range(len(damp)):
            for a in range(damp.shape[1]):
                _add(damp[p, a], target[n + a], is_first, values)
            n += damp.shape[1]
