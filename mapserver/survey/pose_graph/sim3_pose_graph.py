"""Pose graph optimization over Sim(3): poses and scales of keyframes whose scale drifts. Source: Strasdat et al. 2010.

A similarity maps x to scale * R x + t; keyframe k has map_from_k. Perturbations (7,) are on the right, in the keyframe's own axes:
rotation, translation in its own lengths, logarithm of the scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array

_MAX_DAMPING = 1e8
_INLIER_PROBABILITY = 0.999
_MAX_ITERATIONS = 50
_ROUND_ITERATIONS = 4  # while the loops' weights still change


@dataclass(frozen=True, slots=True)
class Similarities:
    """N similarities map_from_k: rotations (N, 3, 3), translations (N, 3), scales (N,)."""

    rotations: Array
    translations: Array
    scales: Array

    @classmethod
    def rigid(cls, target_from_source: Array) -> "Similarities":
        """Rigid transforms (N, 4, 4) as similarities of scale 1."""
        return cls(
            target_from_source[:, :3, :3].copy(), target_from_source[:, :3, 3].copy(), np.ones(len(target_from_source))
        )

    def moved(self, steps: Array) -> "Similarities":
        """Perturbed by steps (N, 7)."""
        turns = Rotation.from_rotvec(steps[:, :3]).as_matrix()
        shifts = self.scales[:, None] * np.einsum("nij,nj->ni", self.rotations, steps[:, 3:6])
        return Similarities(self.rotations @ turns, self.translations + shifts, self.scales * np.exp(steps[:, 6]))


@dataclass(frozen=True, slots=True)
class SimilarityEdge:
    """Measured: a point x of keyframe j lies at scale * R x + t for keyframe i; i_from_j (4, 4) holds R and t.

    cov (7, 7) of the error: rotation, translation in lengths of i, logarithm of the scale. Loops may be wrong, other edges are true.
    """

    i: int
    j: int
    i_from_j: Array
    scale: float
    cov: Array
    is_loop: bool


@dataclass(frozen=True, slots=True)
class SimilarityResult:
    """Optimised map_from_k, the loops' weights in their order (1 believed, 0 not), and half the sums of squares before and after."""

    map_from_keyframe: Similarities
    loop_weights: Array
    cost_before: float
    cost_after: float


@dataclass(frozen=True)
class _Packed:
    """E edges in arrays; roots (E, 7, 7) whiten their errors."""

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    rotations: Array
    translations: Array
    scales: Array
    roots: Array


def residuals(edges: Sequence[SimilarityEdge], state: Similarities) -> tuple[Array, Array, Array]:
    """(E, 7) errors of edges and their derivatives (E, 7, 7) by the perturbations of keyframes i and j.

    An error is that of measured i_from_j @ (j_from_map @ map_from_i), the identity where all agrees: rotation, translation, log scale.
    """
    return _residuals(_pack(edges), state)


def _pack(edges: Sequence[SimilarityEdge]) -> _Packed:
    measured = np.array([e.i_from_j for e in edges]).reshape(-1, 4, 4)
    covariances = np.array([e.cov for e in edges]).reshape(-1, 7, 7)
    i, j = np.array([(e.i, e.j) for e in edges], np.int64).reshape(-1, 2).T
    scales, roots = np.array([e.scale for e in edges]), np.linalg.inv(np.linalg.cholesky(covariances))
    return _Packed(i, j, measured[:, :3, :3], measured[:, :3, 3], scales, roots)


def _errors(edges: _Packed, state: Similarities) -> tuple[Array, Array, Array]:
    """(E, 7) errors, and of each the rotation (E, 3, 3) and the scale (E,)."""
    i_from_map = edges.rotations @ state.rotations[edges.j].transpose(0, 2, 1)
    rotation = i_from_map @ state.rotations[edges.i]
    ratio = edges.scales / state.scales[edges.j]
    apart = state.translations[edges.i] - state.translations[edges.j]
    translation = ratio[:, None] * np.einsum("eab,eb->ea", i_from_map, apart) + edges.translations
    scale = ratio * state.scales[edges.i]
    turns = Rotation.from_matrix(rotation).as_rotvec()
    return np.column_stack([turns, translation, np.log(scale)]), rotation, scale


def _residuals(edges: _Packed, state: Similarities) -> tuple[Array, Array, Array]:
    errors, rotation, scale = _errors(edges, state)
    by_i, by_j = np.zeros((2, len(errors), 7, 7))
    inverse_left = _inverse_left_jacobians(errors[:, :3])
    by_i[:, :3, :3] = inverse_left @ rotation
    by_i[:, 3:6, 3:6] = scale[:, None, None] * rotation
    by_i[:, 6, 6] = 1.0
    off = errors[:, 3:6] - edges.translations
    by_j[:, :3, :3] = -inverse_left @ edges.rotations
    by_j[:, 3:6, :3] = _skews(off) @ edges.rotations
    by_j[:, 3:6, 3:6] = -edges.scales[:, None, None] * edges.rotations
    by_j[:, 3:6, 6] = -off
    by_j[:, 6, 6] = -1.0
    return errors, by_i, by_j


def _skews(vectors: Array) -> Array:
    out = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -z, y, -x
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = z, -y, x
    return out


