"""Disparities and alignments against exact sub-pixel truth, in the pictures of every image pipeline.

The scene is a slanted plane whose texture is a sum of waves: its picture from either side is known at every point, without
interpolation. A bias that hangs on how a picture was made would change the scale of maps.
"""

import numpy as np
import pytest

from fleetmap import core
from fleetmap.features import stereo
from fleetmap.features.patch_align import Patches, half_pyramid, refine_matches
from fleetmap.features.settings import AlignSettings, StereoSettings
from fleetmap.geometry import Array
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera
from fleetmap.sensors.samples import CameraFrame, Image
from fleetsim.pipelines import IMAGE_PIPELINES, process_frame

CAMERA = StereoCamera(300.0, 239.5, 179.5, 0.12, 480, 360)
RNG = np.random.default_rng(11)
# wave lengths of 4 to 60 px, amplitudes that grow with them as in natural scenes (Field 1987)
LENGTHS_PX = np.exp(RNG.uniform(np.log(4.0), np.log(60.0), 120))
ANGLES, PHASES = RNG.uniform(0.0, 2 * np.pi, (2, 120))


def _texture(x: Array, y: Array) -> Array:
    total = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    for length_px, angle, phase in zip(LENGTHS_PX, ANGLES, PHASES, strict=True):
        wave = 2 * np.pi * (np.cos(angle) * x + np.sin(angle) * y) / length_px + phase
        total += length_px**0.7 * np.cos(wave)
    return 110.0 + 22.0 * total / np.sqrt(0.5 * (LENGTHS_PX**1.4).sum())


def _disparity(x: Array, y: Array) -> Array:
    """Of the plane at left pixels: 6 to 14 px, every sub-pixel phase as often."""
    return 10.0 + 0.012 * (x - 239.5) + 0.006 * (y - 179.5)


def _pair() -> tuple[Image, Image]:
    y, x = np.mgrid[0:360, 0:480].astype(np.float64)
    # the left pixel whose disparity brings it to (x, y) of the right picture
    left_x = (x + _disparity(np.zeros(1), y)) / (1.0 - 0.012)
    return tuple(np.clip(np.rint(_texture(place, y)), 0, 255).astype(np.uint8) for place in (x, left_x))  # type: ignore[return-value]


LEFT, RIGHT = _pair()
PIXELS = np.stack(np.meshgrid(np.arange(30.0, 450.0, 7.0), np.arange(30.0, 330.0, 7.0)), -1).reshape(-1, 2)
TRUE = _disparity(PIXELS[:, 0], PIXELS[:, 1])


def _check(found: Array) -> None:
    off = found - TRUE
    good = np.isfinite(off) & (np.abs(off) < 1.0)
    assert good.sum() > 200
    # 0.005 px is 0.05 % of 10 px; what is more must be within 3.5 sigma of the mean that so many noisy points have
    assert abs(off[good].mean()) < max(0.005, 3.5 * off[good].std() / np.sqrt(good.sum()))
    phase = np.floor((found[good] % 1.0) * 8).astype(int)
    by_phase = np.array([off[good][phase == k].mean() for k in range(8)])
    error = np.array([off[good][phase == k].std() / np.sqrt(max((phase == k).sum(), 1)) for k in range(8)])
    # Bilinear interpolation pulls towards whole pixels, by a wave over the phase that has no mean (pixel locking): 0.01 px
    # in clean pictures, 0.1 px under the noise of gain 16
    assert (np.abs(by_phase) < 0.08 + 3.5 * error).all()


@pytest.mark.parametrize("name", IMAGE_PIPELINES)
def test_disparities_patches_and_flow_are_right_whatever_the_camera_makes_of_it(name: str) -> None:
    frame = process_frame(CameraFrame(7, LEFT, RIGHT), IMAGE_PIPELINES[name], 3)
    left, right = frame.left, frame.right
    _check(stereo.disparities(RectifiedFrame(0, left, right, None), CAMERA, PIXELS, StereoSettings())[:, 0])
    there = np.column_stack([PIXELS[:, 0] - np.rint(TRUE), PIXELS[:, 1]])
    points, right_from_left = CAMERA.point_from_pixel(PIXELS, TRUE), np.eye(4)
    right_from_left[0, 3] = -CAMERA.baseline_m
    finest = np.zeros(len(PIXELS), np.int8), np.zeros(len(PIXELS), np.float32), np.arange(len(PIXELS))
    seen = Patches(half_pyramid(left), PIXELS, *finest), Patches(half_pyramid(right), there, *finest)
    aligned = refine_matches(*seen, AlignSettings(min_correlation=0.0), points, right_from_left)
    _check(PIXELS[:, 0] - aligned[:, 0])
    places, found = core.follow_pixels(left, right, PIXELS, there, 6, 1, np.inf, -np.inf)
    _check(np.where(found, PIXELS[:, 0] - places[:, 0], np.nan))
