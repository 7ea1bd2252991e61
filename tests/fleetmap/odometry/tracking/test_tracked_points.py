"""Predicted and carried points against the camera's own projection."""

import numpy as np

from fleetmap import core
from fleetmap.geometry import se3, so3_exp, transform_points
from fleetmap.pnp.pnp import REFINEMENT
from support.worlds.point_world import CAMERA

LENS = np.array([CAMERA.focal_px, CAMERA.cx_px, CAMERA.cy_px, CAMERA.focal_px * CAMERA.baseline_m])
MOTION = se3(so3_exp(np.array([0.01, -0.03, 0.02])), np.array([0.05, -0.02, 0.3]))


def test_points_are_projected_and_those_without_depth_turned() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform([-2, -1, 1], [2, 1, 8], (40, 3))
    points[3, 2] = -0.5  # behind the camera it stays where it was
    pixels = CAMERA.pixel_from_point(points)
    pixels[:2, 2] = np.nan
    blank = [np.zeros((240, 320), np.uint8)]  # where flow leaves them where it would have begun
    predicted = core.track_points(blank, blank, pixels, MOTION, LENS, 7, 1.0, 0.0, 5, REFINEMENT)[0]
    np.testing.assert_allclose(predicted[4:], CAMERA.pixel_from_point(transform_points(MOTION, points[4:]))[:, :2])
    far = CAMERA.point_from_pixel(pixels[:2, :2], np.full(2, 1e-9))
    np.testing.assert_allclose(predicted[:2], CAMERA.pixel_from_point(transform_points(MOTION, far))[:, :2], rtol=1e-6)
    np.testing.assert_array_equal(predicted[3], pixels[3, :2])


def test_what_disagrees_ends_and_the_rest_keeps_its_depth() -> None:
    points = np.array([[0.0, 0.0, 4.0], [0.5, 0.2, 5.0], [np.nan] * 3, [0.1, 0.1, 3.0]])
    expected = CAMERA.pixel_from_point(transform_points(MOTION, np.nan_to_num(points, nan=1.0)))
    flowed = expected[:, :2] + [[0.5, 0.0], [3.0, 0.0], [90.0, 0.0], [0.0, 1.9]]
    kept = np.array([True, True, True, False])
    pixels = CAMERA.pixel_from_point(np.nan_to_num(points, nan=1.0))
    kept, carried = core.carry_points(pixels, points, flowed, kept, MOTION, LENS, 2.0)
    assert kept.tolist() == [True, False, True, False]
    np.testing.assert_array_equal(carried[:, :2], flowed)
    disparities = expected[[0, 1, 3], 0] - expected[[0, 1, 3], 2]
    np.testing.assert_allclose(carried[[0, 1, 3], 0] - carried[[0, 1, 3], 2], disparities)
    assert np.isnan(carried[2, 2])
