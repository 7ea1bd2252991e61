"""Patch alignment on warps that are known exactly."""

import numpy as np
import pytest

from fleetmap import core
from fleetmap.features import orb, patch_align
from fleetmap.features.patch_align import Patches, half_pyramid
from fleetmap.features.settings import AlignSettings
from fleetmap.geometry import Array, se3_exp, transform_points
from fleetmap.sensors.rectification import StereoCamera
from support.worlds.synthetic_texture import Texture, picture, pixel_grid, smooth_texture

WIDTH, HEIGHT = 320, 240
CENTRE = np.array([160.0, 120.0])
SETTINGS = AlignSettings()
NOTHING = np.zeros((0, 2), np.float32)


@pytest.fixture(scope="module")
def texture() -> Texture:
    return smooth_texture(np.random.default_rng(11), shortest_px=9.0)


def warped_pair(texture: Texture, current_from_reference: Array, gain: float = 1.0) -> tuple[Array, Array]:
    """Reference and current picture; offsets from the centre map by current_from_reference (2, 2)."""
    u, v = pixel_grid(WIDTH, HEIGHT)
    reference_uv = (np.stack([u, v], -1) - CENTRE) @ np.linalg.inv(current_from_reference).T + CENTRE
    current = 0.5 * (1 - gain) * 255 + gain * texture(reference_uv[..., 0], reference_uv[..., 1])
    return picture(texture, u, v), np.rint(current).astype(np.uint8)


def similarity(scale: float, angle_deg: float) -> Array:
    turn = np.radians(angle_deg)
    return scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])


def facing(reference_from_current: Array) -> Array:
    """(N, 2, 3) warps of offsets (N, 2, 2) on surfaces whose slant is not known."""
    return np.concatenate([reference_from_current, np.zeros((len(reference_from_current), 2, 1))], axis=2)


def aligned(before: Array, pixels: Array, now: Array, start: Array, warps: Array, octave: int = 0) -> Array:
    """(N, 3) places in the picture now, from a start, of what was at pixels before; octave: of all its features."""
    patches = [
        Patches(half_pyramid(image), at, np.full(len(at), level, np.int8))
        for image, at, level in ((before, pixels, 0), (now, start, octave))
    ]
    return patch_align.refine_matches(*patches, np.broadcast_to(warps, (len(pixels), 2, 3)).copy(), SETTINGS)


@pytest.mark.parametrize(
    "current_from_reference",
    [np.eye(2), similarity(1.0, 30.0), similarity(1.15, -10.0), np.array([[1.1, 0.1], [-0.05, 0.9]])],
    ids=["none", "turned", "turned-and-larger", "sheared"],
)
def test_known_warps_are_recovered(texture: Texture, current_from_reference: Array) -> None:
    """Starting a pixel off, under another gain and offset, the median error is below 0.05 px."""
    reference, current = warped_pair(texture, current_from_reference, gain=0.8)
    pixels = core.spread_corners(reference, 120, 10.0, 12, 50, NOTHING)[0].astype(np.float64)
    expected = (pixels - CENTRE) @ current_from_reference.T + CENTRE
    start = expected + np.random.default_rng(1).uniform(-1.0, 1.0, expected.shape)
    found = aligned(reference, pixels, current, start, facing(np.linalg.inv(current_from_reference)[None]))
    error = np.linalg.norm(found[:, :2] - expected, axis=1)
    assert np.isfinite(error).mean() > 0.8
    assert np.nanmedian(error) < 0.05
    assert np.nanpercentile(error, 90) < 0.15
    assert (np.abs(np.nanmean(found[:, :2] - expected, axis=0)) < 0.03).all()


def test_features_of_different_octaves_meet_across_scales() -> None:
    """The current picture is 1.9 times larger: octave 4 there matches octave 0 or 1 here (1.2^4 = 2.07)."""
    texture = smooth_texture(np.random.default_rng(12), shortest_px=16.0, longest_px=80.0)
    reference, current = warped_pair(texture, similarity(1.9, 0.0))
    pixels = core.spread_corners(reference, 60, 8.0, 12, 75, NOTHING)[0].astype(np.float64)
    expected = (pixels - CENTRE) * 1.9 + CENTRE
    found = aligned(reference, pixels, current, expected + 0.7, facing(similarity(1 / 1.9, 0.0)[None]), octave=4)
    error = np.linalg.norm(found[:, :2] - expected, axis=1)
    assert np.isfinite(error).mean() > 0.5
    assert np.nanmedian(error) < 0.15


