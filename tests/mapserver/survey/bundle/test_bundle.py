"""Bundle adjustment of images, relative poses and priors: truth recovered, gtsam agreed with, bad input survived."""

from dataclasses import replace
from typing import Literal

import gtsam
import numpy as np
import pytest

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, se3_exp, se3_inverse
from mapserver.survey.bundle.bundle_adjustment import optimize
from mapserver.survey.bundle.problem import BundleProblem, BundleResult
from mapserver.survey.settings import BundleSettings
from mapserver.survey.state import PriorTerm, RelativeTerm
from support.worlds.bundle_gtsam import gtsam_graph
from support.worlds.bundle_scene import BODY_FROM_CAM, CAMERA, disturbed, make_scene

PRECISE = BundleSettings(max_iterations=60, relative_cost_tolerance=1e-13)


def _off(result: BundleResult, problem: BundleProblem) -> Array:
    return np.linalg.norm(result.map_from_body[:, :3, 3] - problem.map_from_body[:, :3, 3], axis=1)


@pytest.mark.parametrize("dense_unknowns", [1500, 0])
def test_recovers_the_truth(dense_unknowns: int) -> None:
    truth = make_scene(keyframes=8, landmarks=150, step_s=0.4, seed=1).problem
    start = disturbed(truth, seed=2, rot_rad=0.03, trans_m=0.1, points_m=0.1)
    settings = BundleSettings(max_iterations=30, relative_cost_tolerance=1e-12, dense_unknowns=dense_unknowns)
    result = optimize(start, settings)
    assert (np.diff(result.costs) <= 0).all()
    np.testing.assert_allclose(result.map_from_body, truth.map_from_body, atol=1e-6)
    seen = np.isin(np.arange(len(truth.points_map)), truth.obs_landmark)
    np.testing.assert_allclose(result.points_map[seen], truth.points_map[seen], atol=1e-5)
    np.testing.assert_array_equal(result.points_map[~seen], start.points_map[~seen])
    assert result.squared_sigmas.max() < 1e-6
    assert result.motions is None


def test_leaves_the_problem_untouched_and_repeats_itself() -> None:
    truth = make_scene(keyframes=5, landmarks=80, step_s=0.4, seed=1).problem
    start = disturbed(truth, seed=2, rot_rad=0.02, trans_m=0.1, points_m=0.1)
    before = start.map_from_body.copy(), start.points_map.copy()
    first, second = optimize(start, BundleSettings()), optimize(start, BundleSettings())
    np.testing.assert_array_equal(start.map_from_body, before[0])
    np.testing.assert_array_equal(start.points_map, before[1])
    np.testing.assert_array_equal(first.map_from_body, second.map_from_body)
    np.testing.assert_array_equal(first.map_from_body[0], start.map_from_body[0])


@pytest.mark.parametrize("huber", [1e6, 1.5])
def test_same_optimum_as_gtsam(huber: float) -> None:
    truth = make_scene(keyframes=6, landmarks=100, step_s=0.4, seed=5, noise_px=1.0).problem
    start = disturbed(truth, seed=6, rot_rad=0.02, trans_m=0.05, points_m=0.1)
    if huber < 10:
        wild = np.random.default_rng(8).random(len(start.obs_pixels)) < 0.03
        start.obs_pixels[wild] += 15.0
    patient = BundleSettings(max_iterations=200, relative_cost_tolerance=1e-12, huber_sigmas=huber)
    ours = optimize(start, patient)
    graph, values = gtsam_graph(start, huber)
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-14)
    params.setAbsoluteErrorTol(1e-14)
    params.setMaxIterations(200)
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    assert ours.costs[0] == pytest.approx(graph.error(values), rel=1e-9)
    assert ours.costs[-1] == pytest.approx(graph.error(optimum), rel=1e-7)
    for k in range(6):
        np.testing.assert_allclose(ours.map_from_body[k], optimum.atPose3(gtsam.symbol("x", k)).matrix(), atol=1e-4)


def test_wild_observations_under_huber_and_cutoff() -> None:
    truth = make_scene(keyframes=8, landmarks=800, step_s=0.4, seed=9, noise_px=1.0).problem
    start = disturbed(truth, seed=2, rot_rad=0.02, trans_m=0.05, points_m=0.05)
    clean = _off(optimize(start, BundleSettings(max_iterations=40)), truth).max()
    wild = np.random.default_rng(3).random(len(start.obs_pixels)) < 0.1
    start.obs_pixels[wild, :2] += np.random.default_rng(4).normal(size=(int(wild.sum()), 2)) * 40
    square = _off(optimize(start, BundleSettings(max_iterations=40, huber_sigmas=1e6)), truth).max()
    first = optimize(start, BundleSettings(max_iterations=40))
    again = replace(start, map_from_body=first.map_from_body, points_map=first.points_map)
    second = optimize(again, BundleSettings(max_iterations=40, cutoff_sigmas=6.0))
    assert _off(first, truth).max() < 0.3 * square
    assert _off(second, truth).max() < 2.0 * clean
    told = second.squared_sigmas > 36.0
    assert (told & wild).sum() > 0.8 * wild.sum()
    spoilt = np.isin(start.obs_landmark, start.obs_landmark[wild])  # two views of a point cannot tell which one lies
    assert not (told & ~spoilt).any()


