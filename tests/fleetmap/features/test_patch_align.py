"""Patch alignment on warps that are known exactly."""

import numpy as np
import pytest

from fleetmap import core
from fleetmap.features import orb
from fleetmap.features.patch_align import Patches, half_pyramid, refine_matches
from fleetmap.features.settings import AlignSettings
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, transform_points
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
    return scale * so3_exp(np.radians([0.0, 0.0, angle_deg]))[:2, :2]


def motion(scale: float, angle_deg: float) -> Array:
    """current_from_reference (4, 4) of a camera that turns about its axis and goes ahead: pictures of what is 4 m ahead are similar."""
    return se3(so3_exp(np.radians([0.0, 0.0, angle_deg])), np.array([0.0, 0.0, 4.0 / scale - 4.0]))


def ahead(pixels: Array) -> Array:
    """Points (N, 3) 4 m ahead, that a camera with its axis in the centre shows at pixels (N, 2)."""
    return np.column_stack([(pixels - CENTRE) * 4.0 / 300.0, np.full(len(pixels), 4.0)])


Moved = tuple[Array, Array] | None  # points (N, 3) and the motion, if known


def aligned(
    before: Array, pixels: Array, now: Array, start: Array, moved: Moved, found: tuple[int, float] = (0, 0.0)
) -> Array:
    """(N, 3) places in the picture now, from a start, of what was at pixels before.

    found: octave and angle of all features now; before both are 0.
    """
    patches = []
    for image, at, (octave, angle_deg) in ((before, pixels, (0, 0.0)), (now, start, found)):
        count = len(at)
        kind = np.full(count, octave, np.int8), np.full(count, angle_deg, np.float32)
        patches.append(Patches(half_pyramid(image), at, *kind, np.arange(count)))
    return refine_matches(*patches, SETTINGS, *(moved or ()))


@pytest.mark.parametrize("is_moved", [True, False])
@pytest.mark.parametrize(("octave", "angle_deg"), [(0, 0.0), (0, 30.0), (1, -10.0)], ids=["none", "turned", "larger"])
def test_known_warps_are_recovered(texture: Texture, octave: int, angle_deg: float, is_moved: bool) -> None:
    """Starting a pixel off, under another gain and offset, the median error is below 0.05 px: by the motion, or by octave and angle."""
    scale = orb.SCALE_FACTOR**octave
    turned = similarity(scale, angle_deg)
    reference, current = warped_pair(texture, turned, gain=0.8)
    pixels = core.spread_corners(reference, 120, 10.0, 12, 50, NOTHING)[0].astype(np.float64)
    expected = (pixels - CENTRE) @ turned.T + CENTRE
    start = expected + np.random.default_rng(1).uniform(-1.0, 1.0, expected.shape)
    moved = (ahead(pixels), motion(scale, angle_deg)) if is_moved else None
    found = aligned(reference, pixels, current, start, moved, (octave, angle_deg))
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
    found = aligned(reference, pixels, current, expected + 0.7, (ahead(pixels), motion(1.9, 0.0)), (4, 0.0))
    error = np.linalg.norm(found[:, :2] - expected, axis=1)
    assert np.isfinite(error).mean() > 0.5
    assert np.nanmedian(error) < 0.15


def test_patches_that_do_not_agree_are_refused(texture: Texture) -> None:
    u, v = pixel_grid(WIDTH, HEIGHT)
    reference, other = picture(texture, u, v), picture(smooth_texture(np.random.default_rng(77)), u, v)
    pixels = core.spread_corners(reference, 120, 10.0, 12, 30, NOTHING)[0].astype(np.float64)
    for current in (other, np.full_like(reference, 90)):
        found = aligned(reference, pixels, current, pixels, None)
        assert np.isfinite(found[:, 0]).mean() < 0.12


CAMERA = StereoCamera(300.0, 160.0, 120.0, 0.1, WIDTH, HEIGHT)
WALL = np.array([0.0, 0.0, 4.0]), so3_exp(np.radians([0.0, 25.0, 0.0]))[:, 2]  # a point of it, its direction


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
    reference_from_current, grey = se3(np.eye(3), np.array([0.0, 0.0, 1.2])), []
    for reference_from_cam in (np.eye(4), reference_from_current):
        places = places_on_wall(np.stack([u, v], -1), reference_from_cam)[1]
        grey.append(picture(texture, 32.0 * places[..., 0], 75.0 * places[..., 1]))
    pixels = core.spread_corners(grey[0], 300, 8.0, 12, 60, NOTHING)[0].astype(np.float64)
    pixels = pixels[(np.abs(pixels - CENTRE) < 60).all(axis=1)]
    points = places_on_wall(pixels, np.eye(4))[0]
    current_from_reference = se3_inverse(reference_from_current)
    expected = CAMERA.pixel_from_point(transform_points(current_from_reference, points))[:, :2]
    found = aligned(grey[0], pixels, grey[1], expected + 0.5, (points, current_from_reference))
    error = np.linalg.norm(found[:, :2] - expected, axis=1)
    assert np.isfinite(error).mean() > 0.7
    assert np.nanmedian(error) < 0.05
    assert np.nanpercentile(error, 90) < 0.2
    behind = aligned(grey[0], pixels, grey[1], expected + 0.5, (-points, current_from_reference))
    unknown = aligned(grey[0], pixels, grey[1], expected + 0.5, None)
    np.testing.assert_array_equal(behind, unknown)
    assert np.nanmedian(np.linalg.norm(unknown[:, :2] - expected, axis=1)) > 3 * np.nanmedian(error)
