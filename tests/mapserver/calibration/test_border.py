"""The calibration as a border of bundle adjustment, and the redundancy of each kind, against numeric derivatives of all residuals."""

import numpy as np
import pytest
from msgspec import structs

from fleetmap.geometry import Array, so3_exp, so3_log
from fleetsim.recorder import Order
from mapserver.calibration.estimator import SETTINGS, ErrorScales, Problem
from mapserver.calibration.motion_rows import MotionState
from mapserver.calibration.parameters import COLUMNS, UNKNOWNS
from mapserver.survey.bundle.bundle_adjustment import solver_of
from mapserver.survey.settings import BundleSettings
from support.worlds.calibration_scene import make_stretch, measured

ONES = np.ones(3)


class Scene:
    """Residuals of a short stretch with all its kinds, and their derivatives by [pose, motion] of K keyframes, theta, and points."""

    def __init__(self) -> None:
        stretch = make_stretch(Order("small-loop", seed=1), 6.0, 1.0, step_s=0.2, per_frame=10)
        rng = np.random.default_rng(1)
        self.problem = problem = Problem(measured(stretch, stretch.session.true, 1))
        self.theta = np.concatenate([0.001 * rng.normal(size=18) * [p.prior_sigma for p in COLUMNS], np.zeros(10)])
        start = problem.data.start
        self.state = MotionState(
            start.map_from_body, start.motions + 1e-3 * rng.normal(size=start.motions.shape), start.points_map
        )
        problem.slopes = problem.seen.measured_slopes(self.theta)
        problem.prepare(self.state, self.theta, ErrorScales())
        self.head = 15 * len(start.map_from_body)
        self.size = self.head + UNKNOWNS + start.points_map.size
        nudges = 1e-6 * np.eye(self.size)
        self.residuals = self.at(np.zeros(self.size))
        self.jacobian = np.stack([(self.at(nudge) - self.at(-nudge)) / 2e-6 for nudge in nudges], axis=1)

    @property
    def weights(self) -> Array:
        """Roots of the robust weights of the residuals."""
        count = 4 * len(self.problem.data.obs_keyframe)
        norms = np.linalg.norm(self.residuals[:count].reshape(-1, 4), axis=1)
        weights = np.where(norms > SETTINGS.cutoff_sigmas, 0.0, np.minimum(1.0, SETTINGS.huber_sigmas / norms))
        return np.concatenate([np.sqrt(np.repeat(weights, 4)), np.ones(len(self.residuals) - count)])

    def believed(self) -> Array:
        """The derivatives of the residuals, with their weights."""
        return self.weights[:, None] * self.jacobian

    def at(self, step: Array) -> Array:
        """Everything after a step, whitened: rows of images, of the IMU, of the wheels; priors."""
        problem, given = self.problem, self.state
        steps, theta = step[: self.head].reshape(-1, 15), self.theta + step[self.head : self.head + UNKNOWNS]
        map_from_body = given.map_from_body.copy()
        map_from_body[:, :3, :3] = np.array([so3_exp(turn) for turn in steps[:, :3]]) @ map_from_body[:, :3, :3]
        map_from_body[:, :3, 3] += steps[:, 3:6]
        points = given.points_map + step[self.head + UNKNOWNS :].reshape(-1, 3)
        state = MotionState(map_from_body, given.motions + steps[:, 6:], points)
        parts = [problem.rows(map_from_body.copy(), state.motions, points, theta, False).residuals.ravel()]
        parts += [edge.residual(state) for edge in problem.inertial]
        parts += [edge.residual(state, float(theta[17])) for edge in problem.wheels]
        for prior, now in zip(problem.priors, map_from_body, strict=True):
            turn = so3_log(now[:3, :3] @ prior.map_from_body[:3, :3].T)
            parts.append(np.sqrt(np.diag(prior.information)) * [*turn, *(now[:3, 3] - prior.map_from_body[:3, 3])])
        known = problem.bundle(theta, state, ONES).inertial.priors[0]
        parts += [(state.motions[0] - known.mean) / known.sigma, np.sqrt(problem.prior) * theta]
        return np.concatenate(parts)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene()