def _inverse_left_jacobians(turns: Array) -> Array:
    """(E, 3, 3) of rotation vectors (E, 3). Source: Barfoot, State Estimation for Robotics, 7.76."""
    angle = np.maximum(np.linalg.norm(turns, axis=1), 1e-8)
    factor = np.where(angle < 1e-4, 1.0 / 12.0, 1.0 / angle**2 - 0.5 / (angle * np.tan(0.5 * angle)))
    cross = _skews(turns)
    return np.asarray(np.eye(3) - 0.5 * cross + factor[:, None, None] * (cross @ cross))


def optimize_similarities(start: Similarities, edges: Sequence[SimilarityEdge], fixed: int = 0) -> SimilarityResult:
    """The similarities that fit the edges best; keyframe `fixed` stays, and with it the scale.

    Loops that contradict the rest are disbelieved, all other edges taken for true: by graduated non-convexity with Geman and McClure's
    cost, which believes all loops at first; one whose square then stays within 0.999 of chi-square counts in full.
    Raises SurveyError where a keyframe hangs on nothing. Sources: Strasdat et al. 2010 (Sim(3) graphs), Yang et al. 2020 (GNC).
    """
    packed = _pack(edges)
    is_loop = np.array([edge.is_loop for edge in edges], bool)
    weights = np.ones(len(edges))
    before = _cost(start, packed, weights)
    if is_loop.any():
        limit = float(2.0 * gammaincinv(3.5, _INLIER_PROBABILITY))  # chi-square of seven freedoms
        state = _solve(start, packed, weights, fixed, _MAX_ITERATIONS)
        squares = _squares(state, packed)[is_loop]
        control = max(2.0 * float(squares.max()) / limit, 1.0)
        while True:
            weights[is_loop] = (control * limit / (squares + control * limit)) ** 2
            state = _solve(state, packed, weights, fixed, _ROUND_ITERATIONS)
            squares = _squares(state, packed)[is_loop]
            if control == 1.0:
                break
            control = max(control / 1.6, 1.0)
        for _ in range(2):
            weights[is_loop] = squares <= limit
            state = _solve(state, packed, weights, fixed, _MAX_ITERATIONS)
            squares = _squares(state, packed)[is_loop]
    solved = _solve(start if not is_loop.any() else state, packed, weights, fixed, _MAX_ITERATIONS)
    return SimilarityResult(solved, weights[is_loop], before, _cost(solved, packed, weights))


def _squares(state: Similarities, edges: _Packed) -> Array:
    return np.asarray((np.einsum("eab,eb->ea", edges.roots, _errors(edges, state)[0]) ** 2).sum(axis=1))


def _cost(state: Similarities, edges: _Packed, weights: Array) -> float:
    return 0.5 * float(weights @ _squares(state, edges))


def _solve(state: Similarities, edges: _Packed, weights: Array, fixed: int, max_iterations: int) -> Similarities:
    """Levenberg-Marquardt over all keyframes but `fixed`."""
    cost, damping = _cost(state, edges, weights), 1e-6
    for _ in range(max_iterations):
        hessian, gradient = _normal(state, edges, weights, fixed)
        while True:
            candidate = state.moved(_step(hessian, gradient, damping).reshape(-1, 7))
            new = _cost(candidate, edges, weights)
            if new <= cost or damping > _MAX_DAMPING:
                break
            damping *= 10.0
        if damping > _MAX_DAMPING:
            break
        done = cost - new <= 1e-7 * (1.0 + cost)
        state, cost, damping = candidate, new, max(0.1 * damping, 1e-9)
        if done:
            break
    return state


def _normal(state: Similarities, edges: _Packed, weights: Array, fixed: int) -> tuple[csc_matrix, Array]:
    size = 7 * len(state.scales)
    errors, by_i, by_j = _residuals(edges, state)
    jacobians = edges.roots @ np.concatenate([by_i, by_j], axis=2)
    whitened = np.einsum("eab,eb->ea", edges.roots, errors)
    index = np.concatenate([7 * edges.i[:, None] + np.arange(7), 7 * edges.j[:, None] + np.arange(7)], axis=1)
    gradient = np.zeros(size)
    np.add.at(gradient, index, -weights[:, None] * np.einsum("eab,ea->eb", jacobians, whitened))
    blocks = weights[:, None, None] * (jacobians.transpose(0, 2, 1) @ jacobians)
    gradient[7 * fixed : 7 * fixed + 7] = 0.0
    rows, columns = np.repeat(index, 14, axis=1).ravel(), np.tile(index, (1, 14)).ravel()
    matrix = coo_matrix((blocks.ravel(), (rows, columns)), (size, size)).tocsc()
    free = np.ones(size)
    free[7 * fixed : 7 * fixed + 7] = 0.0
    chosen = diags(free)
    return (chosen @ matrix @ chosen + diags(1.0 - free)).tocsc(), gradient


def _step(hessian: csc_matrix, gradient: Array, damping: float) -> Array:
    diagonal = hessian.diagonal()
    if not (diagonal > 0).all():
        lost = sorted({int(n) // 7 for n in np.flatnonzero(~(diagonal > 0))})
        raise SurveyError(f"keyframes {lost[:10]} have no edge in the scaled pose graph; leave them out")
    return np.asarray(splu((hessian + damping * diags(diagonal)).tocsc()).solve(gradient))
