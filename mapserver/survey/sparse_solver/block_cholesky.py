"""Cholesky factorisation of large sparse symmetric matrices whose unknowns come in blocks, such as poses.

Multifrontal and supernodal: what fills in, and in which order, is found once for each pattern, over blocks; the arithmetic is dense LAPACK
on runs of columns with the same rows. Source: Liu 1992, The multifrontal method for sparse matrix solution.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from fleetmap.geometry import AnyArray, Array
from mapserver.survey.sparse_solver.elimination import Front, Fronts, eliminated, fronts_of
from mapserver.survey.sparse_solver.elimination_kernels import add_child


@dataclass(frozen=True)
class BlockCholesky:
    """What all matrices of one pattern have in common. order (U,): the matrix's unknowns as they are eliminated."""

    order: AnyArray
    fronts: Fronts

    @classmethod
    def of(cls, sizes: AnyArray, pairs: AnyArray) -> "BlockCholesky":
        """The pattern of N nodes with sizes (N,) unknowns each, numbered one after the other, of which `pairs` (B, 2) are coupled."""
        sizes, pairs = np.asarray(sizes, np.int64), np.asarray(pairs, np.int64).reshape(-1, 2)
        order, tree = eliminated(len(sizes), pairs[pairs[:, 0] != pairs[:, 1]])
        begins = np.cumsum(sizes) - sizes
        unknowns = [np.arange(begins[n], begins[n] + sizes[n]) for n in order]
        return cls(np.concatenate([np.zeros(0, np.int64), *unknowns]), fronts_of(sizes[order], order, tree))

    @property
    def size(self) -> int:
        """How many values a factor has."""
        return self.fronts.size

    def places(self, rows: AnyArray, cols: AnyArray) -> NDArray[np.int64]:
        """(B, 3) where blocks of nodes (row, col), which are coupled, stand among the values.

        Number (a, b) of a block belongs at first + a * down + b * right of its row here. A block is added once; its mirror image must not
        be. Of blocks on the diagonal the lower triangle counts.
        """
        return self.fronts.places(np.asarray(rows, np.int64), np.asarray(cols, np.int64))

    def factorised(self, values: Array) -> "CholeskyFactor | None":
        """The factor of the matrix with these values (size,), which it overwrites; None where it is not positive definite."""
        views, updates = [], dict[int, Array]()
        for number, front in enumerate(self.fronts.all):
            diagonal, lower = _views(front, values)
            rest = np.zeros((front.below, front.below), order="F")
            for child in front.children:
                add_child(updates.pop(child), self.fronts.all[child].at, diagonal, lower, rest)
            _, failed = lapack.dpotrf(diagonal, lower=1, clean=0, overwrite_a=1)
            if failed or not np.isfinite(diagonal.trace()):
                return None
            if front.below:
                blas.dtrsm(1.0, diagonal, lower, side=1, lower=1, trans_a=1, overwrite_b=1)
                blas.dsyrk(-1.0, lower, beta=1.0, c=rest, lower=1, overwrite_c=1)
                updates[number] = rest
            views.append((diagonal, lower))
        return CholeskyFactor(self, views)


@dataclass(frozen=True)
class CholeskyFactor:
    """The triangles (own, own) of the fronts, of which the lower half counts, and the rows (below, own) under them."""

    pattern: BlockCholesky
    blocks: list[tuple[Array, Array]]

    def solve(self, rhs: Array) -> Array:
        """x (U,) of A x = rhs (U,)."""
        x = np.asarray(rhs, np.float64)[self.pattern.order]
        fronts = list(zip(self.pattern.fronts.all, self.blocks, strict=True))
        for front, (diagonal, lower) in fronts:
            here = slice(front.column, front.column + front.own)
            x[here] = blas.dtrsv(diagonal, x[here], lower=1)
            if front.below:
                x[front.rows] -= lower @ x[here]
        for front, (diagonal, lower) in reversed(fronts):
            here = slice(front.column, front.column + front.own)
            pulled = x[here] - x[front.rows] @ lower if front.below else x[here]
            x[here] = blas.dtrsv(diagonal, pulled, lower=1, trans=1)
        solution = np.empty_like(x)
        solution[self.pattern.order] = x
        return solution


def _views(front: Front, values: Array) -> tuple[Array, Array]:
    """A front's triangle (own, own) and the rows (below, own) under it; in Fortran order, so that LAPACK writes to the values."""
    middle = front.start + front.own * front.own
    diagonal = values[front.start : middle].reshape((front.own, front.own), order="F")
    lower = values[middle : middle + front.below * front.own].reshape((front.below, front.own), order="F")
    return diagonal, lower
