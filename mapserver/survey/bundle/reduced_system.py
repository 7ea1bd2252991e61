"""Solving the reduced system: by dense factorisation where it is small, else by sparse one."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from fleetmap import core
from fleetmap.geometry import AnyArray, Array
from mapserver.survey.bundle.reduced_system_kernels import BlockPlaces, SystemArrays, fill_blocks, fill_lower
from mapserver.survey.bundle.sparsity import Structure
from mapserver.survey.sparse_solver.block_cholesky import block_cholesky


@dataclass(frozen=True)
class ReducedSystem:
    """S x = rhs over the slots; edge_slots (E, 2) of the inertial edges, -1 for held keyframes; damp (P, D) is a diagonal added to S."""

    structure: Structure
    edge_slots: AnyArray
    blocks: Array
    edge_blocks: Array
    damp: Array
    rhs: Array

    @property
    def arrays(self) -> SystemArrays:
        """S as the kernels take it."""
        s = self.structure
        return SystemArrays(self.blocks, s.row_ptr, s.cols, self.edge_slots, self.edge_blocks, self.damp, s.free)


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


@dataclass(frozen=True)
class SparseLayout:
    """Where a problem's blocks lie in the sparse factor of each of its systems.

    Poses and motions are blocks of their own, as images join poses alone.
    """

    pattern: core.BlockCholesky
    places: BlockPlaces

    @classmethod
    def of(cls, system: ReducedSystem) -> "SparseLayout":
        """The layout of all systems with the structure of this one."""
        s, (count, size), width = system.structure, system.rhs.shape, system.blocks.shape[1]
        parts = [width, size - width] if size > width else [width]
        rows = np.repeat(np.arange(count), np.diff(s.row_ptr))
        images = len(parts) * np.stack([rows, s.cols], axis=1)
        edges = _edge_pairs(system.edge_slots) if len(parts) == 2 else np.zeros((0, 10, 2), np.int64)
        joined = edges[(edges >= 0).all(axis=2)]
        pattern = block_cholesky(np.tile(parts, count), np.concatenate([images, joined]))
        edge_places = np.full((*edges.shape[:2], 3), -1)
        edge_places[(edges >= 0).all(axis=2)] = pattern.places(*joined.T.copy())
        own = np.arange(len(parts) * count)
        diagonal = pattern.places(own, own).reshape(count, len(parts), 3)
        return cls(pattern, BlockPlaces(pattern.places(*images.T.copy()), edge_places, diagonal))

    def solve(self, system: ReducedSystem) -> Array | None:
        """The step by sparse Cholesky, None where S is not positive definite."""
        values = np.zeros(self.pattern.size)
        fill_blocks(system.arrays, self.places, values)
        if not self.pattern.factorise(values):
            return None
        return self.pattern.solve(values, system.rhs.ravel()).reshape(system.rhs.shape)


def _edge_pairs(edge_slots: AnyArray) -> AnyArray:
    """(E, 10, 2) pairs of nodes, pose and motion of both ends, that an inertial edge joins; negative for held keyframes."""
    slots = np.asarray(edge_slots, np.int64).reshape(-1, 2)
    nodes = np.where(slots[:, :, None] < 0, -1, 2 * slots[:, :, None] + np.arange(2)).reshape(-1, 4)
    return np.stack([nodes[:, [x, y]] for x in range(4) for y in range(x + 1)], axis=1)
