"""Optical flow against OpenCV's and against shifts that are known."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.geometry import Array

UNCHECKED = np.inf, -np.inf  # no way back, no margin
CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)


def painted(shift_px: tuple[float, float] = (0.0, 0.0), seed: int = 3) -> NDArray[np.uint8]:
    """A texture of waves, moved by so much: exact at any fraction of a pixel."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:120, 0:160].astype(float)
    u, v = u - shift_px[0], v - shift_px[1]
    grey = np.full(u.shape, 128.0)
    for _ in range(40):
        du, dv = rng.normal(0.0, 0.35, 2)
        grey += 9.0 * np.cos(du * u + dv * v + rng.uniform(0, 6.28))
    return np.asarray(np.clip(np.rint(grey), 0, 255), np.uint8)


def grid(first_px: float, step_px: float) -> Array:
    sides = (np.arange(first_px, size_px - first_px, step_px) for size_px in (160, 120))
    return np.stack(np.meshgrid(*sides), -1).reshape(-1, 2)


@pytest.mark.parametrize("levels", [0, 1, 3])
def test_as_opencv_does(levels: int) -> None:
    """Same places to a thousandth of a pixel wherever both find one, as far as a coarse level shows the way."""
    before, now = painted(), painted((1.7, -1.2) if levels == 0 else (4.3, -3.6))
    pixels = grid(20.3, 11.9)
    reference, found_too, _ = cv2.calcOpticalFlowPyrLK(
        before, now, pixels.astype(np.float32)[:, None], pixels.astype(np.float32)[:, None].copy(), winSize=(15, 15),
        maxLevel=levels, criteria=CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    places, found = core.follow_pixels(before, now, pixels, pixels, 7, levels, *UNCHECKED)
    both = found & (found_too.ravel() > 0)
    assert both.mean() > 0.95
    off = np.linalg.norm(places - reference[:, 0], axis=1)[both]
    assert np.percentile(off, 90) < 2e-3
    right = np.linalg.norm(places - pixels - ((1.7, -1.2) if levels == 0 else (4.3, -3.6)), axis=1) < 0.05
    assert right.mean() > 0.9


def test_at_the_edge_only_what_is_in_the_picture_counts() -> None:
    pixels = np.array([[3.0, 60.0], [156.0, 60.0], [80.0, 2.5], [80.0, 117.0], [2.0, 2.0]])
    places, found = core.follow_pixels(painted(), painted((0.3, -0.4)), pixels, pixels, 7, 0, *UNCHECKED)
    assert found.all()
    np.testing.assert_allclose(places - pixels, np.tile((0.3, -0.4), (5, 1)), atol=0.15)


def test_nothing_is_found_without_texture_or_outside() -> None:
    plain, pixels = np.full((120, 160), 90, np.uint8), np.array([[80.0, 60.0], [20.0, 20.0]])
    for before, there in ((plain, pixels), (painted(), np.array([[500.0, 60.0], [20.0, -90.0]]))):
        _, found = core.follow_pixels(before, painted(), pixels, there, 7, 1, *UNCHECKED)
        assert not found.any()


def test_what_went_wrong_does_not_lead_back() -> None:
    """Another texture covers the right half: flow finds places there, which lead elsewhere on the way back."""
    before, now, pixels = painted(), painted((2.0, 0.0)), grid(30.0, 20.0)
    now[:, 80:] = painted(seed=4)[:, 80:]
    right = pixels[:, 0] > 90
    _, found = core.follow_pixels(before, now, pixels, pixels, 7, 1, *UNCHECKED)
    _, held = core.follow_pixels(before, now, pixels, pixels, 7, 1, 0.5, -np.inf)
    assert found[right].mean() > 0.5
    np.testing.assert_array_equal(held[right], False)
    assert held[pixels[:, 0] < 70].all()
    places, inside = core.follow_pixels(before, now, pixels, pixels, 7, 1, 0.5, 35.0)
    expected = ((places > 35.0) & (places < [159 - 35.0, 119 - 35.0])).all(axis=1)
    np.testing.assert_array_equal(inside, held & expected)
