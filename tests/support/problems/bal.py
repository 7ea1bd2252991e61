"""Bundle adjustment in the large: the reference problems' text format, solved with the survey's own reduced system.

Their cameras look along -z and each has a focal length and two distortion coefficients of its own, unknown as its place.
Source: Agarwal et al. 2010, Bundle adjustment in the large.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import SurveyError
from fleetmap.geometry import AnyArray, Array, so3_exp
from mapserver.survey.bundle.reduced_system import ReducedSystem, build_chains, solve_dense, solve_sparse
from mapserver.survey.bundle.schur_kernels import ObservationTable, invert_landmarks
from mapserver.survey.bundle.settings import BundleSettings
from mapserver.survey.bundle.sparsity import Structure, block_pattern
from support.problems import bal_kernels
from support.problems.bal_kernels import CAMERA_UNKNOWNS

_LAMBDA_MIN, _LAMBDA_MAX = 1e-12, 1e12
_FLOOR = 1e-12


@dataclass(frozen=True)
class BalState:
    """rotations (C, 3, 3) and shifts_m (C, 3): camera from map; lenses (C, 3): focal_px, k1, k2; points_map (N, 3)."""

    rotations: Array
    shifts_m: Array
    lenses: Array
    points_map: Array

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """As the kernels take them."""
        return self.rotations, self.shifts_m, self.lenses, self.points_map


@dataclass(frozen=True)
class BalProblem:
    """A start and M observations, sorted by landmark: cameras, landmarks (M,), pixels (M, 2) from the image's middle."""

    start: BalState
    cameras: NDArray[np.int32]
    landmarks: NDArray[np.int32]
    pixels: Array


@dataclass(frozen=True)
class BalResult:
    """costs: half the sum of squares at the start and after every accepted step."""

    state: BalState
    costs: list[float]


def parse_bal(text: str) -> BalProblem:
    """The problem in a BAL file; SurveyError where its counts and its numbers do not fit."""
    try:
        numbers = np.array(text.split(), np.float64)
    except ValueError as error:
        raise SurveyError(f"BAL: {error}; the file should hold numbers alone, starting with three counts") from error
    if len(numbers) < 3 or not np.isfinite(numbers).all():
        raise SurveyError(f"BAL: {len(numbers)} numbers, or some not finite; expected three counts and what they count")
    cameras, points, observations = (int(value) for value in numbers[:3])
    wanted = 3 + 4 * observations + CAMERA_UNKNOWNS * cameras + 3 * points
    if min(cameras, points, observations) < 1 or len(numbers) != wanted:
        raise SurveyError(
            f"BAL: {cameras} cameras, {points} points and {observations} observations make {wanted} numbers, the file "
            f"has {len(numbers)}; fetch it again"
        )
    rows = numbers[3 : 3 + 4 * observations].reshape(-1, 4)
    placed = numbers[3 + 4 * observations : len(numbers) - 3 * points].reshape(-1, CAMERA_UNKNOWNS)
    if (rows[:, :2] < 0).any() or rows[:, 0].max() >= cameras or rows[:, 1].max() >= points:
        raise SurveyError(f"BAL: an observation names a camera or point beyond {cameras} and {points}; fetch it again")
    rows = rows[np.argsort(rows[:, 1], kind="stable")]
    rotations = np.array([so3_exp(rotvec) for rotvec in placed[:, :3]])
    points_map = numbers[len(numbers) - 3 * points :].reshape(-1, 3).copy()
    start = BalState(rotations, placed[:, 3:6].copy(), placed[:, 6:].copy(), points_map)
    return BalProblem(start, rows[:, 0].astype(np.int32), rows[:, 1].astype(np.int32), rows[:, 2:].copy())


