"""In which order blocks of unknowns are eliminated, what fills in, and which columns are kept as one dense front.

Source: Davis 2006, Direct Methods for Sparse Linear Systems, chapters 4 and 7.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

from fleetmap.geometry import AnyArray
from mapserver.survey.sparse_solver.elimination_kernels import (
    Indices,
    Offsets,
    column_structures,
    elimination_tree,
    postorder,
    supernodes,
)

# Columns of a front, and the share of zeros that it may hold if it has no more of them: arithmetic on zeros is cheaper than
# many calls. As CHOLMOD does it (Chen, Davis, Hager & Rajamanickam 2008).
_RELAXED = ((24, 0.8), (96, 0.1), (2**62, 0.05))


@dataclass(frozen=True)
class Tree:
    """Columns of nodes in the order of elimination: parent (N,), -1 for roots, and for each its rows below the diagonal."""

    parent: Indices
    pointers: Offsets
    rows: Indices


@dataclass(frozen=True, slots=True)
class Front:
    """One run of columns, `own` unknowns wide from `column` on in the order of elimination, over `below` unknowns of later nodes.

    start: where its triangle (own, own) begins among the values, then follow the (below, own) rows under it, all in Fortran order.
    rows (below,): its unknowns there, in the order of elimination. at (below,): those rows in the front of its parent.
    children: the fronts that update it.
    """

    start: int
    own: int
    below: int
    column: int
    rows: Indices
    at: Indices
    children: tuple[int, ...]


@dataclass(frozen=True)
class Fronts:
    """All S fronts, children first, and where N nodes stand in them.

    position (N,) of the nodes in the order of elimination. By position: front and offset (N,) of a node's unknowns in its front.
    row_starts (S + 1,), row_nodes and row_offsets: positions of the nodes under each front, and of their unknowns among the rows below.
    """

    all: list[Front]
    size: int
    position: AnyArray
    front: AnyArray
    offset: AnyArray
    row_starts: AnyArray
    row_nodes: AnyArray
    row_offsets: AnyArray

    def places(self, rows: AnyArray, cols: AnyArray) -> NDArray[np.int64]:
        """(B, 3), see BlockCholesky."""
        starts, owns, belows = np.array([(f.start, f.own, f.below) for f in self.all], np.int64).reshape(-1, 3).T
        row, col = self.position[rows], self.position[cols]
        late, early = np.maximum(row, col), np.minimum(row, col)
        front = self.front[early]
        inside = self.front[late] == front
        under = np.zeros(len(rows), np.int64)
        # Rows under a front rise, and fronts follow each other: one search finds them all.
        count = len(self.position)
        codes = np.repeat(np.arange(len(owns)), np.diff(self.row_starts)) * count + self.row_nodes
        sought = (front * count + late)[~inside]
        found = np.searchsorted(codes, sought)
        assert np.array_equal(np.append(codes, -1)[found], sought), "pairs of nodes that are not coupled"
        under[~inside] = self.row_offsets[found]
        step = np.where(inside, owns[front], belows[front])
        row_here = np.where(inside, self.offset[late], owns[front] ** 2 + under)
        first = starts[front] + row_here + self.offset[early] * step
        turned = row < col
        return np.stack([first, np.where(turned, step, 1), np.where(turned, 1, step)], axis=1)


def eliminated(count: int, pairs: AnyArray) -> tuple[AnyArray, Tree]:
    """N nodes in an order that fills in little, every subtree of the elimination tree in one piece, and the tree."""
    order = _minimum_degree(count, pairs)
    order = order[postorder(elimination_tree(*_neighbours(pairs, order, after=False)))]
    parent = elimination_tree(*_neighbours(pairs, order, after=False))
    return order, Tree(parent, *column_structures(*_neighbours(pairs, order, after=True), parent))


def _minimum_degree(count: int, pairs: AnyArray) -> AnyArray:
    """(N,) nodes by minimum degree. SuperLU finds the order: that of a matrix with one unknown for each node costs next to nothing."""
    nodes = np.arange(count)
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    # Laplacian and unit: positive definite, whatever pairs there are.
    rows, cols = np.concatenate([nodes, ends[:, 0], ends[:, 0]]), np.concatenate([nodes, ends[:, 0], ends[:, 1]])
    values = np.concatenate([np.ones(count + len(ends)), np.full(len(ends), -1.0)])
    graph = scipy.sparse.csc_array((values, (rows, cols)), shape=(count, count))
    options = {"SymmetricMode": True}
    factor = scipy.sparse.linalg.splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.argsort(factor.perm_c)


def _neighbours(pairs: AnyArray, order: AnyArray, *, after: bool) -> tuple[Offsets, Indices]:
    """Pointers (N + 1,) and numbers of each node's neighbours after it, or before it, all numbered along `order`."""
    position = np.argsort(order)
    ends = np.sort(position[pairs], axis=1)
    of, others = (ends[:, 0], ends[:, 1]) if after else (ends[:, 1], ends[:, 0])
    by_node = np.lexsort((others, of))
    pointers = np.searchsorted(of[by_node], np.arange(len(order) + 1)).astype(np.int64)
    return pointers, others[by_node].astype(np.int32)


