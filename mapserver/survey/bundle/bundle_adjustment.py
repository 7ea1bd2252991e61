"""Bundle adjustment: keyframes, landmarks, motion and biases that explain all observations best.

Levenberg-Marquardt on the robust cost; landmarks are eliminated by the Schur complement, what is left is solved in one
piece. Source: Triggs et al. 2000, Bundle adjustment, a modern synthesis; inertial terms after Forster et al. 2017.
"""

import numpy as np

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array
from mapserver.survey.bundle.factors import Normal, State, Terms, pack_terms
from mapserver.survey.bundle.problem import (
    BundleProblem,
    BundleResult,
)
from mapserver.survey.bundle.reduced_system import ReducedSystem, SparseLayout, solve_dense
from mapserver.survey.bundle.reprojection_kernels import (
    ImageNormal,
    Measured,
    evaluate,
    linearise,
    step_landmarks,
    step_poses,
)
from mapserver.survey.bundle.schur_kernels import Eliminated, View, invert_landmarks, reduce_to_poses
from mapserver.survey.bundle.sparsity import Structure, build_structure
from mapserver.survey.settings import BundleSettings

LAMBDA_MIN, LAMBDA_MAX = 1e-10, 1e10
DAMPING_FLOOR = 1e-9


def optimize(problem: BundleProblem, settings: BundleSettings) -> BundleResult:
    """The optimum near the problem's values, which stay untouched.

    Raises SurveyError where no keyframe, prior or gauge holds the map in place, and for values that are not finite. Inertial edges follow
    bias changes to first order; where those are large, preintegrate again at the result's biases and optimise once more.
    """
    bundle = _Bundle(problem, settings)
    damping, converged, iterations = settings.lambda_start, False, 0
    costs = [bundle.cost(bundle.state)]
    if not (np.isfinite(costs[0]) and np.isfinite(bundle.squared).all()):
        raise SurveyError(f"bundle adjustment starts with cost {costs[0]}; {bundle.first_bad()}")
    while iterations < settings.max_iterations and not converged:
        iterations += 1
        bundle.linearise()
        while True:
            candidate = bundle.step(damping)
            cost = np.inf if candidate is None else bundle.cost(candidate)
            if candidate is not None and cost <= costs[-1]:
                break
            damping *= 10.0
            if damping > LAMBDA_MAX:  # not even the smallest step lowers the cost
                return bundle.result(costs, iterations, candidate is not None)
        bundle.accept(candidate)
        damping = max(damping * 0.1, LAMBDA_MIN)
        converged = costs[-1] - cost <= settings.relative_cost_tolerance * cost
        costs.append(cost)
    return bundle.result(costs, iterations, converged)


