"""The camera resection against OpenCV, numeric derivatives and Monte-Carlo scatter."""

import cv2
import numpy as np
import pytest

from fleetmap import core
from fleetmap.geometry import Array, rotation_angle_rad, se3_exp, se3_inverse, se3_log, transform_points
from fleetmap.pnp.pnp import Correspondences, PnpResult, pnp_with_rotation, ransac_pnp, refine_pnp
from fleetmap.sensors.rectification import StereoCamera

CAMERA = StereoCamera(400.0, 320.0, 240.0, 0.12, 640, 480)
CAM_FROM_MAP = se3_exp(np.array([0.3, -1.2, 0.5, 1.0, -2.0, 0.7]))
SIGMAS_PX = (0.5, 0.3)  # of u and v, of the disparity


def seen(rng: np.random.Generator, count: int, *, noise: float = 0.0) -> tuple[Array, Array, Array]:
    """points_map (N, 3), pixels (N, 3) and sigmas (N, 2) of points in view."""
    depth = rng.uniform(1.5, 8.0, count)
    points_cam = np.column_stack([rng.uniform(-0.7, 0.7, (count, 2)) * [1.0, 0.75] * depth[:, None], depth])
    pixels = CAMERA.pixel_from_point(points_cam)
    disparity = pixels[:, 0] - pixels[:, 2] + noise * SIGMAS_PX[1] * rng.normal(size=count)
    pixels[:, :2] += noise * SIGMAS_PX[0] * rng.normal(size=(count, 2))
    pixels[:, 2] = pixels[:, 0] - disparity
    return transform_points(se3_inverse(CAM_FROM_MAP), points_cam), pixels, np.tile(SIGMAS_PX, (count, 1))


def error(cam_from_map: Array) -> Array:
    return se3_log(CAM_FROM_MAP @ se3_inverse(cam_from_map))


def with_rotation(seen: tuple[Array, Array, Array], rotation: Array, sigma_rad: float = 0.01) -> PnpResult | None:
    matches = Correspondences(CAMERA, *seen)
    return pnp_with_rotation(matches, rotation, threshold_px=8.0, min_inliers=8, rotation_sigma_rad=sigma_rad)


def test_clean_data_gives_the_camera_and_agrees_with_opencv() -> None:
    points, pixels, sigmas = seen(np.random.default_rng(1), 40)
    start = se3_exp(np.array([0.1, -0.1, 0.08, 0.2, -0.3, 0.2])) @ CAM_FROM_MAP
    found = refine_pnp(Correspondences(CAMERA, points, pixels, sigmas), start)
    assert found.inliers.all()
    np.testing.assert_allclose(error(found.cam_from_source), 0, atol=1e-6)
    solved, rotvec, translation = cv2.solvePnP(points, pixels[:, :2].copy(), CAMERA.matrix, np.zeros(4))
    assert solved
    np.testing.assert_allclose(found.cam_from_source[:3, :3], cv2.Rodrigues(rotvec)[0], atol=1e-5)
    np.testing.assert_allclose(found.cam_from_source[:3, 3], translation.ravel(), atol=1e-5)


def test_it_ends_where_the_cost_is_least_and_its_information_is_the_curvature() -> None:
    """By differences of the cost, which is summed up from the residuals."""
    points, pixels, sigmas = seen(np.random.default_rng(3), 12, noise=3.0)
    pixels[3, 2] = np.nan

    def at(cam_from_map: Array, width: float, iterations: int = 0) -> tuple[float, Array, Array]:
        """The cost after so many iterations, the camera and its information."""
        limits = width, 0.0, (iterations, 0)
        found = core.refine_pnp(points, pixels, 1 / sigmas, CAMERA.lens, limits, cam_from_map, None)
        return float(np.sum(0.5 * found[2] * width**2 / (width**2 + found[2]))), found[0], found[1]

    _, best, _ = at(CAM_FROM_MAP, 4.0, 50)
    slope = [at(se3_exp(d) @ best, 4.0)[0] - at(se3_exp(-d) @ best, 4.0)[0] for d in 1e-5 * np.eye(6)]
    beside = at(se3_exp(np.full(6, 1e-3)) @ best, 4.0)[0] - at(best, 4.0)[0]
    np.testing.assert_allclose(slope, 0, atol=1e-4 * beside)
    # on clean pixels and without robust weight the Gauss-Newton Hessian is the cost's own
    pixels[:] = np.where(np.isnan(pixels), np.nan, CAMERA.pixel_from_point(transform_points(CAM_FROM_MAP, points)))
    steps = 1e-5 * np.eye(6)
    cost = {(s, t): [[at(se3_exp(s * a + t * b) @ CAM_FROM_MAP, 1e6)[0] for b in steps] for a in steps]
            for s in (-1, 1) for t in (-1, 1)}  # fmt: skip
    curvature = np.array(cost[1, 1]) - cost[1, -1] - np.array(cost[-1, 1]) + cost[-1, -1]
    hessian = at(CAM_FROM_MAP, 1e6)[2]
    np.testing.assert_allclose(curvature / 4e-10, hessian, rtol=1e-3, atol=1e-4 * np.abs(hessian).max())


