"""Views drawn by the core against a slow reference, and of scenes whose view can be said."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.errors import UsageError
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.sensors.calibration import CameraCalibration
from mapserver.plugins.dense_maps.expected_view import MOST_PIXELS, RADIUS_EDGES, expected_view, filled, resized
from mapserver.plugins.dense_maps.surfel_map import Surfels
from support.storage.dense_samples import wall

PINHOLE = CameraCalibration("radial-tangential", 64, 48, np.array([60.0, 60.0, 31.5, 23.5]), np.zeros(0), np.eye(4))
BENT = replace(
    PINHOLE, intrinsics_px=np.array([60.0, 58.0, 30.0, 24.0]), distortion=np.array([-0.2, 0.05, 1e-3, -1e-3])
)
AT_24_PX, WIDE = np.array([24.0, 24.0, 31.5, 23.5]), np.array([-0.01, 0.002, 0.0, 0.0])
FISHEYE = CameraCalibration("equidistant", 64, 48, AT_24_PX, WIDE, np.eye(4))
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
FORWARD = se3(OPTICAL, np.zeros(3))
MIN_PIXELS, THICK_EDGES, THICK_PER_M = 0.75, 3.0, 100.0  # as surfels.cpp has them


def reference(surfels: Surfels, camera: CameraCalibration, map_from_cam: Array) -> tuple[Array, Array]:
    """Colour and distance (H, W) by casting every pixel's ray at every disc; NaN where none is hit."""
    cam_from_map = se3_inverse(map_from_cam)
    points = surfels.points_map.astype(float) @ cam_from_map[:3, :3].T + cam_from_map[:3, 3]
    normals = surfels.normals.astype(float) @ cam_from_map[:3, :3].T
    edges = surfels.edges_m.astype(float)
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px].astype(float)
    rays = camera.ray_from_pixel(np.stack([u.ravel(), v.ravel()], axis=1))
    grid = rays.reshape(camera.height_px, camera.width_px, 3)
    angles = [np.linalg.norm(np.diff(grid, axis=axis), axis=2) for axis in (0, 1)]
    centres = camera.pixel_from_ray(points)
    colour, depth = np.full((2, camera.height_px * camera.width_px), np.nan)
    fine = np.zeros(len(points))
    for i, (x, y) in enumerate(np.nan_to_num(centres, nan=-1e6)):
        row, column = int(np.clip(y, 0, camera.height_px - 1)), int(np.clip(x, 0, camera.width_px - 1))
        near = [angles[0][max(0, row - 1) : row + 1, column], angles[1][row, max(0, column - 1) : column + 1]]
        fine[i] = 1.0 / np.nanmin(np.concatenate(near))
    radius = np.maximum(RADIUS_EDGES * edges, MIN_PIXELS * np.linalg.norm(points, axis=1) / fine)
    thick = THICK_EDGES * edges + THICK_PER_M * edges**2
    facing = (normals * points).sum(axis=1) < 0
    for pixel, ray in enumerate(rays):
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (normals * points).sum(axis=1) / (normals @ ray)
        share = ((t[:, None] * ray - points) ** 2).sum(axis=1) / radius**2
        hit = facing & (normals @ ray < -1e-3) & (t > 0) & (share < 1)
        if hit.any():
            hit &= t <= (t[hit] + thick[hit]).min()
            weight = (1 - share[hit]) ** 2 / edges[hit] ** 4
            colour[pixel] = (weight * surfels.greys[hit]).sum() / weight.sum()
            depth[pixel] = (weight * t[hit]).sum() / weight.sum()
    return colour.reshape(grid.shape[:2]), depth.reshape(grid.shape[:2])


