"""Disparities on pictures whose disparity is known exactly, without resampling."""

import numpy as np
import pytest

from fleetmap import core
from fleetmap.features.settings import StereoSettings
from fleetmap.features.stereo import disparities
from fleetmap.geometry import Array
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from support.worlds.synthetic_texture import Texture, picture, pixel_grid, smooth_texture

WIDTH, HEIGHT = 320, 200
CAMERA = StereoCamera(250.0, 160.0, 100.0, 0.1, WIDTH, HEIGHT)
SETTINGS = StereoSettings()
NOTHING = np.zeros((0, 2), np.float32)


@pytest.fixture(scope="module")
def texture() -> Texture:
    return smooth_texture(np.random.default_rng(7))


def plane_pair(texture: Texture, at_origin_px: float, per_u: float = 0.0, per_v: float = 0.0) -> RectifiedFrame:
    """A plane: disparity of left pixel (u, v) is at_origin_px + per_u u + per_v v."""
    u, v = pixel_grid(WIDTH, HEIGHT)
    left_u = (u + at_origin_px + per_v * v) / (1 - per_u)
    return RectifiedFrame(0, picture(texture, u, v), picture(texture, left_u, v), None)


def corners(frame: RectifiedFrame, count: int = 150) -> Array:
    found = core.spread_corners(frame.left, count, 8.0, 12, 12, NOTHING)[0].astype(np.float64)
    return found[found[:, 0] > 60]


@pytest.mark.parametrize("disparity_px", [2.0, 7.25, 13.5, 24.8, 40.4])
def test_shifted_pictures_give_their_shift(texture: Texture, disparity_px: float) -> None:
    frame = plane_pair(texture, disparity_px)
    pixels = corners(frame)
    found = disparities(frame, CAMERA, pixels, SETTINGS)
    known = np.isfinite(found[:, 0])
    assert known.mean() > 0.8
    off = found[known, 0] - disparity_px
    assert abs(off.mean()) < 0.03
    assert np.median(np.abs(off)) < 0.05
    assert np.abs(off).max() < 0.5
    assert (found[known, 1] > 0).all()


def test_a_repeated_pattern_is_refused(texture: Texture) -> None:
    """Posts every 16 pixels: the row holds many equal matches; a prior tells which one is meant."""
    u, v = pixel_grid(WIDTH, HEIGHT)

    def posts(u: Array, v: Array) -> Array:
        return 128 + 60 * np.sin(2 * np.pi * u / 16) + 20 * np.sin(2 * np.pi * v / 9)

    frame = RectifiedFrame(0, picture(posts, u, v), picture(posts, u + 20.0, v), None)
    pixels = np.stack(np.meshgrid(np.arange(120.0, 280, 11), np.arange(30.0, 170, 13)), -1).reshape(-1, 2)
    assert np.isnan(disparities(frame, CAMERA, pixels, SETTINGS)).all()
    guided = disparities(frame, CAMERA, pixels, SETTINGS, np.full(len(pixels), 21.0))[:, 0]
    assert np.isfinite(guided).mean() > 0.5
    np.testing.assert_allclose(guided[np.isfinite(guided)], 20.0, atol=0.1)


def test_unrelated_pictures_give_little(texture: Texture) -> None:
    u, v = pixel_grid(WIDTH, HEIGHT)
    frame = RectifiedFrame(0, *(picture(of, u, v) for of in (texture, smooth_texture(np.random.default_rng(99)))), None)
    found = disparities(frame, CAMERA, corners(frame), SETTINGS)
    assert np.isfinite(found[:, 0]).mean() < 0.06


def test_sigmas_follow_the_noise(texture: Texture) -> None:
    """Normalised errors under 3 grey values of noise are of order one."""
    frame = plane_pair(texture, 9.7)
    both = np.stack([frame.left, frame.right])
    noisy = np.clip(np.rint(both + np.random.default_rng(3).normal(0, 3, both.shape)), 0, 255).astype(np.uint8)
    found = disparities(RectifiedFrame(0, *noisy, None), CAMERA, corners(frame), SETTINGS)
    normalised = (found[:, 0] - 9.7) / found[:, 1]
    assert 0.4 < np.nanmedian(np.abs(normalised)) / 0.6745 < 1.6


def test_near_the_border_and_without_a_second_picture_there_is_nothing(texture: Texture) -> None:
    frame = plane_pair(texture, 9.7)
    edge = np.array([[0.0, 0.0], [3.0, 100.0], [WIDTH - 1.0, HEIGHT - 1.0], [200.0, 2.0]])
    assert np.isnan(disparities(frame, CAMERA, edge, SETTINGS)).all()
    single = RectifiedFrame(0, frame.left, None, None)
    assert np.isnan(disparities(single, CAMERA, corners(frame), SETTINGS)).all()
    assert disparities(frame, CAMERA, np.zeros((0, 2)), SETTINGS).shape == (0, 2)


def test_depth_pictures_give_their_median_but_not_at_edges() -> None:
    depth_disparity = np.full((HEIGHT, WIDTH), 10.0, np.float32)
    depth_disparity[:, 200:] = 20.0
    depth_disparity[50, 50] = 10.3
    depth_disparity[90:110, 90:110] = np.nan
    frame = RectifiedFrame(0, np.zeros((HEIGHT, WIDTH), np.uint8), None, depth_disparity)
    pixels = np.array([[50.0, 50.0], [200.2, 60.0], [250.0, 60.0], [100.0, 100.0], [0.0, 0.0]])
    found = disparities(frame, CAMERA, pixels, SETTINGS)
    np.testing.assert_allclose(found[[0, 2], 0], [10.0, 20.0])
    assert np.isnan(found[[1, 3, 4]]).all()
    assert (found[[0, 2], 1] == SETTINGS.depth_sigma_px).all()
