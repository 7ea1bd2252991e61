"""Solving the reduced system: dense where small, else by conjugate gradients, else by sparse factorisation."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

from fleetmap.geometry import AnyArray, Array
from mapserver.survey.bundle_problem import BundleSettings
from mapserver.survey.bundle_solve_kernels import conjugate_gradients, factor_chains, fill_lower
from mapserver.survey.bundle_structure import Structure


@dataclass(frozen=True)
class Chains:
    """The inertial edges' order: edge_slots (E, 2), -1 for held keyframes; sequence and link (P,) as in the kernels."""

    edge_slots: AnyArray
    sequence: AnyArray
    link: AnyArray


@dataclass(frozen=True)
class ReducedSystem:
    """S x = rhs over the slots; damp (P, D) is a diagonal added to S."""

    structure: Structure
    chains: Chains
    blocks: Array
    edge_blocks: Array
    damp: Array
    rhs: Array


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

    `last` solved the problem's last system: where conjugate gradients have stalled once, they are not tried again.
    """
    if system.rhs.size <= settings.dense_unknowns:
        return solve_dense(system), "dense"
    step = None if last == "sparse" else solve_pcg(system, settings)
    return (step, "pcg") if step is not None else (solve_sparse(system), "sparse")


def dense_lower(system: ReducedSystem) -> Array:
    """S as a dense (PD, PD) array in Fortran order whose upper triangle is valid (and equals the lower one of S)."""
    unknowns, s = system.rhs.size, system.structure
    lower = np.zeros((unknowns, unknowns))
    fill_lower(
        system.blocks, s.row_ptr, s.cols, system.chains.edge_slots, system.edge_blocks, system.damp, s.free, lower
    )
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
    s, chains = system.structure, system.chains
    inverses, couplings, step = np.empty((count, size, size)), np.empty((count, size, size)), np.empty((count, size))
    try:
        factor_chains(
            system.blocks, s.row_ptr, chains.edge_slots, system.edge_blocks, system.damp, s.free, chains.sequence,
            chains.link, inverses, couplings,
        )  # fmt: skip
    except np.linalg.LinAlgError:
        return None
    iterations = conjugate_gradients(
        system.blocks, s.row_ptr, s.cols, chains.edge_slots, system.edge_blocks, system.damp, s.free, chains.sequence,
        chains.link, inverses, couplings, system.rhs, settings.pcg_tolerance, settings.pcg_max_iterations, step,
    )  # fmt: skip
    return step if iterations >= 0 else None


def solve_sparse(system: ReducedSystem) -> Array | None:
    """The step by sparse LU without pivoting, fill reduced by minimum degree."""
    matrix = _sparse_matrix(system)
    try:
        factor = scipy.sparse.linalg.splu(
            matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
    except RuntimeError:  # exactly singular
        return None
    step = factor.solve(system.rhs.ravel()).reshape(system.rhs.shape)
    return step if np.isfinite(step).all() else None


def _sparse_matrix(system: ReducedSystem) -> scipy.sparse.csc_array:
    s, size = system.structure, system.rhs.shape[1]
    held = ~s.free.ravel()
    block_rows = np.repeat(np.arange(len(s.row_ptr) - 1), np.diff(s.row_ptr))
    row, col, value = _entries(block_rows, s.cols, system.blocks, size)
    off = row // size != col // size
    parts = [(row, col, value), (col[off], row[off], value[off])]
    for x in range(2):
        for y in range(2):
            p, q = system.chains.edge_slots[:, x], system.chains.edge_slots[:, y]
            both = (p >= 0) & (q >= 0)
            inner = system.edge_blocks[both, 15 * x : 15 * x + 15, 15 * y : 15 * y + 15]
            parts.append(_entries(p[both], q[both], inner, size))
    rows, cols, values = (np.concatenate([part[k] for part in parts]) for k in range(3))
    keep = ~(held[rows] | held[cols])
    diagonal = np.arange(system.rhs.size)
    rows, cols = np.concatenate([rows[keep], diagonal]), np.concatenate([cols[keep], diagonal])
    values = np.concatenate([values[keep], np.where(held, 1.0, system.damp.ravel())])
    return scipy.sparse.coo_array((values, (rows, cols)), shape=(system.rhs.size, system.rhs.size)).tocsc()


def _entries(block_rows: AnyArray, block_cols: AnyArray, blocks: Array, size: int) -> tuple[AnyArray, AnyArray, Array]:
    inner = np.arange(blocks.shape[1])
    row = np.broadcast_to(size * block_rows[:, None, None] + inner[None, :, None], blocks.shape)
    col = np.broadcast_to(size * block_cols[:, None, None] + inner[None, None, :], blocks.shape)
    return row.ravel(), col.ravel(), blocks.ravel()
