"""Pictures against the truth: what KLT tracks must lie where calibration, true depth and true motion put it."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.geometry import se3, se3_inverse, so3_exp, transform_points
from fleetmap.sensors.calibration import CameraCalibration
from fleetsim.motion import Route, RouteMotion
from fleetsim.renderer import Painter, RigRenderer, make_optics
from fleetsim.scene.layout import Layout
from fleetsim.scene.world import Exposure, World
from fleetsim.sensors import ROBOTS, nominal_calibration

Array = NDArray[np.float64]
MOMENTS_S = (3.0, 6.0, 9.5, 12.0, 14.0)
BODY_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@cache
def small_world() -> World:
    """Two aisles of four bays."""
    return World(Layout(aisles=2, bays=4), seed=3)


def _track(
    first: NDArray[np.uint8], second: NDArray[np.uint8], pixels: NDArray[np.float32]
) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels in `second`, and which of them come back to within half a pixel when tracked in reverse."""
    options = {"winSize": (21, 21), "maxLevel": 4}
    there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, pixels, None, **options)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, **options)
    kept = (found[:, 0] > 0) & (found_back[:, 0] > 0) & (np.linalg.norm((back - pixels)[:, 0], axis=1) < 0.5)
    return there[:, 0].astype(np.float64), kept


@pytest.mark.parametrize(
    ("lens", "has_blur"),
    [*((lens, False) for lens in ("pinhole", "radial-tangential", "equidistant", "double-sphere")), ("pinhole", True)],
)
def test_tracks_lie_where_truth_says(lens: str, has_blur: bool) -> None:
    world = small_world()
    y = world.layout.aisle_y_m(0), world.layout.aisle_y_m(1)
    route = Route(((2.7, y[0]), (20.0, y[0]), (20.0, y[1]), (12.0, y[1])))
    kind = replace(ROBOTS["surveyor"], lens=lens)
    motion = RouteMotion(route, kind.limits, kind.body_height_m, kind.shake, np.random.default_rng(0))
    rig = nominal_calibration(kind)
    renderer, (left, right) = RigRenderer(world, rig, motion, has_blur=has_blur), rig.cameras
    epipolar_px, temporal_px, stereo_px = [], [], []
    for moment_s in MOMENTS_S:
        (shot, beside), (later, _) = renderer.shoot(moment_s), renderer.shoot(moment_s + 0.05)
        corners = cv2.goodFeaturesToTrack(shot.image, 300, 0.01, 12)
        pixels = corners[:, 0].astype(np.float64)
        rays = left.ray_from_pixel(pixels)
        column, row = np.rint(pixels).astype(int).T
        points_left = rays / rays[:, 2:] * shot.depth_m[row, column].astype(np.float64)[:, None]

        seen, kept = _track(shot.image, beside.image, corners)
        rays_right = right.ray_from_pixel(seen)
        rise = rays[:, 1] / rays[:, 2] - rays_right[:, 1] / rays_right[:, 2]
        epipolar_px.append(np.median(np.abs(rise[kept])) * left.intrinsics_px[0])
        right_from_left = se3_inverse(right.body_from_cam) @ left.body_from_cam
        expected = right.pixel_from_ray(transform_points(right_from_left, points_left))
        stereo_px.append(np.median(np.linalg.norm(expected - seen, axis=1)[kept]))

        seen, kept = _track(shot.image, later.image, corners)
        later_from_left = se3_inverse(renderer.path(0)(moment_s + 0.05)) @ renderer.path(0)(moment_s)
        expected = left.pixel_from_ray(transform_points(later_from_left, points_left))
        temporal_px.append(np.median(np.linalg.norm(expected - seen, axis=1)[kept]))
        assert kept.mean() > 0.6
    renderer.close()
    assert np.median(epipolar_px) < 0.12
    assert np.median(temporal_px) < 0.25
    assert np.median(stereo_px) < 0.4


@pytest.mark.parametrize(("yaw", "pitch"), [(0.0, 0.0), (1.2, 0.0), (0.0, -1.2), (-0.8, 0.6)])
def test_a_fisheye_shows_what_pinholes_show_there(yaw: float, pitch: float) -> None:
    """Painted on five planes, 190 degrees: a pinhole turned by so much sees the same, but for samples at edges."""
    turned = so3_exp(np.array([0.0, 0.0, 0.7])) @ so3_exp(np.array([0.0, 0.05, 0.0]))
    world, placed = small_world(), se3(turned @ BODY_FROM_OPTICAL, np.array([9.0, 8.4, 0.9]))
    scene, exposure = world.scene_around(9.0, 8.4), Exposure(0.003, 1.0)
    size, shape = 180, np.array([0.0, 0.0, 0.0, 0.0, -0.17, 0.59])
    fisheye = CameraCalibration("double-sphere", size, size, np.array([46.0, 46.0, 89.5, 89.5]), shape, np.eye(4))
    pinhole = CameraCalibration("radial-tangential", 80, 60, np.array([60.0, 60.0, 39.5, 29.5]), np.zeros(0), np.eye(4))
    turn = np.eye(4)
    turn[:3, :3] = so3_exp(np.array([0.0, yaw, 0.0])) @ so3_exp(np.array([pitch, 0.0, 0.0]))
    seen = []
    for camera, map_from_own in ((fisheye, placed), (pinhole, placed @ turn)):
        optics = make_optics(camera)
        shot = Painter(world, optics, 0, has_noise=False).shoot(
            scene, np.ones(3), lambda _, held=map_from_own: held, 0.0, exposure, 1
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            seen.append(np.where(optics.vignetting > 0.05, shot.image / optics.vignetting, np.nan))
    v, u = np.mgrid[0:60, 0:80].astype(np.float64)
    rays = pinhole.ray_from_pixel(np.stack([u.ravel(), v.ravel()], 1)) @ turn[:3, :3].T
    column, row = np.rint(fisheye.pixel_from_ray(rays)).astype(int).reshape(60, 80, 2).transpose(2, 0, 1)
    inside = (column >= 0) & (column < size) & (row >= 0) & (row < size)
    assert inside.mean() > 0.5
    off = np.abs(seen[0][row[inside], column[inside]] - seen[1][inside])
    assert np.nanmedian(off) < 4.0