def fronts_of(sizes: AnyArray, order: AnyArray, tree: Tree) -> Fronts:
    """The fronts of N columns with sizes (N,) unknowns, which belong to nodes order (N,)."""
    unknowns = np.concatenate([[0], np.cumsum(sizes)])
    sums = np.concatenate([[0], np.cumsum(sizes[tree.rows])])
    below = sums[tree.pointers[1:]] - sums[tree.pointers[:-1]]
    firsts = supernodes(tree.parent, below, unknowns, _RELAXED).astype(np.int64)
    lasts = firsts[1:] - 1
    front = np.repeat(np.arange(len(lasts)), np.diff(firsts))
    counts = tree.pointers[lasts + 1] - tree.pointers[lasts]
    row_nodes = tree.rows[spread(tree.pointers[lasts], counts)].astype(np.int64)
    row_starts = np.concatenate([[0], np.cumsum(counts)])
    before = np.concatenate([[0], np.cumsum(sizes[row_nodes])])
    row_offsets = before[:-1] - np.repeat(before[row_starts[:-1]], counts)
    offset = unknowns[:-1] - unknowns[firsts[front]]
    nodes = np.argsort(order), front, offset, row_starts, row_nodes, row_offsets
    owns = unknowns[firsts[1:]] - unknowns[firsts[:-1]]
    lengths = owns * (owns + below[lasts])
    fronts = Fronts([], int(lengths.sum()), *nodes)
    children: list[list[int]] = [[] for _ in lasts]
    for number, start in enumerate((np.cumsum(lengths) - lengths).tolist()):
        under = row_nodes[row_starts[number] : row_starts[number + 1]]
        if len(under):
            children[front[under[0]]].append(number)
        at = _rows_in_parent(fronts, under, owns, sizes)
        rows = spread(unknowns[under], sizes[under])
        shape = int(owns[number]), len(rows), int(unknowns[firsts[number]])
        fronts.all.append(Front(start, *shape, rows, at, tuple(children[number])))
    return fronts


def _rows_in_parent(fronts: Fronts, under: AnyArray, owns: AnyArray, sizes: AnyArray) -> Indices:
    """(below,) the rows of a front with nodes at positions `under` below it, in its parent: that of the first of them."""
    if not len(under):
        return np.zeros(0, np.int32)
    parent = int(fronts.front[under[0]])
    rows = slice(fronts.row_starts[parent], fronts.row_starts[parent + 1])
    inside = fronts.front[under] == parent
    places = fronts.offset[under]
    found = np.searchsorted(fronts.row_nodes[rows], under[~inside])
    places[~inside] = owns[parent] + fronts.row_offsets[rows][found]
    return spread(places, sizes[under])


def spread(firsts: AnyArray, counts: AnyArray) -> Indices:
    """Each of `firsts` and the numbers that follow it, as many as `counts` says."""
    ends = np.cumsum(counts)
    numbers = np.arange(int(ends[-1]) if len(ends) else 0)
    return np.asarray(numbers + np.repeat(firsts - ends + counts, counts), np.int32)