def test_covariance_is_the_scatter_of_many_solutions() -> None:
    """Mean normalised error squared per dof of 150 solutions, 900 dof.

    The robust weight of good residuals is 0.75 on average, so the covariance is that much too wide; never too narrow.
    """
    rng = np.random.default_rng(4)
    nees = []
    for _ in range(150):
        points, pixels, sigmas = seen(rng, 40, noise=1.0)
        found = refine_pnp(Correspondences(CAMERA, points, pixels, sigmas), CAM_FROM_MAP)
        off = error(found.cam_from_source)
        nees.append(off @ np.linalg.solve(found.cov_rot_trans, off) / 6)
    assert 0.65 < np.mean(nees) < 1.1


def test_ransac_needs_no_start() -> None:
    rng = np.random.default_rng(6)
    points, pixels, sigmas = seen(rng, 60, noise=1.0)
    points[:24] = rng.permutation(points[:24])
    matches = Correspondences(CAMERA, points, pixels, sigmas)
    found, again = (ransac_pnp(matches, threshold_px=2.0, min_inliers=12, seed=1) for _ in range(2))
    assert found.inliers[24:].mean() > 0.9
    assert np.linalg.norm(error(found.cam_from_source)[3:]) < 0.03
    np.testing.assert_array_equal(again.cam_from_source, found.cam_from_source)


def test_the_truth_is_among_the_cameras_that_three_points_allow() -> None:
    """Three points propose, of which one try takes any, and the fourth chooses; nothing is refined."""
    rng, missed = np.random.default_rng(2), 0
    for _ in range(400):
        cam_from_map = se3_exp(np.concatenate([rng.normal(0, 1.2, 3), rng.normal(0, 5, 3)]))
        points_cam = transform_points(CAM_FROM_MAP, seen(rng, 4)[0])
        points, pixels = transform_points(se3_inverse(cam_from_map), points_cam), CAMERA.pixel_from_point(points_cam)
        limits = 4.0, 1e9, (0, 0)
        found = core.ransac_pnp(points, pixels, np.ones((4, 2)), CAMERA.lens, limits, 0.1, 4, rng.random((1, 3)), 0.999)
        missed += found is None or not np.allclose(found[0], cam_from_map, atol=1e-4)
    assert missed <= 4


def test_points_in_a_line_propose_nothing() -> None:
    points = np.array([[0.0, 0.0, 3.0], [0.1, 0.1, 3.1], [0.2, 0.2, 3.2], [0.3, 0.3, 3.3]])
    matches = Correspondences(CAMERA, points, CAMERA.pixel_from_point(points), np.ones((4, 2)))
    assert ransac_pnp(matches, threshold_px=2.0, min_inliers=0, seed=1) is None


@pytest.mark.parametrize("line", [[[0.4, 0.1, 3.0]] * 2, [[0.0, 0.0, 3.0], [0.1, 0.1, 3.1], [0.3, 0.3, 3.3]]])
def test_points_about_which_the_camera_may_turn_are_no_pose(line: list[list[float]]) -> None:
    """Two points or three in a line, with depth: a turn about them is not seen. A point beside them decides it."""
    points = np.array([*line, [-0.3, 0.2, 2.5]])
    points[1] += [0.1, 0.0, 0.0] if len(line) == 2 else 0.0
    matches = Correspondences(CAMERA, points, CAMERA.pixel_from_point(points), np.tile(SIGMAS_PX, (len(points), 1)))
    start = se3_exp(np.full(6, 0.01))
    assert refine_pnp(matches.take(np.arange(len(line))), start) is None
    found = refine_pnp(matches, start)
    np.testing.assert_allclose(found.cam_from_source, np.eye(4), atol=1e-6)


