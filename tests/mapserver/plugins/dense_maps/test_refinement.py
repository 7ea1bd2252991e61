"""Splats drawn and their derivatives against a slow reference; refinement brings spoiled colours back."""

from dataclasses import replace

import numpy as np

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.sensors.calibration import CameraCalibration
from mapserver.plugins.dense_maps.refinement import Look, Views, refine
from mapserver.plugins.dense_maps.splats import BLUR_PX2, THICKNESS, Splats, draw, parameters_of, with_parameters
from support.storage.dense_samples import wall

CAMERA = CameraCalibration("radial-tangential", 24, 18, np.array([22.0, 22.0, 11.5, 8.5]), np.zeros(0), np.eye(4))
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
FORWARD = se3(OPTICAL, np.zeros(3))


def reference(splats: Splats, parameters: Array, map_from_cam: Array) -> Array:
    """The picture by asking every splat at every pixel, with covariances as matrices."""
    cam_from_map = se3_inverse(map_from_cam)
    turn, (fx, fy, cx, cy) = cam_from_map[:3, :3], CAMERA.intrinsics_px
    v, u = np.mgrid[0 : CAMERA.height_px, 0 : CAMERA.width_px].astype(float)
    through, picture = np.ones(v.shape), np.zeros(v.shape)
    points = splats.points_map.astype(float) @ turn.T + cam_from_map[:3, 3]
    for i in np.argsort(points[:, 2]):
        x, y, z = points[i]
        normal = turn @ splats.normals[i].astype(float)
        disc = np.exp(2 * parameters[i, 1]) * (np.eye(3) - (1 - THICKNESS**2) * np.outer(normal, normal))
        jacobian = np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
        own = jacobian @ disc @ jacobian.T
        whole = own + BLUR_PX2 * np.eye(2)
        off = np.stack([u - (fx * x / z + cx), v - (fy * y / z + cy)], axis=-1)
        squared = np.einsum("...i,ij,...j", off, np.linalg.inv(whole), off)
        opacity = np.sqrt(np.linalg.det(own) / np.linalg.det(whole)) / (1 + np.exp(-parameters[i, 2]))
        alpha = opacity * np.exp(-0.5 * squared)
        alpha = np.where((alpha >= 1 / 255) & (through >= 1e-4), alpha, 0.0)
        picture += through * alpha * parameters[i, 0]
        through *= 1 - alpha
    return picture


def test_pictures_and_derivatives_as_of_the_reference() -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        normals = rng.normal(size=(12, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        points = np.column_stack([rng.uniform(1, 3, 12), rng.uniform(-0.5, 0.5, 12), rng.uniform(-0.4, 0.4, 12)])
        sigmas_m, greys, opacities = rng.uniform(0.1, 0.4, 12), rng.uniform(0, 255, 12), rng.uniform(0.2, 0.9, 12)
        splats = Splats(points.astype(np.float32), normals.astype(np.float32), sigmas_m, greys, opacities)
        place = se3(so3_exp(rng.normal(0, 0.1, 3)) @ OPTICAL, rng.normal(0, 0.1, 3))
        parameters = parameters_of(splats)
        drawn = draw(splats, parameters, CAMERA, place)
        np.testing.assert_allclose(drawn.picture, reference(splats, parameters, place), atol=1e-6)
        slopes = np.random.default_rng(seed).normal(size=drawn.picture.shape)
        numbers, gradients = drawn.backward(slopes)
        assert len(numbers) == 12
        step = 1e-6
        for row, number in enumerate(numbers):
            for column in range(3):
                values = []
                for sign in (-1, 1):
                    moved = parameters.copy()
                    moved[number, column] += sign * step
                    values.append((slopes * reference(splats, moved, place)).sum())
                wanted = (values[1] - values[0]) / (2 * step)
                # A pixel that a splat just reaches or not moves the quotient, not the derivative.
                assert abs(gradients[row, column] - wanted) < 1e-3 * max(1.0, abs(wanted))


def test_spoiled_colours_come_back_and_a_seed_repeats() -> None:
    right = Splats.of(wall(2.0, edge_level=3))
    places = [se3(OPTICAL, np.array([0.0, y, 0.0])) for y in np.linspace(-0.4, 0.4, 9)]
    looks = []
    for place in places:
        shown = draw(right, parameters_of(right), CAMERA, place).picture
        grey = np.clip(np.round(255 * shown), 0, 255).astype(np.uint8)
        looks.append(Look(CAMERA, place, grey, np.ones(shown.shape)))
    spoiled = replace(right, greys=np.clip(right.greys + 60.0, 0, 255))
    runs = [refine(spoiled, Views(looks[::2], looks[1::2]), 40, np.random.default_rng(3)) for _ in range(2)]
    assert runs[0].is_better
    assert runs[0].after.psnr_db > runs[0].before.psnr_db + 3.0
    np.testing.assert_array_equal(parameters_of(runs[0].splats), parameters_of(runs[1].splats))
    np.testing.assert_array_equal(with_parameters(right, parameters_of(right)).points_map, right.points_map)
