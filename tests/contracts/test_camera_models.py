"""What every entry of CAMERA_MODELS must do, measured against OpenCV."""

import cv2
import numpy as np
import pytest

from fleetmap.geometry import Array
from fleetmap.sensors.cameras import CAMERA_MODELS

INTRINSICS = np.array([458.6, 457.3, 367.2, 248.4])
DISTORTIONS = {
    "radial-tangential": [
        np.zeros(0),
        np.array([-0.283, 0.074, 2e-4, 1.8e-5]),
        np.array([-0.1, 0.02, 1e-3, -5e-4, 0.003]),
        np.array([0.42, 0.03, 2e-4, -1e-4, 1e-3, 0.72, 0.14, 4e-3]),
    ],
    "equidistant": [np.array([0.0102, -0.0108, 0.0059, -0.0017])],
}
CASES = [(name, d) for name, ds in DISTORTIONS.items() for d in ds]


def opencv_pixels(model: str, distortion: Array, rays: Array) -> Array:
    matrix = np.array([[INTRINSICS[0], 0, INTRINSICS[2]], [0, INTRINSICS[1], INTRINSICS[3]], [0, 0, 1.0]])
    zero = np.zeros(3)
    if model == "equidistant":
        return cv2.fisheye.projectPoints(rays.reshape(-1, 1, 3), zero, zero, matrix, distortion)[0].reshape(-1, 2)
    return cv2.projectPoints(rays, zero, zero, matrix, distortion if len(distortion) else None)[0].reshape(-1, 2)


def test_every_model_has_a_case() -> None:
    assert set(DISTORTIONS) == set(CAMERA_MODELS)


@pytest.mark.parametrize(("model", "distortion"), CASES)
def test_pixels_are_opencvs(model: str, distortion: Array) -> None:
    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-0.7, 0.7, (200, 2)), np.ones(200)]) * rng.uniform(0.5, 20, (200, 1))
    ours = CAMERA_MODELS[model].pixel_from_ray(INTRINSICS, distortion, rays)
    np.testing.assert_allclose(ours, opencv_pixels(model, distortion, rays), atol=1e-6)


@pytest.mark.parametrize(("model", "distortion"), CASES)
def test_rays_of_pixels_come_back_to_their_pixels(model: str, distortion: Array) -> None:
    u, v = np.meshgrid(np.linspace(0, 751, 31), np.linspace(0, 479, 21))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = CAMERA_MODELS[model].ray_from_pixel(INTRINSICS, distortion, pixels)
    known = np.isfinite(rays).all(axis=1)
    assert known.mean() > 0.99
    np.testing.assert_allclose(np.linalg.norm(rays[known], axis=1), 1.0, atol=1e-12)
    back = CAMERA_MODELS[model].pixel_from_ray(INTRINSICS, distortion, rays[known])
    np.testing.assert_allclose(back, pixels[known], atol=1e-4)


@pytest.mark.parametrize(("model", "distortion"), CASES)
def test_the_direction_straight_back_has_no_pixel(model: str, distortion: Array) -> None:
    assert np.isnan(CAMERA_MODELS[model].pixel_from_ray(INTRINSICS, distortion, np.array([[0.0, 0.0, -1.0]]))).all()


@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_counts_of_coefficients_are_named(model: str) -> None:
    assert {len(d) for d in DISTORTIONS[model]} <= set(CAMERA_MODELS[model].distortion_counts)