def test_points_behind_and_hardly_seen_points_do_no_harm() -> None:
    truth = make_scene(keyframes=6, landmarks=120, step_s=0.4, seed=11).problem
    start = disturbed(truth, seed=2, rot_rad=0.01, trans_m=0.05, points_m=0.05)
    count = len(start.points_map)
    behind = (start.map_from_body[1] @ BODY_FROM_CAM @ np.array([0.1, 0.1, -4.0, 1]))[:3]
    once = (start.map_from_body[2] @ BODY_FROM_CAM @ np.array([0.3, 0.1, 4.0, 1]))[:3]
    extra_points = np.array([behind, once])
    pixel = CAMERA.pixel_from_point(np.array([[0.3, 0.1, 4.0]]))[0] + 3.0
    problem = replace(
        start,
        points_map=np.concatenate([start.points_map, extra_points]),
        obs_keyframe=np.concatenate([start.obs_keyframe, [1, 2]]).astype(np.int32),
        obs_camera=np.concatenate([start.obs_camera, [0, 0]]).astype(np.int32),
        obs_landmark=np.concatenate([start.obs_landmark, [count, count + 1]]).astype(np.int32),
        obs_pixels=np.concatenate([start.obs_pixels, [[300.0, 200.0, 290.0], [pixel[0], pixel[1], np.nan]]]),
        obs_sigma_px=np.concatenate([start.obs_sigma_px, np.ones((2, 2))]),
    )
    result = optimize(problem, PRECISE)
    assert np.isfinite(result.points_map).all()
    assert result.squared_sigmas[-2] >= 1e6
    np.testing.assert_allclose(result.points_map[-2], behind)
    assert np.linalg.norm(result.points_map[-1] - once) < 0.5
    assert result.squared_sigmas[-1] < 1e-6
    assert _off(result, truth).max() < 1e-4


def test_relative_terms_carry_over_missing_vision() -> None:
    truth = make_scene(keyframes=6, landmarks=120, step_s=0.4, seed=12).problem
    start = disturbed(truth, seed=3, rot_rad=0.02, trans_m=0.1, points_m=0.05)
    blind = start.obs_keyframe != 3
    map_from_body = truth.map_from_body
    steps = {(i, j): se3_inverse(map_from_body[i]) @ map_from_body[j] for i, j in ((2, 3), (4, 3))}
    terms = [RelativeTerm(*pair, i_from_j, 1e4 * np.eye(6)) for pair, i_from_j in steps.items()]
    problem = replace(start.observed(blind), relative=terms)
    np.testing.assert_allclose(optimize(problem, PRECISE).map_from_body, map_from_body, atol=1e-5)


def test_priors_alone_can_hold_the_map() -> None:
    truth = make_scene(keyframes=5, landmarks=100, step_s=0.4, seed=13).problem
    moved_from_map = se3_exp(np.array([0.0, 0, 0.1, 1.0, -0.5, 0.2]))
    priors = [PriorTerm(k, moved_from_map @ truth.map_from_body[k], 1e6 * np.eye(6)) for k in (0, 4)]
    result = optimize(replace(truth, fixed=np.zeros(5, np.bool_), priors=priors), PRECISE)
    np.testing.assert_allclose(result.map_from_body, moved_from_map @ truth.map_from_body, atol=1e-4)


@pytest.mark.parametrize(
    ("gauge", "says"), [("pose", "4 keyframes has none fixed"), ("yaw_position", "needs inertial")]
)
def test_refuses_a_map_that_nothing_holds(gauge: Literal["pose", "yaw_position"], says: str) -> None:
    problem = make_scene(keyframes=4, landmarks=50, step_s=0.4, seed=1).problem
    with pytest.raises(SurveyError, match=says):
        optimize(replace(problem, gauge=gauge, fixed=np.zeros(4, np.bool_)), BundleSettings())


@pytest.mark.parametrize("cutoff", [np.inf, 5.0])
def test_says_which_value_is_not_finite(cutoff: float) -> None:
    problem = make_scene(keyframes=4, landmarks=50, step_s=0.4, seed=1).problem
    problem.obs_pixels[7, 0] = np.nan
    with pytest.raises(SurveyError, match=r"observation 7 of .*nan"):
        optimize(problem, BundleSettings(cutoff_sigmas=cutoff))


def test_points_alone() -> None:
    truth = make_scene(keyframes=5, landmarks=80, step_s=0.4, seed=1).problem
    start = disturbed(truth, seed=2, rot_rad=0.0, trans_m=0.0, points_m=0.1)
    result = optimize(replace(start, map_from_body=truth.map_from_body, fixed=np.ones(5, np.bool_)), PRECISE)
    seen = np.isin(np.arange(80), truth.obs_landmark)
    np.testing.assert_allclose(result.points_map[seen], truth.points_map[seen], atol=1e-5)


def test_nothing_seen_at_all() -> None:
    truth = make_scene(keyframes=3, landmarks=80, step_s=0.4, seed=1).problem
    blind = replace(truth.observed(np.zeros(len(truth.obs_camera), bool)), points_map=np.zeros((0, 3)))
    np.testing.assert_allclose(optimize(blind, BundleSettings()).map_from_body, truth.map_from_body)