def test_patches_that_do_not_agree_are_refused(texture: Texture) -> None:
    u, v = pixel_grid(WIDTH, HEIGHT)
    reference, other = picture(texture, u, v), picture(smooth_texture(np.random.default_rng(77)), u, v)
    pixels = core.spread_corners(reference, 120, 10.0, 12, 30, NOTHING)[0].astype(np.float64)
    for current in (other, np.full_like(reference, 90)):
        found = aligned(reference, pixels, current, pixels, facing(np.eye(2)[None]))
        assert np.isfinite(found[:, 0]).mean() < 0.12


def test_warp_from_octaves_and_angles() -> None:
    """A feature found larger and turned clockwise: offsets there map back smaller and turned back."""
    warp = patch_align.warps_from_features(
        np.array([1], np.int8), np.array([20.0]), np.array([3], np.int8), np.array([50.0])
    )
    np.testing.assert_allclose(warp, facing(np.linalg.inv(similarity(orb.SCALE_FACTOR**2, 30.0))[None]), atol=1e-12)


def test_warp_from_motion_is_the_derivative_of_the_reprojection() -> None:
    camera = StereoCamera(300.0, 160.0, 120.0, 0.1, WIDTH, HEIGHT)
    points = np.array([[0.2, -0.1, 2.0], [-1.0, 0.5, 4.0]])
    current_from_reference = se3_exp(np.array([0.05, -0.1, 0.2, 0.1, 0.05, -0.3]))
    warp = patch_align.warps_from_motion(points, current_from_reference)
    for k, point in enumerate(points):
        shifts = 1e-4 * point[2] / camera.focal_px * np.eye(3)[:2]
        moved = np.concatenate([point + shifts, point - shifts])
        pixels = camera.pixel_from_point(transform_points(current_from_reference, moved))[:, :2]
        current_from_reference_px = ((pixels[:2] - pixels[2:]) / 2e-4).T
        np.testing.assert_allclose(warp[k, :, :2] @ current_from_reference_px, np.eye(2), atol=0.02)
    behind = patch_align.warps_from_motion(np.array([[0.0, 0.0, -1.0]]), current_from_reference)
    assert np.isnan(behind).all()


CAMERA = StereoCamera(300.0, 160.0, 120.0, 0.1, WIDTH, HEIGHT)
WALL = (
    np.array([0.0, 0.0, 4.0]),
    np.array([np.sin(np.radians(25.0)), 0.0, np.cos(np.radians(25.0))]),
)  # a point of it, its direction


def places_on_wall(pixels: Array, reference_from_cam: Array) -> tuple[Array, Array]:
    """Points (..., 3) of the wall in the reference camera, and their metres along and across it (..., 2), that pixels (..., 2) show."""
    ahead = (pixels - [CAMERA.cx_px, CAMERA.cy_px]) / CAMERA.focal_px
    rays = np.concatenate([ahead, np.ones((*ahead.shape[:-1], 1))], -1) @ reference_from_cam[:3, :3].T
    start, along = WALL
    normal = np.cross(along, [0.0, 1.0, 0.0])
    centre = reference_from_cam[:3, 3]
    points = centre + rays * (((start - centre) @ normal) / (rays @ normal))[..., None]
    return points, np.stack([(points - start) @ along, points[..., 1]], -1)


def test_a_wall_along_the_way_does_not_draw_patches_back() -> None:
    """A robot drives 1.2 m towards what it sees of a wall, at 25 degrees. Taken to face it, its patches lay up to a pixel behind."""
    texture = smooth_texture(np.random.default_rng(13), shortest_px=12.0)
    u, v = pixel_grid(WIDTH, HEIGHT)
    reference_from_current = np.eye(4)
    reference_from_current[2, 3] = 1.2
    grey = []
    for reference_from_cam in (np.eye(4), reference_from_current):
        places = places_on_wall(np.stack([u, v], -1), reference_from_cam)[1]
        grey.append(picture(texture, 32.0 * places[..., 0], 75.0 * places[..., 1]))
    pixels = core.spread_corners(grey[0], 300, 8.0, 12, 60, NOTHING)[0].astype(np.float64)
    pixels = pixels[(np.abs(pixels - CENTRE) < 60).all(axis=1)]
    points = places_on_wall(pixels, np.eye(4))[0]
    current_from_reference = np.linalg.inv(reference_from_current)
    expected = CAMERA.pixel_from_point(transform_points(current_from_reference, points))[:, :2]
    warps = patch_align.warps_from_motion(points, current_from_reference)
    found = aligned(grey[0], pixels, grey[1], expected + 0.5, warps)
    error = np.linalg.norm(found[:, :2] - expected, axis=1)
    assert np.isfinite(error).mean() > 0.7
    assert np.nanmedian(error) < 0.05
    assert np.nanpercentile(error, 90) < 0.2
    flat = aligned(grey[0], pixels, grey[1], expected + 0.5, facing(warps[..., :2]))
    assert np.nanmedian(np.linalg.norm(flat[:, :2] - expected, axis=1)) > 3 * np.nanmedian(error)
