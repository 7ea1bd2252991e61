"""Ladders of light and sharpness: a site's own pictures, made darker and more blurred step by step. Pure."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np

from fleetmap.geometry import Array, Mask
from fleetmap.sensors.samples import CameraFrame, Image

STOPS = (1, 2, 3, 4, 5)
BLUR_PX = (3, 5, 9, 17)
# Difference of two Laplacians: blind to planes and edges
_LAPLACIANS = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_LAPLACIANS_GAIN = 6.0
_MAD_SIGMA = 0.6745


def noise_sigma(image: Image) -> float:
    """Return the standard deviation of an image's noise, in grey levels.

    Sources: Immerkaer 1996 (the mask), Donoho and Johnstone 1994 (the median, which texture does not raise as it raises the mean).
    """
    rest = cv2.filter2D(image.astype(np.float32), -1, _LAPLACIANS)
    return float(np.median(np.abs(rest))) / _MAD_SIGMA / _LAPLACIANS_GAIN


def darker(image: Image, stops: int, rng: np.random.Generator) -> Image:
    """Return an image with the light divided by 2^stops, the gain unchanged, and its noise as strong as before.

    The worst case of a sensor: noise of reading does not fall with the light, shot noise would.
    """
    factor = 0.5**stops
    noise = rng.normal(0.0, noise_sigma(image) * np.sqrt(1.0 - factor**2), image.shape)
    return np.clip(np.rint(factor * image + noise), 0, 255).astype(np.uint8)


def blurred(image: Image, length_px: int) -> Image:
    """Return an image smeared along its rows over so many pixels (odd), as a turn on the spot does during the exposure."""
    return np.asarray(cv2.blur(image, (length_px, 1)), np.uint8)


def ladders(frame: CameraFrame, seed: int) -> dict[str, Iterator[tuple[int, CameraFrame]]]:
    """Return by the kind of ladder its rungs, the easiest first, with the frame at each. Depth images stay as they are."""

    def rungs(levels: Sequence[int], spoil: Callable[..., Image]) -> Iterator[tuple[int, CameraFrame]]:
        for level in levels:
            rng = np.random.default_rng([seed, level])
            right = None if frame.right is None else spoil(frame.right, level, rng)
            yield level, replace(frame, left=spoil(frame.left, level, rng), right=right)

    smeared = rungs(BLUR_PX, lambda image, length_px, _: blurred(image, length_px))
    return {"darkness": rungs(STOPS, darker), "blur": smeared}


def darkest_grey(levels: Array, is_fixed: Mask) -> float | None:
    """Return the grey level that best divides pictures without a fix, up to it, from those with one; None if no level does.

    levels (N,): median grey level of each picture, darkened ones included; is_fixed (N,).
    """
    order = np.argsort(levels, kind="stable")
    fixed_below = np.concatenate([[0], np.cumsum(is_fixed[order])])
    missed_above = (~is_fixed).sum() - np.concatenate([[0], np.cumsum(~is_fixed[order])])
    cut = int(np.argmin(fixed_below + missed_above))
    return float(levels[order][cut - 1]) if cut else None