@pytest.mark.parametrize("wrong", [0.0, 0.5, 0.75])
def test_the_camera_is_found_among_wrong_matches(wrong: float) -> None:
    rng = np.random.default_rng(3)
    for k in range(10):
        points, pixels, sigmas = seen(rng, 80, noise=1.0)
        bad = rng.random(80) < wrong
        pixels[bad, :2], pixels[:, 2] = rng.uniform([0, 0], [640, 480], (int(bad.sum()), 2)), np.nan
        matches = Correspondences(CAMERA, points, pixels, sigmas)
        found = ransac_pnp(matches, threshold_px=3.0, min_inliers=12, seed=k)
        assert found.inliers.sum() >= 0.8 * (~bad).sum()
        assert np.linalg.norm(error(found.cam_from_source)) < 0.1


def test_known_rotation_survives_70_percent_outliers() -> None:
    rng = np.random.default_rng(7)
    points, pixels, sigmas = seen(rng, 60, noise=1.0)
    wrong = 42
    pixels[:wrong, 0], pixels[:wrong, 1] = rng.uniform(0, 640, wrong), rng.uniform(0, 480, wrong)
    pixels[:wrong, 2] = pixels[:wrong, 0] - rng.uniform(5, 40, wrong)
    nearly = se3_exp(np.array([0.004, -0.003, 0.005, 0, 0, 0]))[:3, :3] @ CAM_FROM_MAP[:3, :3]
    found = with_rotation((points, pixels, sigmas), nearly)
    assert found.inliers[wrong:].mean() > 0.85
    assert found.inliers[:wrong].mean() < 0.1
    assert np.linalg.norm(error(found.cam_from_source)[3:]) < 0.03
    assert np.linalg.norm(error(found.cam_from_source)[:3]) < 0.004


@pytest.mark.parametrize("sigma_rad", [1e-5, 0.1])
def test_known_rotation_is_held_as_firmly_as_it_says(sigma_rad: float) -> None:
    given = se3_exp(np.array([0.004, 0, 0, 0, 0, 0]))[:3, :3] @ CAM_FROM_MAP[:3, :3]
    found = with_rotation(seen(np.random.default_rng(11), 30), given, sigma_rad)
    turned = rotation_angle_rad(found.cam_from_source[:3, :3] @ given.T)
    assert turned < 0.001 if sigma_rad < 0.01 else turned == pytest.approx(0.004, abs=1e-4)


def test_nothing_that_agrees_gives_nothing() -> None:
    rng = np.random.default_rng(8)
    points, pixels, sigmas = seen(rng, 40)
    points = rng.uniform(-3, 3, points.shape)
    assert ransac_pnp(Correspondences(CAMERA, points, pixels, sigmas), threshold_px=2.0, min_inliers=12, seed=1) is None
    assert with_rotation((points, pixels, sigmas), CAM_FROM_MAP[:3, :3]) is None
    empty = np.zeros((0, 3))
    assert refine_pnp(Correspondences(CAMERA, empty, empty, np.zeros((0, 2))), CAM_FROM_MAP) is None
    behind = transform_points(se3_inverse(CAM_FROM_MAP), np.array([[0.0, 0.0, -2.0]] * 5))
    assert refine_pnp(Correspondences(CAMERA, behind, np.ones((5, 3)), np.ones((5, 2))), CAM_FROM_MAP) is None


@pytest.mark.parametrize("sigma_rad", [1e-4, 10.0])
def test_prior_holds_the_start_as_firmly_as_it_says(sigma_rad: float) -> None:
    points, pixels, sigmas = seen(np.random.default_rng(9), 40)
    start = se3_exp(np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])) @ CAM_FROM_MAP
    prior = np.zeros((6, 6))
    prior[:3, :3] = np.eye(3) / sigma_rad**2
    found = refine_pnp(Correspondences(CAMERA, points, pixels, sigmas), start, prior)
    turned = np.linalg.norm(se3_log(found.cam_from_source @ se3_inverse(start))[:3])
    assert turned < 0.01 if sigma_rad < 1 else turned == pytest.approx(0.02, abs=1e-4)
