"""Solving the reduced system: dense where small, else by conjugate gradients, else by sparse factorisation."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

from fleetmap.geometry import AnyArray, Array
from mapserver.survey.bundle.reduced_system_kernels import (
    ChainFactors,
    Numbers,
    SystemArrays,
    add_numbers,
    conjugate_gradients,
    factor_chains,
    fill_lower,
    lay_out,
)
from mapserver.survey.bundle.settings import BundleSettings
from mapserver.survey.bundle.sparsity import Structure


@dataclass(frozen=True)
class Chains:
    """The inertial edges' order: edge_slots (E, 2), -1 for held keyframes; sequence and link (P,) as in the kernels.

    layouts: that of the sparse matrix, once it was asked for.
    """

    edge_slots: AnyArray
    sequence: AnyArray
    link: AnyArray
    layouts: list["SparseLayout"] = field(default_factory=list)


@dataclass(frozen=True)
class ReducedSystem:
    """S x = rhs over the slots; damp (P, D) is a diagonal added to S."""

    structure: Structure
    chains: Chains
    blocks: Array
    edge_blocks: Array
    damp: Array
    rhs: Array

    @property
    def arrays(self) -> SystemArrays:
        """S as the kernels take it."""
        s = self.structure
        edges = self.chains.edge_slots, self.edge_blocks
        return SystemArrays(self.blocks, s.row_ptr, s.cols, *edges, self.damp, s.free)


def build_chains(edge_slots: AnyArray, count: int) -> Chains:
    """Every slot after its predecessor. An edge that would branch or close a ring is left out of the links only."""
    link = np.full(count, -1, np.int64)
    successor = np.full(count, -1, np.int64)
    end_of = np.arange(count)  # for each chain's first slot its last one, and the other way round
    for e, (i, j) in enumerate(edge_slots):
        if i >= 0 and j >= 0 and link[j] < 0 and successor[i] < 0 and end_of[i] != j:
            link[j], successor[i] = e, j
            first, last = end_of[i], end_of[j]
            end_of[first], end_of[last] = last, first
    sequence = []
    for head in np.nonzero(link < 0)[0]:
        slot = int(head)
        while slot >= 0:
            sequence.append(slot)
            slot = int(successor[slot])
    return Chains(edge_slots, np.array(sequence, np.int64), link)


def solve_reduced(system: ReducedSystem, settings: BundleSettings, last: str) -> tuple[Array | None, str]:
    """The step (P, D), None where S is not positive definite, and which solver gave it.

    `last` solved the problem's last system: where conjugate gradients have stalled once, they are not tried again. Along a
    drive they need hundreds of iterations, but there few keyframes see the same, and factors stay sparse.
    """
    if system.rhs.size <= settings.dense_unknowns:
        return solve_dense(system), "dense"
    along_a_drive = len(system.blocks) <= settings.sparse_couplings * len(system.rhs)
    step = None if last == "sparse" or along_a_drive else solve_pcg(system, settings)
    return (step, "pcg") if step is not None else (solve_sparse(system), "sparse")


def dense_lower(system: ReducedSystem) -> Array:
    """S as a dense (PD, PD) array in Fortran order whose upper triangle is valid (and equals the lower one of S)."""
    lower = np.zeros((system.rhs.size, system.rhs.size))
    fill_lower(system.arrays, lower)
    return lower.T


def solve_dense(system: ReducedSystem) -> Array | None:
    """The step by Cholesky."""
    try:
        factor = scipy.linalg.cho_factor(dense_lower(system), lower=False, overwrite_a=True, check_finite=False)
    except scipy.linalg.LinAlgError:
        return None
    step = scipy.linalg.cho_solve(factor, system.rhs.ravel(), check_finite=False)
    return np.asarray(step, np.float64).reshape(system.rhs.shape)


def marginal_blocks(system: ReducedSystem, slots: AnyArray) -> Array:
    """(n, 6, 6) pose blocks of the inverse of S, dense; scaled first, as biases and metres differ by magnitudes."""
    upper = dense_lower(system)
    scale = 1.0 / np.sqrt(np.diag(upper))
    factor = scipy.linalg.cho_factor(upper * np.outer(scale, scale), lower=False, overwrite_a=True, check_finite=False)
    rows = (system.rhs.shape[1] * slots[:, None] + np.arange(6)).astype(np.int64)
    units = np.zeros((len(upper), rows.size))
    units[rows.ravel(), np.arange(rows.size)] = scale[rows.ravel()]
    columns = scipy.linalg.cho_solve(factor, units, check_finite=False) * scale[:, None]
    return np.array([columns[rows[n], 6 * n : 6 * n + 6] for n in range(len(slots))]).reshape(-1, 6, 6)


def solve_pcg(system: ReducedSystem, settings: BundleSettings) -> Array | None:
    """The step by preconditioned conjugate gradients, None where they stall."""
    count, size = system.rhs.shape
    inverses, couplings, step = np.empty((count, size, size)), np.empty((count, size, size)), np.empty((count, size))
    factors = ChainFactors(system.chains.sequence, system.chains.link, inverses, couplings)
    try:
        factor_chains(system.arrays, factors)
    except np.linalg.LinAlgError:
        return None
    limits = settings.pcg_tolerance, settings.pcg_max_iterations
    iterations = conjugate_gradients(system.arrays, factors, system.rhs, limits, step)
    return step if iterations >= 0 else None


def solve_sparse(system: ReducedSystem) -> Array | None:
    """The step by sparse LU without pivoting, fill reduced by minimum degree."""
    layouts = system.chains.layouts
    order = layouts[0].order if layouts else np.arange(system.rhs.size)
    layout = layouts[0] if layouts else SparseLayout.of(system, order)
    try:
        factor = _factor(layout.matrix(system), "NATURAL" if layouts else "MMD_AT_PLUS_A")
    except RuntimeError:  # exactly singular
        return None
    if not layouts:  # minimum degree is not asked again for systems of the same structure
        layouts.append(SparseLayout.of(system, np.argsort(factor.perm_c)))
    step = np.empty(system.rhs.size)
    step[order] = factor.solve(system.rhs.ravel()[order])
    return step.reshape(system.rhs.shape) if np.isfinite(step).all() else None


def _factor(matrix: scipy.sparse.csc_array, order: Literal["NATURAL", "MMD_AT_PLUS_A"]) -> Any:
    return scipy.sparse.linalg.splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


@dataclass(frozen=True)
class SparseLayout:
    """Where a problem's numbers lie in the sparse matrix of each of its systems, unknowns in an order that fills in little.

    order (U,): the unknowns by their place in the matrix. below: image blocks beside the diagonal. target: to which of the matrix's
    values each number of a system is added; indices, indptr as in a CSC matrix.
    """

    order: AnyArray
    below: AnyArray
    target: AnyArray
    indices: AnyArray
    indptr: AnyArray

    @classmethod
    def of(cls, system: ReducedSystem, order: AnyArray) -> "SparseLayout":
        """The layout of all systems with the structure of this one."""
        s = system.structure
        place = np.empty(system.rhs.size, np.int32)
        place[order] = np.arange(len(place))
        block_rows = np.repeat(np.arange(len(s.row_ptr) - 1, dtype=np.int32), np.diff(s.row_ptr))
        below = np.flatnonzero(block_rows != s.cols)
        edges = np.ascontiguousarray(system.chains.edge_slots, np.int64).reshape(-1, 2)
        numbers = Numbers(block_rows, s.cols, below, edges, s.free.ravel(), place, system.rhs.shape[1])
        indptr, indices, target = lay_out(numbers)
        return cls(order, below, target, indices, indptr)

    def matrix(self, system: ReducedSystem) -> scipy.sparse.csc_array:
        """S with rows and columns in `order`; unknowns that are held have a one on the diagonal."""
        damp = np.where(system.structure.free, system.damp, 1.0)
        values = np.zeros(len(self.indices))
        add_numbers(system.blocks, self.below, system.edge_blocks, damp, self.target, values)
        return scipy.sparse.csc_array((values, self.indices, self.indptr), shape=(len(self.order),) * 2)
