"""Inner loops of block-sparse Cholesky factorisation: what fills in, and how a front takes what its children leave."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel

Indices = NDArray[np.int32]
Offsets = NDArray[np.int64]


@kernel
def elimination_tree(starts: Offsets, before: Indices) -> Indices:
    """parent (N,) of each node, -1 for roots; before[starts[n]:starts[n + 1]] are the lower neighbours of node n.

    Source: Davis 2006, Direct Methods for Sparse Linear Systems, section 4.1.
    """
    count = len(starts) - 1
    parent, ancestor = np.full(count, -1, np.int32), np.full(count, -1, np.int32)
    for n in range(count):
        for entry in range(starts[n], starts[n + 1]):
            m = before[entry]
            while m != -1 and m < n:
                above = ancestor[m]
                ancestor[m] = n
                if above == -1:
                    parent[m] = n
                m = above
    return parent


@kernel
def postorder(parent: Indices) -> Indices:
    """(N,) nodes so that every subtree is in one piece, its root last; children in the order that they had."""
    count = len(parent)
    head, following = np.full(count, -1, np.int32), np.full(count, -1, np.int32)
    for n in range(count - 1, -1, -1):
        if parent[n] >= 0:
            following[n] = head[parent[n]]
            head[parent[n]] = n
    order, stack = np.empty(count, np.int32), np.empty(count, np.int32)
    done = 0
    for root in range(count):
        if parent[root] >= 0:
            continue
        stack[0] = root
        top = 0
        while top >= 0:
            n = stack[top]
            child = head[n]
            if child >= 0:
                head[n] = following[child]
                top += 1
                stack[top] = child
            else:
                order[done] = n
                done += 1
                top -= 1
    return order


@kernel
def column_structures(starts: Offsets, after: Indices, parent: Indices) -> tuple[Offsets, Indices]:
    """Row pointers (N + 1,) and rows of the factor below its diagonal, ascending, column by column of nodes in postorder.

    after[starts[n]:starts[n + 1]] are the higher neighbours of node n.
    """
    count = len(parent)
    head, following = np.full(count, -1, np.int32), np.full(count, -1, np.int32)
    marked, found = np.full(count, -1, np.int32), np.empty(count, np.int32)
    pointers, rows = np.zeros(count + 1, np.int64), np.empty(4 * len(after) + 16, np.int32)
    for n in range(count):
        size = 0
        for entry in range(starts[n], starts[n + 1]):
            row = after[entry]
            if marked[row] != n:
                marked[row] = n
                found[size] = row
                size += 1
        child = head[n]
        while child >= 0:
            for entry in range(pointers[child], pointers[child + 1]):
                row = rows[entry]
                if row > n and marked[row] != n:
                    marked[row] = n
                    found[size] = row
                    size += 1
            child = following[child]
        first = pointers[n]
        if first + size > len(rows):
            grown = np.empty(2 * len(rows) + size, np.int32)
            grown[:first] = rows[:first]
            rows = grown
        rows[first : first + size] = np.sort(found[:size])
        pointers[n + 1] = first + size
        if parent[n] >= 0:
            following[n] = head[parent[n]]
            head[parent[n]] = n
    return pointers, rows[: pointers[count]].copy()


@kernel
def supernodes(parent: Indices, below: Offsets, unknowns: Offsets, limits: tuple[tuple[int, float], ...]) -> Indices:
    """The first node of each run of columns that are kept as one dense front, and N at the end.

    below (N,): unknowns below each column of nodes; unknowns (N + 1,): where those of each node begin. limits: columns, and the share
    of zeros that a front of no more columns may hold. Source: Ashcraft & Grimes 1989, The influence of relaxed supernode partitions.
    """
    count = len(parent)
    firsts = np.empty(count + 1, np.int32)
    exact = np.empty(count)  # numbers of each front that are not zero for certain
    top = -1
    for n in range(count):
        own = float(unknowns[n + 1] - unknowns[n])
        top += 1
        firsts[top] = n
        exact[top] = own * (own + 1.0) / 2.0 + own * below[n]
        while top > 0:
            last = firsts[top] - 1
            if parent[last] < firsts[top] or parent[last] > n:
                break
            columns = float(unknowns[n + 1] - unknowns[firsts[top - 1]])
            whole = columns * (columns + 1.0) / 2.0 + columns * below[n]
            filled = exact[top - 1] + exact[top]
            zeros = (whole - filled) / whole
            allowed = 1e-9
            for most, share in limits:
                if columns <= most:
                    allowed = max(allowed, share)
            if zeros > allowed:
                break
            top -= 1
            exact[top] = filled
    firsts[top + 1] = count
    return firsts[: top + 2].copy()


@kernel
def add_child(child: Array, rows: Indices, diagonal: Array, lower: Array, rest: Array) -> None:
    """Adds a child's update (m, m), lower triangle in Fortran order, to its parent's front at rows (m,)."""
    own = diagonal.shape[0]
    for c in range(len(rows)):
        col = rows[c]
        if col < own:
            for r in range(c, len(rows)):
                row = rows[r]
                if row < own:
                    diagonal[row, col] += child[r, c]
                else:
                    lower[row - own, col] += child[r, c]
        else:
            for r in range(c, len(rows)):
                rest[rows[r] - own, col - own] += child[r, c]
