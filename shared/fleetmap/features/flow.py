"""Optical flow: points followed from one image to the next by their neighbourhoods."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.geometry import Array
from fleetmap.sensors.samples import Image

_STEPS, _SETTLED_PX = 20, 0.01
# The way back begins near its end, so that failures show after few steps.
_STEPS_BACK, _SETTLED_BACK_PX = 8, 0.03


class Pyramid:
    """An image and its halvings, made on demand."""

    def __init__(self, image: Image) -> None:
        self._levels = [image]

    def level(self, number: int) -> Image:
        """The image halved so often, smoothed; pixel (x, y) there is (2x, 2y) on the level before."""
        while len(self._levels) <= number:
            self._levels.append(np.asarray(cv2.pyrDown(self._levels[-1]), np.uint8))
        return self._levels[number]


class Flow(NamedTuple):
    """Pixels (N, 2) of one image, their places (N, 2) in the next one, and which were found (N,)."""

    pixels: Array
    places: Array
    found: NDArray[np.bool_]


def follow(before: Pyramid, now: Pyramid, pixels: Array, predicted: Array, *, window_px: int, levels: int) -> Flow:
    """Follows pixels (N, 2) of one image into the next by pyramidal Lucas-Kanade; the core names its sources.

    predicted (N, 2): where they are looked for first, from so many levels above the image down.
    """
    places, found = np.array(predicted, np.float64), np.ones(len(pixels), bool)
    start, half = np.ascontiguousarray(pixels, np.float64), window_px // 2
    for level in range(levels, 0, -1):  # what a coarse level does not show, a finer one may
        core.follow_windows(
            before.level(level), now.level(level), 0.5**level, half, _STEPS, _SETTLED_PX, start, places, found.copy()
        )
    core.follow_windows(before.level(0), now.level(0), 1.0, half, _STEPS, _SETTLED_PX, start, places, found)
    return Flow(start, places, found)


def forward_backward_check(
    before: Pyramid, now: Pyramid, flow: Flow, *, window_px: int, within_px: float, margin_px: float = -np.inf
) -> NDArray[np.bool_]:
    """(N,) which of the found places lead back to within so many pixels of where they were followed from.

    Nearer than margin_px to the image's edges none does. Source: Kalal et al. 2010.
    """
    held, ends = flow.found.copy(), (float(within_px), float(margin_px))
    steps = window_px // 2, _STEPS_BACK, _SETTLED_BACK_PX
    core.check_windows_back(before.level(0), now.level(0), *steps, flow.pixels, flow.places, *ends, held)
    return held
