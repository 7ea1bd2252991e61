"""The fix of a frame in a map, against numeric derivatives of the pixels."""

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array, se3_exp, se3_inverse, so3_log, transform_points
from fleetmap.pnp.pnp import REFINEMENT
from fleetmap.relocalization.settings import FixSettings
from fleetmap.sensors.rectification import StereoCamera

Rows = NDArray[np.int64]
Features = tuple[Array, Array, NDArray[np.int8], NDArray[np.uint64]]
CAMERA = StereoCamera(420.0, 319.5, 239.5, 0.12, 640, 480)
COUNT, OCTAVE_SCALE, STEP = 120, 1.2, 1e-6
TRUTH = se3_exp(np.array([0.4, -1.1, 0.6, 2.0, -3.0, 1.0]))


def finder_of(points_cam: Array, octaves: Rows, sigma_m: float) -> tuple[core.FixFinder, NDArray[np.uint64]]:
    """Of landmarks that one place shows; their descriptors."""
    count, distances = len(points_cam), np.linalg.norm(points_cam, axis=1)
    points_map = transform_points(TRUTH, points_cam)
    seen_from = ((TRUTH[:3, 3] - points_map) / distances[:, None]).astype(np.float32)
    reach = (distances * OCTAVE_SCALE**octaves).astype(np.float32)
    descriptors = np.random.default_rng(5).integers(0, 2**63, (count, 4)).astype(np.uint64)
    finder = core.FixFinder(
        *((points_map, seen_from, np.full(count, 0.3, np.float32), reach), np.full(count, sigma_m, np.float32), descriptors),
        *(TRUTH[None], np.arange(count), np.array([0, count]), np.array([*CAMERA.lens, 640.0, 480.0]), 1.0, OCTAVE_SCALE),
        *(FixSettings(), StereoSettings(), 0.35, REFINEMENT),
    )  # fmt: skip
    return finder, descriptors


def test_a_fix_is_the_robust_minimum_and_its_covariance_that_of_the_minimum() -> None:
    """Some features are without depth, some show their landmark pixels away."""
    rng, settings = np.random.default_rng(6), FixSettings()
    points_cam = np.column_stack([rng.uniform([-0.7, -0.5], [0.7, 0.5], (COUNT, 2)), np.ones(COUNT)])
    points_cam *= rng.uniform(1.5, 8.0, (COUNT, 1))
    octaves = rng.integers(0, 4, COUNT)
    finder, descriptors = finder_of(points_cam, octaves, 0.01)
    pixels = CAMERA.pixel_from_point(points_cam)
    pixels[:, 2] += settings.disparity_sigma_px * rng.normal(size=COUNT)
    pixels += settings.feature_sigma_px * OCTAVE_SCALE ** octaves[:, None] * rng.normal(size=(COUNT, 2))[:, [0, 1, 0]]
    pixels[::5, 2], pixels[::8, 1] = np.nan, pixels[::8, 1] + 9.0
    features = pixels, pixels[:, :2].copy(), octaves.astype(np.int8), descriptors
    guess = TRUTH @ se3_exp(np.array([0.01, -0.01, 0.01, 0.04, 0.03, -0.04]))
    found = finder.by_projection(features, None, guess, 30.0)
    map_from_cam, covariance, _, landmarks, seen, rows = found[:6]
    inliers, (points, measured, sigmas), covisible, is_found, is_passed = found[6:]
    assert landmarks == inliers.sum()
    np.testing.assert_array_equal(seen, rows)
    assert inliers.mean() > 0.8
    assert not inliers[rows % 8 == 0].any()
    assert is_passed
    np.testing.assert_array_equal(np.sort(covisible[is_found]), np.sort(rows[inliers]))
    points, measured, sigmas = points[inliers], measured[inliers], sigmas[inliers]

    def placed(step: Array) -> Array:
        return se3_inverse(se3_exp(step) @ se3_inverse(map_from_cam))

    def residuals(step: Array) -> Array:
        """(P, 3) of u, v and disparity, in sigmas."""
        off = CAMERA.pixel_from_point(transform_points(se3_inverse(placed(step)), points)) - measured
        off[:, 2] = np.nan_to_num(off[:, 0] - off[:, 2])
        return np.asarray(off / sigmas[:, [0, 0, 1]])

    def errors(step: Array) -> Array:
        """Rotation in map axes, and position."""
        there = placed(step)
        return np.concatenate([so3_log(there[:3, :3] @ map_from_cam[:3, :3].T), there[:3, 3] - map_from_cam[:3, 3]])

    by_step, moved = (
        np.stack([(of(step) - of(-step)) / (2 * STEP) for step in STEP * np.eye(6)], axis=-1)
        for of in (residuals, errors)
    )
    left, width = residuals(np.zeros(6)), REFINEMENT[0]
    # of Geman and McClure's cost w^2 e^2 / (w^2 + e^2) / 2
    weights = (width**2 / (width**2 + (left**2).sum(axis=1))) ** 2
    information = np.einsum("p,pri,prj->ij", weights, by_step, by_step)
    step = np.linalg.solve(information, np.einsum("p,pri,pr->i", weights, by_step, left))
    assert step @ information @ step < 1e-4
    floors = np.repeat([settings.floor_rad, settings.floor_m], 3) ** 2
    expected = settings.covariance_scale * moved @ np.linalg.inv(information) @ moved.T + np.diag(floors)
    off = np.concatenate([so3_log(TRUTH[:3, :3] @ map_from_cam[:3, :3].T), TRUTH[:3, 3] - map_from_cam[:3, 3]])
    np.testing.assert_allclose(covariance, expected, rtol=1e-4, atol=1e-4 * floors.min())
    assert off @ np.linalg.solve(covariance, off) < 22.0


