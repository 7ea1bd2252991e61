"""The normal equations of bundle adjustment against numeric derivatives of a second, plain formulation."""

import numpy as np
import pytest

from fleetmap.geometry import Array, se3_exp, se3_inverse
from mapserver.survey.bundle.bundle_adjustment import solver_of
from mapserver.survey.bundle.problem import BundleProblem, MotionPrior
from mapserver.survey.settings import BundleSettings
from mapserver.survey.state import PriorTerm, RelativeTerm
from support.worlds.bundle_scene import ONE, disturbed, make_scene, plain_residuals

NO_ROBUSTNESS = BundleSettings(huber_sigmas=1e9)
FRONT_AND_REAR = np.stack([np.eye(4), se3_exp(np.array([0.01, 0.02, np.pi, -0.4, 0.05, 0.02]))])


def _problem(*, inertial: bool, body_from_others: Array = ONE) -> BundleProblem:
    what = {"inertial": inertial, "body_from_others": body_from_others}
    scene = make_scene(keyframes=5, landmarks=40, step_s=0.4, seed=3, noise_px=1.0, **what)
    problem = disturbed(scene.problem, seed=4, rot_rad=0.01, trans_m=0.05, points_m=0.05)
    rng = np.random.default_rng(7)
    root = rng.normal(size=(6, 6))
    map_from_body = problem.map_from_body
    for i, j in ((1, 4), (3, 0)):
        i_from_j = se3_inverse(map_from_body[i]) @ map_from_body[j] @ se3_exp(rng.normal(size=6) * 0.05)
        problem.relative.append(RelativeTerm(i, j, i_from_j, root @ root.T + np.eye(6)))
    place = map_from_body[2] @ se3_exp(rng.normal(size=6) * 0.05)
    problem.priors.append(PriorTerm(2, place, root.T @ root + np.eye(6)))
    if problem.inertial is not None:
        problem.inertial.motions += rng.normal(size=(5, 9)) * np.repeat([0.1, 0.01, 0.1], 3)
        mean, sigma = rng.normal(size=9) * 0.1, np.array([np.inf] * 3 + [0.01] * 3 + [0.1] * 3)
        problem.inertial.priors.append(MotionPrior(1, mean, sigma))
    return problem


def _numeric(problem: BundleProblem) -> tuple[Array, Array]:
    """Gauss-Newton matrix and right-hand side over [(pose, motion) of each keyframe, points]."""
    count, points = len(problem.map_from_body), len(problem.points_map)
    size = 6 if problem.inertial is None else 15

    def residuals(step: Array) -> Array:
        head = step[: count * size].reshape(count, size)
        motion = head[:, 6:] if size == 15 else np.zeros((count, 9))
        return plain_residuals(problem, head[:, :6], motion, step[count * size :].reshape(points, 3))

    unknowns = count * size + 3 * points
    jacobian = np.empty((len(residuals(np.zeros(unknowns))), unknowns))
    for c in range(unknowns):
        nudge = 1e-6 * np.eye(unknowns)[c]
        jacobian[:, c] = (residuals(nudge) - residuals(-nudge)) / 2e-6
    return jacobian.T @ jacobian, -jacobian.T @ residuals(np.zeros(unknowns))


def _eliminated(problem: BundleProblem) -> tuple[Array, Array]:
    """The numeric system over the moving keyframe unknowns, landmarks eliminated."""
    matrix, rhs = _numeric(problem)
    size = 6 if problem.inertial is None else 15
    head = len(problem.map_from_body) * size
    free = np.ones(head, np.bool_)
    for k in np.nonzero(problem.fixed)[0]:
        free[k * size : k * size + 6] = False
    held_first = np.nonzero(free)[0]
    seen = np.isin(np.arange(len(problem.points_map)), problem.obs_landmark)
    tail = head + np.nonzero(np.repeat(seen, 3))[0]
    cross, inner = matrix[np.ix_(held_first, tail)], matrix[np.ix_(tail, tail)]
    return (
        matrix[np.ix_(held_first, held_first)] - cross @ np.linalg.solve(inner, cross.T),
        rhs[held_first] - cross @ np.linalg.solve(inner, rhs[tail]),
    )


@pytest.mark.parametrize("body_from_others", [ONE, FRONT_AND_REAR])
@pytest.mark.parametrize("inertial", [False, True])
def test_reduced_system(inertial: bool, body_from_others: Array) -> None:
    problem = _problem(inertial=inertial, body_from_others=body_from_others)
    matrix, rhs = _eliminated(problem)
    lower, ours_rhs = solver_of(problem, NO_ROBUSTNESS).reduced(0.0)
    moves = np.ones((len(problem.fixed), 15 if inertial else 6), np.bool_)
    moves[problem.fixed, :6] = False
    free = moves[moves.any(axis=1)].ravel()  # keyframes of which nothing moves are not in the reduced system
    ours = (np.tril(lower) + np.tril(lower, -1).T)[np.ix_(free, free)]
    scale = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
    np.testing.assert_allclose(ours / scale, matrix / scale, atol=2e-5)
    np.testing.assert_allclose(ours_rhs[free], rhs, atol=2e-5 * np.abs(rhs).max())
