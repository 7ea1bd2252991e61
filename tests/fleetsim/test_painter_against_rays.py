"""Every pixel of the painter against a ray caster that shares nothing with it but the list of boxes."""

import numpy as np
import pytest

from fleetmap.geometry import so3_exp
from fleetmap.sensors.calibration import CameraCalibration
from fleetsim.render.optics import make_optics
from fleetsim.render.painter import Look, Painter
from fleetsim.scene.light import Exposure
from support.worlds.simulated_views import map_from_cam, small_world

WIDTH, HEIGHT = 200, 150


@pytest.mark.parametrize(("yaw", "pitch"), [(0.0, 0.0), (1.2, 0.0), (0.0, -1.2), (-0.8, 0.6)])
def test_a_fisheye_shows_what_pinholes_show_there(yaw: float, pitch: float) -> None:
    """Painted on five planes, 190 degrees: a pinhole turned by so much sees the same, but for samples at edges."""
    world, placed = small_world(), map_from_cam(9.0, 8.4, 0.9, 0.7, 0.05)
    scene, exposure = world.scene_around(9.0, 8.4), Exposure(0.003, 1.0)
    size, shape = 180, np.array([0.0, 0.0, 0.0, 0.0, -0.17, 0.59])
    fisheye = CameraCalibration("double-sphere", size, size, np.array([46.0, 46.0, 89.5, 89.5]), shape, np.eye(4))
    pinhole = CameraCalibration("radial-tangential", 80, 60, np.array([60.0, 60.0, 39.5, 29.5]), np.zeros(0), np.eye(4))
    turn = np.eye(4)
    turn[:3, :3] = so3_exp(np.array([0.0, yaw, 0.0])) @ so3_exp(np.array([pitch, 0.0, 0.0]))
    seen = []
    for camera, map_from_own in ((fisheye, placed), (pinhole, placed @ turn)):
        optics = make_optics(camera)
        shot = Painter(world, optics, Look(has_noise=False), 0).shoot(
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