def test_the_reduced_system_is_the_schur_complement(scene: Scene) -> None:
    whole, pull = scene.jacobian.T @ scene.jacobian, -scene.jacobian.T @ scene.residuals
    cut = scene.head + UNKNOWNS
    share = np.linalg.solve(whole[cut:, cut:], whole[cut:, :cut]).T
    expected, rhs = whole[:cut, :cut] - share @ whole[cut:, :cut], pull[:cut] - share @ pull[cut:]
    bundle = scene.problem.bundle(scene.theta, scene.state, ONES)
    lower, ours = solver_of(bundle, BundleSettings(huber_sigmas=1e9)).reduced(0.0)
    scale = np.sqrt(np.diag(whole)[:cut])
    np.testing.assert_allclose(np.tril(lower - expected) / np.outer(scale, scale), 0.0, atol=3e-4)
    np.testing.assert_allclose(ours / scale, rhs / scale, atol=1e-4 * np.abs(rhs / scale).max())


def test_sparse_and_dense_systems_agree(scene: Scene) -> None:
    bundle = scene.problem.bundle(scene.theta, scene.state, ONES)
    dense, sparse = (solver_of(bundle, structs.replace(SETTINGS, dense_unknowns=most)) for most in (10_000, 0))
    step, other = dense.step(1e-3), sparse.step(1e-3)
    np.testing.assert_allclose(other, step, atol=1e-8 * np.abs(step).max())
    whole = scene.believed()
    np.testing.assert_allclose(dense.log_determinant(), np.linalg.slogdet(whole.T @ whole)[1], rtol=1e-3)
    np.testing.assert_allclose(sparse.log_determinant(), dense.log_determinant(), rtol=1e-8)


def test_squares_and_redundancies_are_those_of_the_hat_matrix(scene: Scene) -> None:
    whole = scene.believed()
    shares = np.einsum("nd,dn->n", whole, np.linalg.solve(whole.T @ whole, whole.T))
    images, edges = 4 * len(scene.problem.data.obs_keyframe), len(scene.problem.inertial)
    kind = np.full(len(whole), -1)
    kind[:images] = np.tile([0, 0, 1, 2], images // 4)
    kind[images : images + 15 * edges] = np.tile(np.repeat([3, 4, -1], [3, 6, 6]), edges)
    kind[images + 15 * edges :][: 3 * len(scene.problem.wheels)] = np.tile([5, -1, -1], len(scene.problem.wheels))
    used = np.abs(whole).sum(axis=1) > 0
    squares, redundancy = scene.problem.variance_components(scene.theta, scene.state, np.zeros(6), range(6))
    left = (scene.weights * scene.residuals) ** 2
    np.testing.assert_allclose(squares, [left[kind == n].sum() for n in range(6)], rtol=1e-9)
    # what keeps landmarks invertible holds the gauge too, by less than one residual
    np.testing.assert_allclose(redundancy, [(used - shares)[kind == n].sum() for n in range(6)], rtol=0.02)


def test_the_information_of_the_calibration_is_what_the_rest_leaves(scene: Scene) -> None:
    whole = scene.believed()
    cov = np.linalg.inv(whole.T @ whole)[scene.head : scene.head + UNKNOWNS, scene.head : scene.head + UNKNOWNS]
    information, scale = scene.problem.calibration_information(scene.theta, scene.state), np.sqrt(np.diag(cov))
    np.testing.assert_allclose((np.linalg.inv(information) - cov) / np.outer(scale, scale), 0.0, atol=3e-3)


def test_a_landmark_behind_the_camera_is_as_far_off_as_can_be(scene: Scene) -> None:
    problem, state = scene.problem, scene.state
    behind = np.where(problem.data.obs_landmark == 0)[0]
    points = state.points_map.copy()
    points[0] += 1e3 * (state.map_from_body[problem.data.obs_keyframe[behind[0]], :3, 3] - points[0])
    rows = problem.rows(state.map_from_body.copy(), state.motions, points, scene.theta, True)
    assert np.linalg.norm(rows.residuals[behind], axis=1).min() > SETTINGS.cutoff_sigmas
    assert not rows.by_point[behind].any()