def optimize_bal(problem: BalProblem, settings: BundleSettings) -> BalResult:
    """The optimum near the start by Levenberg-Marquardt; of `settings` the limits, tolerance and dense_unknowns count."""
    structure, landmark_ptr = _structure(problem)
    state, damping = problem.start, settings.lambda_start
    costs = [_cost(problem, state)]
    for _ in range(settings.max_iterations):
        normal = _Normal(problem, state)
        while True:
            candidate = normal.step(structure, landmark_ptr, damping, settings)
            cost = np.inf if candidate is None else _cost(problem, candidate)
            if candidate is not None and cost <= costs[-1]:
                break
            damping *= 10.0
            if damping > _LAMBDA_MAX:
                return BalResult(state, costs)
        state, damping = candidate, max(damping * 0.1, _LAMBDA_MIN)
        costs.append(cost)
        if costs[-2] - cost <= settings.relative_cost_tolerance * cost:
            break
    return BalResult(state, costs)


def _cost(problem: BalProblem, state: BalState) -> float:
    return bal_kernels.evaluate(*state.arrays, problem.cameras, problem.landmarks, problem.pixels)


class _Normal:
    """Normal equations at one state."""

    def __init__(self, problem: BalProblem, state: BalState) -> None:
        self._problem, self._state = problem, state
        cameras, points = len(state.rotations), len(state.points_map)
        self._point_info, self._point_rhs = np.zeros((points, 6)), np.zeros((points, 3))
        self._camera_info = np.zeros((cameras, CAMERA_UNKNOWNS, CAMERA_UNKNOWNS))
        self._camera_rhs = np.zeros((cameras, CAMERA_UNKNOWNS))
        self._couplings = np.empty((len(problem.cameras), CAMERA_UNKNOWNS, 3))
        normal = self._point_info, self._point_rhs, self._camera_info, self._camera_rhs, self._couplings
        bal_kernels.linearise(*state.arrays, problem.cameras, problem.landmarks, problem.pixels, *normal)

    def step(
        self, structure: Structure, landmark_ptr: AnyArray, damping: float, settings: BundleSettings
    ) -> BalState | None:
        """The state after one damped step, None where the system could not be solved."""
        problem, state = self._problem, self._state
        blocks, rhs = np.zeros((len(structure.cols), CAMERA_UNKNOWNS, CAMERA_UNKNOWNS)), self._camera_rhs.copy()
        blocks[structure.row_ptr[1:] - 1] = self._camera_info
        diagonal = np.einsum("caa->ca", self._camera_info)
        inverse = np.zeros_like(self._point_info)
        invert_landmarks(self._point_info, damping, inverse)
        landmarks, pattern = (self._couplings, inverse, self._point_rhs), (structure.row_ptr, structure.cols)
        bal_kernels.reduce_to_cameras(problem.cameras, landmark_ptr, *landmarks, *pattern, blocks, rhs)
        chains = build_chains(np.zeros((0, 2), np.int64), len(rhs))
        system = ReducedSystem(structure, chains, blocks, np.zeros((0, 30, 30)), damping * diagonal + _FLOOR, rhs)
        moves = solve_dense(system) if rhs.size <= settings.dense_unknowns else solve_sparse(system)
        if moves is None:
            return None
        moved = BalState(*(np.empty_like(a) for a in state.arrays))
        bal_kernels.step(*state.arrays, problem.cameras, problem.landmarks, *landmarks, moves, *moved.arrays)
        return moved


def _structure(problem: BalProblem) -> tuple[Structure, AnyArray]:
    """The pattern of the cameras' system, and where each landmark's observations begin."""
    cameras, count = problem.cameras, len(problem.start.rotations)
    landmark_ptr = np.searchsorted(problem.landmarks, np.arange(len(problem.start.points_map) + 1))
    slots = np.arange(count, dtype=np.int32)
    slot_obs = np.argsort(cameras, kind="stable").astype(np.int32)
    slot_ptr = np.searchsorted(cameras[slot_obs], np.arange(count + 1))
    table = ObservationTable(slot_ptr, slot_obs, problem.landmarks, cameras, landmark_ptr, slots)
    row_ptr, cols = block_pattern(table, np.zeros(count + 1, np.int64), np.zeros(0, np.int32))
    structure = Structure(
        order=np.arange(len(cameras)),
        table=table,
        pixels=problem.pixels,
        weights=np.ones((len(cameras), 2)),
        slots=slots,
        slot_keyframes=slots,
        free=np.ones((count, CAMERA_UNKNOWNS), np.bool_),
        row_ptr=row_ptr,
        cols=cols,
    )
    return structure, landmark_ptr
