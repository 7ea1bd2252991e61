"""Optical flow: points followed from one image to the next by their neighbourhoods."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.geometry import Array
from fleetmap.sensors.samples import Image


class Pyramid:
    """An image and its halvings, made on demand."""

    def __init__(self, image: Image) -> None:
        self._levels = [image]

    def level(self, number: int) -> Image:
        """The image halved so often, smoothed; pixel (x, y) there is (2x, 2y) on the level before."""
        while len(self._levels) <= number:
            self._levels.append(np.asarray(cv2.pyrDown(self._levels[-1]), np.uint8))
        return self._levels[number]

    def down_to(self, number: int) -> list[Image]:
        """Its levels from the image to that one."""
        self.level(number)
        return self._levels[: number + 1]


class Flow(NamedTuple):
    """Pixels (N, 2) of one image, their places (N, 2) in the next one, and which were found (N,)."""

    pixels: Array
    places: Array
    found: NDArray[np.bool_]


def follow(before: Pyramid, now: Pyramid, pixels: Array, predicted: Array, *, window_px: int, levels: int) -> Flow:
    """Follows pixels (N, 2) of one image into the next by pyramidal Lucas-Kanade; the core names its sources.

    predicted (N, 2): where they are looked for first, from so many levels above the image down.
    """
    start, sought = np.ascontiguousarray(pixels, np.float64), np.ascontiguousarray(predicted, np.float64)
    found = core.follow_pixels(before.down_to(levels), now.down_to(levels), start, sought, window_px // 2)
    return Flow(start, *found)


def forward_backward_check(
    before: Pyramid, now: Pyramid, flow: Flow, *, window_px: int, within_px: float, margin_px: float = -np.inf
) -> NDArray[np.bool_]:
    """(N,) which of the found places lead back to within so many pixels of where they were followed from.

    Nearer than margin_px to the image's edges none does. Source: Kalal et al. 2010.
    """
    return core.check_back(before.level(0), now.level(0), *flow, window_px // 2, within_px, margin_px)
