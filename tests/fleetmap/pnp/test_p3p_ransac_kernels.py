"""A camera from three points against the truth and numpy's roots, and the search among wrong matches."""

import numpy as np
import pytest

from fleetmap.geometry import Array, se3_exp, se3_inverse, se3_log, transform_points
from fleetmap.pnp.p3p_ransac_kernels import real_roots, search, three_point, votes

CAMERA = np.array([400.0, 320.0, 240.0, 48.0])


def test_the_roots_are_numpys() -> None:
    rng, roots, compared = np.random.default_rng(1), np.empty(4), 0
    for _ in range(500):
        coefficients = rng.normal(size=5) * 10.0 ** rng.uniform(-2, 2, 5)
        found = np.sort(roots[: real_roots(*coefficients, roots)])
        exact = np.roots(coefficients)
        expected = np.sort(exact[np.abs(exact.imag) < 1e-9 * (1 + np.abs(exact))].real)
        if len(expected) and np.min(np.diff(expected, prepend=-np.inf)) < 1e-3 * np.abs(expected).max():
            continue  # nearly double: one rounding has them, the other does not
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-8)
        compared += len(expected)
    assert compared > 400


def test_roots_of_a_biquadratic_and_of_no_quartic() -> None:
    roots = np.empty(4)
    assert real_roots(1.0, 0.0, -5.0, 0.0, 4.0, roots) == 4
    np.testing.assert_allclose(np.sort(roots), [-2, -1, 1, 2])
    assert real_roots(1.0, 0.0, 5.0, 0.0, 4.0, roots) == 0
    assert real_roots(0.0, 1.0, -5.0, 0.0, 4.0, roots) == 0


def views(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """cam_from_source (4, 4), points_source (N, 3), pixels (N, 2)."""
    cam_from_source = se3_exp(np.concatenate([rng.normal(0, 1.2, 3), rng.normal(0, 5, 3)]))
    depth = rng.uniform(1.0, 9.0, count)
    points_cam = np.column_stack([rng.uniform(-0.7, 0.7, (count, 2)) * [1.0, 0.75] * depth[:, None], depth])
    pixels = CAMERA[0] * points_cam[:, :2] / depth[:, None] + CAMERA[1:3]
    return cam_from_source, transform_points(se3_inverse(cam_from_source), points_cam), pixels


def test_the_truth_is_among_the_cameras_that_three_points_allow() -> None:
    rng = np.random.default_rng(2)
    rotations, translations, missed = np.empty((4, 3, 3)), np.empty((4, 3)), 0
    for _ in range(400):
        cam_from_source, points, pixels = views(rng, 3)
        rays = np.column_stack([(pixels - CAMERA[1:3]) / CAMERA[0], np.ones(3)])
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        count = three_point(points, rays, rotations, translations)
        errors = [
            np.abs(rotations[k] - cam_from_source[:3, :3]).max()
            + np.abs(translations[k] - cam_from_source[:3, 3]).max()
            for k in range(count)
        ]
        missed += not errors or min(errors) > 1e-4
        for k in range(count):  # each of them sees the points along the rays
            seen = points @ rotations[k].T + translations[k]
            np.testing.assert_allclose(seen / np.linalg.norm(seen, axis=1)[:, None], rays, atol=1e-5)
    assert missed <= 4


def test_points_in_a_line_propose_nothing() -> None:
    points = np.array([[0.0, 0.0, 3.0], [0.1, 0.1, 3.1], [0.2, 0.2, 3.2]])
    rays = points / np.linalg.norm(points, axis=1)[:, None]
    assert three_point(points, rays, np.empty((4, 3, 3)), np.empty((4, 3))) == 0


@pytest.mark.parametrize("wrong", [0.0, 0.5, 0.75])
def test_the_camera_is_found_among_wrong_matches(wrong: float) -> None:
    rng = np.random.default_rng(3)
    for _ in range(10):
        cam_from_source, points, pixels = views(rng, 80)
        bad = rng.random(80) < wrong
        pixels += 0.5 * rng.normal(size=pixels.shape)
        pixels[bad] = rng.uniform([0, 0], [640, 480], (int(bad.sum()), 2))
        rotation, translation = np.eye(3), np.zeros(3)
        found = search(points, pixels, CAMERA, 3.0, rng.random((800, 3)), 0.999, rotation, translation)
        assert found >= 0.8 * (~bad).sum()
        near = np.eye(4)
        near[:3, :3], near[:3, 3] = rotation, translation
        assert np.linalg.norm(se3_log(near @ se3_inverse(cam_from_source))) < 0.3
        assert votes(rotation, translation, points, pixels, CAMERA, 3.0, 0) == found
        assert votes(rotation, translation, points, pixels, CAMERA, 3.0, found) == 0