@pytest.mark.parametrize("camera", [PINHOLE, BENT, FISHEYE], ids=["pinhole", "bent", "fisheye"])
@pytest.mark.parametrize("seed", range(3))
def test_as_by_casting_every_ray_at_every_disc(camera: CameraCalibration, seed: int) -> None:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(300, 3)) - np.array([1.0, 0, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.column_stack([rng.uniform(0.6, 5, 300), rng.uniform(-2.5, 2.5, 300), rng.uniform(-2, 2, 300)])
    levels, greys = rng.integers(0, 5, 300).astype(np.uint8), rng.integers(0, 256, 300).astype(np.uint8)
    surfels = Surfels(points.astype(np.float32), normals.astype(np.float32), levels, greys)
    map_from_cam = se3(so3_exp(rng.normal(0, 0.2, 3)) @ OPTICAL, rng.normal(0, 0.1, 3))
    view = expected_view(surfels, camera, map_from_cam)
    colour, depth = reference(surfels, camera, map_from_cam)
    assert 0.1 < np.isnan(colour).mean() < 0.95
    # A disc may reach a pixel further on the side where pixels are finer than in its middle.
    assert (view.unknown != np.isnan(colour)).mean() < 0.002
    both = ~view.unknown & ~np.isnan(colour)
    off = (np.abs(view.picture[both] - colour[both]) > 0.51) | (np.abs(view.depth_m[both] - depth[both]) > 1e-4)
    assert off.mean() < 0.005


def test_a_wall_is_seen_where_it_stands_and_nothing_beside_it() -> None:
    camera = resized(PINHOLE, 320)
    view = expected_view(wall(2.0), camera, FORWARD)
    v, u = np.mgrid[0:240, 0:320]
    across, down = (u - camera.intrinsics_px[2]) / 300.0, (v - camera.intrinsics_px[3]) / 300.0
    on_wall = np.abs(down * 2.0) < 1.0
    known = ~view.unknown
    assert known[on_wall & (np.abs(down) < 0.49)].all()
    np.testing.assert_allclose(view.depth_m[known], 2.0 * np.sqrt(1 + across**2 + down**2)[known], rtol=1e-3)
    white = (np.abs(across * 2) < 0.17) & (np.abs(down * 2) < 0.17)
    assert (view.picture[white] >= 249).all()
    grey = on_wall & ((np.abs(across * 2) > 0.24) | (np.abs(down * 2) > 0.24))
    assert (np.abs(view.picture[grey].astype(int) - 120) <= 1).all()
    assert expected_view(wall(2.0), camera, se3(so3_exp(np.array([0, 0, np.pi])) @ OPTICAL, np.zeros(3))).unknown.all()


def test_the_nearer_wall_hides_the_other_and_backs_are_not_seen() -> None:
    near, far = wall(1.0, grey=200), wall(2.0, grey=50)
    view = expected_view(Surfels.joined([far, near]), PINHOLE, FORWARD)
    assert np.abs(view.depth_m[24, 32] - 1.0) < 0.01
    assert (view.picture[~view.unknown] >= 199).all()
    behind = se3(so3_exp(np.array([0, 0, np.pi])) @ OPTICAL, np.array([3.0, 0, 0]))
    assert expected_view(far, PINHOLE, behind).unknown.all()


def test_no_hole_in_a_wall_from_near_or_far() -> None:
    for distance_m in (0.4, 1.0, 4.0, 12.0):
        for camera in (PINHOLE, resized(PINHOLE, 640)):
            view = expected_view(wall(distance_m), camera, FORWARD)
            height, width = view.unknown.shape
            size = camera.intrinsics_px[0] * 0.8 / distance_m
            rows = slice(max(0, int(height / 2 - size)), int(height / 2 + size) + 1)
            columns = slice(max(0, int(width / 2 - size)), int(width / 2 + size) + 1)
            assert not view.unknown[rows, columns].any()


def test_the_lens_darkens_as_that_of_the_survey() -> None:
    surfels = wall(1.0, grey=200)
    dark = Surfels(surfels.points_map, surfels.normals, surfels.levels, surfels.greys, (-1.0, 0.0, 0.0))
    plain, darkened = (expected_view(s, PINHOLE, FORWARD) for s in (surfels, dark))
    u = np.arange(64)
    squared = ((u - 31.5) / 60.0) ** 2 + (0.5 / 60.0) ** 2
    np.testing.assert_allclose(darkened.picture[24], plain.picture[24] * np.exp(-squared), atol=1.0)


def test_unknown_pixels_are_filled_from_their_surroundings() -> None:
    ramp = np.tile(np.arange(64, dtype=np.float32) * 2, (48, 1))
    unknown = np.zeros((48, 64), bool)
    unknown[20:30, 20:30] = True
    made = filled(np.where(unknown, np.nan, ramp).astype(np.float32), unknown)
    assert np.abs(made - ramp)[unknown].max() < 12
    assert (made[~unknown] == ramp[~unknown]).all()
    assert (filled(ramp, np.ones((48, 64), bool)) == 128).all()


def test_wrong_orders_are_told() -> None:
    with pytest.raises(UsageError, match="the limit is"):
        expected_view(wall(), resized(PINHOLE, int(2 * np.sqrt(MOST_PIXELS))), FORWARD)
    with pytest.raises(UsageError, match="rotation"):
        expected_view(wall(), PINHOLE, np.diag([1.0, 1.0, 2.0, 1.0]))
    with pytest.raises(UsageError, match="pose"):
        expected_view(wall(), PINHOLE, np.full((4, 4), np.nan))
