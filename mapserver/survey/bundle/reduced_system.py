"""Solving the reduced system: dense where small, else by conjugate gradients, else by sparse factorisation."""

from dataclasses import dataclass, field

import numpy as np
import scipy.linalg

from fleetmap.geometry import AnyArray, Array
from mapserver.survey.bundle.reduced_system_kernels import (
    BlockPlaces,
    ChainFactors,
    SystemArrays,
    conjugate_gradients,
    factor_chains,
    fill_blocks,
    fill_lower,
)
from mapserver.survey.bundle.settings import BundleSettings
from mapserver.survey.bundle.sparsity import Structure
from mapserver.survey.sparse_solver.block_cholesky import BlockCholesky


@dataclass(frozen=True)
class Chains:
    """The inertial edges' order: edge_slots (E, 2), -1 for held keyframes; sequence and link (P,) as in the kernels.

    layouts: that of the sparse factor, once it was asked for.
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
    """The step by sparse Cholesky; what fills in is found once for all systems of the same structure."""
    layouts = system.chains.layouts
    if not layouts:
        layouts.append(SparseLayout.of(system))
    factor = layouts[0].pattern.factorised(layouts[0].values(system))
    return None if factor is None else factor.solve(system.rhs.ravel()).reshape(system.rhs.shape)


@dataclass(frozen=True)
class SparseLayout:
    """Where a problem's blocks lie in the sparse factor of each of its systems.

    Poses and motions are blocks of their own, as images join poses alone.
    """

    pattern: BlockCholesky
    places: BlockPlaces

    @classmethod
    def of(cls, system: ReducedSystem) -> "SparseLayout":
        """The layout of all systems with the structure of this one."""
        s, (count, size), width = system.structure, system.rhs.shape, system.blocks.shape[1]
        parts = [width, size - width] if size > width else [width]
        rows = np.repeat(np.arange(count), np.diff(s.row_ptr))
        images = len(parts) * np.stack([rows, s.cols], axis=1)
        edges = _edge_pairs(system.chains.edge_slots) if len(parts) == 2 else np.zeros((0, 10, 2), np.int64)
        joined = edges[(edges >= 0).all(axis=2)]
        pattern = BlockCholesky.of(np.tile(parts, count), np.concatenate([images, joined]))
        edge_places = np.full((*edges.shape[:2], 3), -1)
        edge_places[(edges >= 0).all(axis=2)] = pattern.places(*joined.T)
        own = np.arange(len(parts) * count)
        diagonal = pattern.places(own, own).reshape(count, len(parts), 3)
        return cls(pattern, BlockPlaces(pattern.places(*images.T), edge_places, diagonal))

    def values(self, system: ReducedSystem) -> Array:
        """S as its factorisation takes it."""
        values = np.zeros(self.pattern.size)
        fill_blocks(system.arrays, self.places, values)
        return values


def _edge_pairs(edge_slots: AnyArray) -> AnyArray:
    """(E, 10, 2) pairs of nodes, pose and motion of both ends, that an inertial edge joins; negative for held keyframes."""
    slots = np.asarray(edge_slots, np.int64).reshape(-1, 2)
    nodes = np.where(slots[:, :, None] < 0, -1, 2 * slots[:, :, None] + np.arange(2)).reshape(-1, 4)
    return np.stack([nodes[:, [x, y]] for x in range(4) for y in range(x + 1)], axis=1)
