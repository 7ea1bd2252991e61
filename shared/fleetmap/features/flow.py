"""Points followed from one picture to the next by what their surroundings look like."""

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.features import flow_kernels
from fleetmap.geometry import Array
from fleetmap.sensors.samples import Image

_STEPS, _SETTLED_PX = 20, 0.01
# The way back begins at its end: steps that still move it by more than any check allows show soon.
_STEPS_BACK, _SETTLED_BACK_PX = 8, 0.03


class Pyramid:
    """A picture, and its halves as they are asked for."""

    def __init__(self, image: Image) -> None:
        self._levels = [image]

    def level(self, number: int) -> Image:
        """The picture halved so often, smoothed; pixel (x, y) there is (2x, 2y) on the level before."""
        while len(self._levels) <= number:
            self._levels.append(np.asarray(cv2.pyrDown(self._levels[-1]), np.uint8))
        return self._levels[number]


def follow(
    before: Pyramid, now: Pyramid, pixels: Array, predicted: Array, *, window_px: int, levels: int
) -> tuple[Array, NDArray[np.bool_]]:
    """Where pixels (N, 2) of one picture are in the next, (N, 2), and which were found.

    predicted (N, 2): where they are looked for first, from so many levels above the picture down. The source is named in the
    kernels.
    """
    places, found = np.array(predicted, np.float64), np.ones(len(pixels), bool)
    start, half = np.ascontiguousarray(pixels, np.float64), window_px // 2
    for level in range(levels, 0, -1):  # what a coarse level does not show, a finer one may
        flow_kernels.follow(
            before.level(level), now.level(level), 0.5**level, half, _STEPS, _SETTLED_PX, start, places, found.copy()
        )
    flow_kernels.follow(before.level(0), now.level(0), 1.0, half, _STEPS, _SETTLED_PX, start, places, found)
    return places, found


def forward_backward_check(
    before: Pyramid, now: Pyramid, pixels: Array, places: Array, found: NDArray[np.bool_], *, window_px: int, within_px: float
) -> NDArray[np.bool_]:  # fmt: skip
    """Which (N,) of the found places (N, 2) lead back to the pixels (N, 2) that they were found from, as nearly as is asked."""
    back, held = np.array(pixels, np.float64), found.copy()
    flow_kernels.follow(
        now.level(0), before.level(0), 1.0, window_px // 2, _STEPS_BACK, _SETTLED_BACK_PX, places, back, held
    )
    off = back - pixels
    return np.asarray(held & (off[:, 0] ** 2 + off[:, 1] ** 2 < within_px**2))
