"""Every pixel of the painter against a ray caster that shares nothing with it but the list of boxes."""

import numpy as np
import pytest

from fleetmap import core
from fleetmap.geometry import so3_exp
from fleetmap.sensors.calibration import CameraCalibration
from fleetsim.render.optics import make_optics
from fleetsim.render.painter import Look, Painter
from fleetsim.scene.light import Exposure
from fleetsim.sensors.robots import LENSES
from support.worlds.simulated_views import Array, map_from_cam, small_world

WIDTH, HEIGHT = 200, 150
NOTHING = 1e6


def _camera(lens: str) -> CameraCalibration:
    model, distortion, share = LENSES[lens]
    intrinsics = np.array([share * WIDTH, share * WIDTH, (WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    return CameraCalibration(model, WIDTH, HEIGHT, intrinsics, np.array(distortion), np.eye(4))


def _shell_distance(centre: Array, rays: Array) -> Array:
    """Ray parameter at the hall's floor, ceiling and walls."""
    layout = small_world().layout
    high = np.array([layout.length_m, layout.width_m, layout.ceiling_m])
    with np.errstate(divide="ignore"):
        return np.where(rays > 0, (high - centre) / rays, -centre / rays).min(axis=1)


POSES = [
    (x, y, z, yaw, pitch)
    for (x, y), z, pitch in (
        ((3.0, 3.6), 0.9, 0.05),
        ((9.0, 8.4), 0.38, -0.03),
        ((14.0, 3.2), 0.9, -0.2),
        ((20.0, 6.0), 1.4, 0.1),
    )
    for yaw in (0.0, 0.7, 1.9, 3.1, -1.2)
]


@pytest.mark.parametrize("lens", ["pinhole", "radial-tangential"])
def test_no_pixel_without_explanation(lens: str) -> None:
    world, camera = small_world(), _camera(lens)
    scene = world.scene_around(10.0, 5.0)
    painter = Painter(world, make_optics(camera), Look(samples=1, has_noise=False), 0)
    firsts = scene.ranges[:, 0]
    box_firsts = np.concatenate([[0], np.cumsum([len(part.boxes) for part in scene.parts])])
    boxes = np.concatenate([part.boxes for part in scene.parts])
    owners = np.concatenate([part.owners for part in scene.parts]).astype(np.int64)
    chunk_of = np.searchsorted(firsts, np.arange(len(scene)), side="right") - 1
    box_of_face = np.where(owners[:, 0] >= 0, owners[:, 0] + box_firsts[chunk_of], -1)
    low, size = np.array([-1.0, -1.0, -1.0]), np.array([world.layout.length_m, world.layout.width_m, 8.0])
    grid = core.BoxGrid(boxes, low, size + 1.0, 0.7)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    rays_cam = camera.ray_from_pixel(np.stack([u.ravel(), v.ravel()], 1))
    rays_cam /= rays_cam[:, 2:]
    unexplained, identical, checked = 0, 0, 0
    for x, y, z, yaw, pitch in POSES:
        placed = map_from_cam(x, y, z, yaw, pitch)
        shot = painter.shoot(scene, np.ones(3), lambda _, placed=placed: placed, 0.0, Exposure(0.003, 1.0), 1)
        rays, centre = np.ascontiguousarray(rays_cam @ placed[:3, :3].T), placed[:3, 3].copy()
        depth, hits = grid.cast(centre, rays, np.full(len(rays), NOTHING))
        nearest = np.minimum(depth, _shell_distance(centre, rays))
        face, painted = shot.faces.ravel(), shot.depth_m.ravel().astype(np.float64)
        assert (face >= 0).all()
        same = (box_of_face[face] == hits[:, 0]) & (owners[face, 1] == hits[:, 1]) & (depth < NOTHING)
        tolerance = 2e-5 * nearest**2 + 1e-4
        thin = (box_of_face[face] < 0) & (painted < nearest + 0.01) & (painted > 0)  # labels, bracing, lamps: no boxes
        close = np.abs(painted - nearest) < tolerance
        assert close[same].all()
        explained = close | thin
        if lens != "pinhole":
            # Samples of a lens come from the painted plane, up to half a pixel off: edges may differ.
            by_rays = (hits[:, 0] * 6 + hits[:, 1]).reshape(HEIGHT, WIDTH)
            explained |= (_beside_an_edge(shot.faces) | _beside_an_edge(by_rays)).ravel()
        unexplained += int((~explained).sum())
        identical += int(same.sum())
        checked += len(face)
    assert checked == len(POSES) * WIDTH * HEIGHT
    assert identical > 0.25 * checked  # otherwise the pictures show little but floor and walls
    assert unexplained == 0, f"{unexplained} of {checked} pixels"


def _beside_an_edge(faces):  # type: ignore[no-untyped-def]
    padded = np.pad(faces, 1, mode="edge")
    neighbours = [padded[1 + dy : 1 + dy + HEIGHT, 1 + dx : 1 + dx + WIDTH] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
    return np.any([other != faces for other in neighbours], axis=0)


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