@pytest.mark.parametrize("sigma_m", [0.0, 0.02])
def test_frames_that_show_too_little_each_are_one_camera_together(sigma_m: float) -> None:
    """Ten landmarks in each of three frames; the same ten in all of them are as few as in one."""
    rng, settings = np.random.default_rng(7), FixSettings()
    cameras = [se3_exp(np.array([0.0, 0.02 * k, 0.0, 0.05 * k, 0.0, 0.3 * k])) for k in range(3)]  # from the first
    first = np.column_stack([rng.uniform([-0.5, -0.4], [0.5, 0.4], (30, 2)), np.ones(30)]) * rng.uniform(3, 8, (30, 1))
    finder, descriptors = finder_of(first, np.zeros(30, np.int64), 0.0)

    def shown(k: int, rows: Rows) -> Features:
        pixels = CAMERA.pixel_from_point(transform_points(cameras[k], first[rows]))
        pixels += rng.normal(0.0, 0.1, pixels.shape)
        return pixels, pixels[:, :2].copy(), np.zeros(len(rows), np.int8), descriptors[rows]

    frames = [shown(k, np.arange(10 * k, 10 * k + 10)) for k in range(3)]
    guess = TRUTH @ se3_exp(np.array([0.004, -0.004, 0.004, 0.02, 0.02, -0.02]))
    for k, frame in enumerate(frames):
        assert finder.by_projection(frame, None, guess @ se3_inverse(cameras[k]), 30.0) is None
    earlier = [(frames[k], None, cameras[k], 0.0, sigma_m) for k in (1, 2)]
    found = finder.by_projection(frames[0], None, guess, 30.0, earlier)
    map_from_cam, covariance, _, landmarks, *_ = found
    assert landmarks == 30
    assert np.linalg.norm(map_from_cam[:3, 3] - TRUTH[:3, 3]) < 0.01
    assert np.sqrt(np.linalg.eigvalsh(covariance)[-1]) > max(settings.floor_m, sigma_m)
    same = [(shown(k, np.arange(10)), None, cameras[k], 0.0, sigma_m) for k in (1, 2)]
    assert finder.by_projection(frames[0], None, guess, 30.0, same) is None


def test_more_frames_than_a_query_pools_are_refused() -> None:
    finder, descriptors = finder_of(np.zeros((0, 3)), np.zeros(0, np.int64), 0.0)
    frame = np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0, np.int8), descriptors
    with pytest.raises(ValueError, match="at most 16 frames"):
        finder.by_projection(frame, None, np.eye(4), 9.0, [(frame, None, np.eye(4), 0.0, 0.0)] * 17)