class _Bundle:
    """One problem in arrays, its current state and its normal equations."""

    def __init__(self, problem: BundleProblem, settings: BundleSettings) -> None:
        self.problem, self.settings = problem, settings
        self.structure: Structure = build_structure(problem)
        self.terms: Terms = pack_terms(problem)
        camera = problem.camera
        self.lens = camera.lens
        cam_from_body = problem.body_from_cam[:3, :3].T
        self.cam_from_body = np.ascontiguousarray(cam_from_body)
        self.body_in_cam_m = np.ascontiguousarray(-cam_from_body @ problem.body_from_cam[:3, 3])
        self.state = _initial_state(problem)
        s, points = self.structure, len(problem.points_map)
        self.edge_slots = s.slots[self.terms.ends].astype(np.int64)
        self.layout: SparseLayout | None = None  # what fills in is the same for all systems of the problem
        self.squared, self.measured = np.zeros(len(s.order)), Measured(s.pixels, s.weights)
        self.robust = settings.huber_sigmas, settings.cutoff_sigmas
        shapes = (len(s.order), 6), (points, 6), (points, 3), (len(s.free), 6, 6), (len(s.free), 6)
        self.images = ImageNormal(*(np.zeros(shape) for shape in shapes))
        self.eliminated = Eliminated(self.images.obs_info, np.zeros((points, 6)), self.images.point_rhs)
        self.normal: Normal
        self.spare = self.state.like()

    def _view(self, state: State) -> View:
        cam_from_map = np.ascontiguousarray(self.cam_from_body @ state.rotations.transpose(0, 2, 1))
        return View(self.lens, cam_from_map, state.positions_m, self.body_in_cam_m, state.points_map)

    def cost(self, state: State) -> float:
        """Half the robust sum of squares of everything."""
        images = evaluate(self._view(state), self.structure.table, self.measured, self.robust, self.squared)
        return images + self.terms.linearise(state).cost

    def first_bad(self) -> str:
        """Which observation is not finite, in words."""
        bad = self.structure.order[~np.isfinite(self.squared)]
        if len(bad) == 0:
            return "a prior, relative or inertial term is not finite, look at its values and covariance"
        n, problem = int(bad.min()), self.problem
        landmark = problem.obs_landmark[n]
        return (
            f"observation {n} of {len(self.squared)}: pixels {problem.obs_pixels[n]}, sigma {problem.obs_sigma_px[n]}, "
            f"landmark {landmark} at {problem.points_map[landmark]}; leave it out"
        )

    def linearise(self) -> None:
        """Normal equations at the current state."""
        self.images.pose_info[:], self.images.pose_rhs[:] = 0.0, 0.0
        linearise(self._view(self.state), self.structure.table, self.measured, self.robust, self.images)
        self.normal = self.terms.linearise(self.state)

    def reduced(self, damping: float) -> ReducedSystem:
        """The system over the keyframes after eliminating the landmarks, damped by `damping` times its diagonal."""
        s, images, normal = self.structure, self.images, self.normal
        count, size = s.free.shape
        blocks, rhs, diagonal = np.zeros((len(s.cols), 6, 6)), np.zeros((count, size)), np.zeros((count, size))
        blocks[s.row_ptr[1:] - 1] = images.pose_info
        rhs[:, :6] = images.pose_rhs
        diagonal[:, :6] = np.einsum("paa->pa", images.pose_info)
        self._add_terms(blocks, rhs, diagonal)
        damp = damping * diagonal + DAMPING_FLOOR
        if size > 6:
            damp[:, 6:] += normal.motion_diagonal[s.slot_keyframes]
        if not self.problem.points_held:  # else their inverses are zero, and so are their steps
            invert_landmarks(images.point_info, damping, self.eliminated.inverse)
            view, pattern = self._view(self.state), (s.slot_keyframes, s.row_ptr, s.cols)
            reduce_to_poses(view, s.table, self.eliminated, pattern, blocks, rhs)
        rhs[~s.free] = 0.0
        return ReducedSystem(s, self.edge_slots, blocks, normal.edge_blocks, damp, rhs)

    def _add_terms(self, blocks: Array, rhs: Array, diagonal: Array) -> None:
        s, normal = self.structure, self.normal

        def add(k: int, block: Array, pull: Array) -> None:
            slot = int(s.slots[k])
            if slot >= 0:
                blocks[s.row_ptr[slot + 1] - 1] += block
                rhs[slot, :6] += pull
                diagonal[slot, :6] += np.diag(block)

        for n, prior in enumerate(self.terms.priors):
            add(prior.k, normal.prior_blocks[n], normal.prior_rhs[n])
        for n, term in enumerate(self.terms.relative):
            whole, pull = normal.relative_blocks[n], normal.relative_rhs[n]
            add(term.i, whole[:6, :6], pull[:6])
            add(term.j, whole[6:, 6:], pull[6:])
            p, q = int(s.slots[term.i]), int(s.slots[term.j])
            if p >= 0 and q >= 0:
                blocks[s.block_of(max(p, q), min(p, q))] += whole[6:, :6] if q > p else whole[:6, 6:]
        if rhs.shape[1] > 6:
            self._add_motion(rhs, diagonal)

    def _add_motion(self, rhs: Array, diagonal: Array) -> None:
        s, normal = self.structure, self.normal
        for side in range(2):
            slots, part = self.edge_slots[:, side], slice(15 * side, 15 * side + 15)
            here = slots >= 0
            np.add.at(rhs, slots[here], normal.edge_rhs[here, part])
            np.add.at(diagonal, slots[here], np.einsum("eaa->ea", normal.edge_blocks[here, part, part]))
        rhs[:, 6:] += normal.motion_rhs[s.slot_keyframes]
        diagonal[:, 6:] += normal.motion_diagonal[s.slot_keyframes]

    def step(self, damping: float) -> State | None:
        """The state after one damped step, None where the system could not be solved."""
        s, state, moved = self.structure, self.state, self.spare
        step = self._solved(self.reduced(damping))
        if step is None:
            return None
        step_landmarks(self._view(state), s.table, self.eliminated, step, moved.points_map)
        step_poses(state.rotations, state.positions_m, s.slots, step, moved.rotations, moved.positions_m)
        moved.motions[:] = state.motions
        moved.motions[s.slot_keyframes] += step[:, 6:]
        return moved

    def _solved(self, system: ReducedSystem) -> Array | None:
        if system.rhs.size <= self.settings.dense_unknowns:
            return solve_dense(system)
        self.layout = self.layout or SparseLayout.of(system)
        return self.layout.solve(system)

    def accept(self, candidate: State) -> None:
        """Makes `candidate` the current state."""
        self.state, self.spare = candidate, self.state

    def result(self, costs: list[float], iterations: int, converged: bool) -> BundleResult:
        """The current state as an answer."""
        self.cost(self.state)
        state, inertial = self.state, self.problem.inertial is not None
        map_from_body = np.tile(np.eye(4), (len(state.rotations), 1, 1))
        map_from_body[:, :3, :3], map_from_body[:, :3, 3] = state.rotations, state.positions_m
        squared = np.empty_like(self.squared)
        squared[self.structure.order] = self.squared
        return BundleResult(
            map_from_body=map_from_body,
            points_map=state.points_map.copy(),
            velocities_map_mps=state.motions[:, :3].copy() if inertial else None,
            gyro_bias_radps=state.motions[:, 3:6].copy() if inertial else None,
            accel_bias_mps2=state.motions[:, 6:9].copy() if inertial else None,
            costs=costs,
            squared_sigmas=squared,
            iterations=iterations,
            converged=converged,
        )


def _initial_state(problem: BundleProblem) -> State:
    inertial, count = problem.inertial, len(problem.map_from_body)
    parts: tuple[Array, ...] = ()
    if inertial is not None:
        parts = inertial.velocities_map_mps, inertial.gyro_bias_radps, inertial.accel_bias_mps2
    return State(
        rotations=np.array(problem.map_from_body[:, :3, :3], np.float64, order="C"),
        positions_m=np.array(problem.map_from_body[:, :3, 3], np.float64, order="C"),
        motions=np.concatenate(parts, axis=1, dtype=np.float64) if parts else np.zeros((count, 0)),
        points_map=np.array(problem.points_map, np.float64, order="C"),
    )
