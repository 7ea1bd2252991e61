"""Sub-pixel positions of matched features: the match finds the correspondence, the patch gives the coordinate."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.orb import SCALE_FACTOR, Features
from fleetmap.features.settings import AlignSettings
from fleetmap.geometry import Array, Array32, Indices
from fleetmap.sensors.samples import Image

Pyramid = tuple[Image, Image, Image]


def half_pyramid(image: Image) -> Pyramid:
    """The image and its halvings; a level-0 pixel (x, y) lies at (x, y) / 2^level."""
    half = np.asarray(cv2.pyrDown(image), np.uint8)
    return image, half, np.asarray(cv2.pyrDown(half), np.uint8)


class Patches(NamedTuple):
    """Chosen features (N,) of an image: its `half_pyramid`; of all, pixels (M, 2) at level 0, octaves (M,) and angles (M,)."""

    pyramid: Pyramid
    pixels: Array
    octaves: NDArray[np.int8]
    angles_deg: Array32
    chosen: Indices

    @classmethod
    def of(cls, pyramid: Pyramid, features: Features, chosen: Indices) -> "Patches":
        """Return the chosen features (N,) of an image."""
        pixels = np.ascontiguousarray(features.pixels, np.float64)
        octaves = np.ascontiguousarray(features.octaves, np.int8)
        return cls(pyramid, pixels, octaves, np.ascontiguousarray(features.angles_deg, np.float32), chosen)


def refine_matches(
    reference: Patches,
    current: Patches,
    settings: AlignSettings,
    points_reference: Array | None = None,
    current_from_reference: Array | None = None,
) -> Array:
    """(N, 3) x, y, sigma_px in level-0 pixels of the current image; NaN where the patches do not agree.

    The patches are warped as by the motion around points (N, 3) of the reference camera; where that is degenerate or not known, None,
    by the features' octaves and orientations, whose surface's slant is unknown (shared/core/patch_align.cpp). Each feature is aligned on
    the halving of the pyramid nearest to the scale at which it was found.
    """
    points = np.full((len(reference.chosen), 3), np.nan) if points_reference is None else points_reference
    motion = np.eye(4) if current_from_reference is None else current_from_reference
    limits = settings.half_window_px, settings.max_shift_px, settings.min_correlation
    return core.align_features(reference, current, points, motion, *limits)


def halvings(octaves: NDArray[np.int8]) -> Indices:
    """(N,) the level of `half_pyramid` nearest to the scale of each octave."""
    return np.asarray(np.clip(np.rint(octaves * np.log2(SCALE_FACTOR)), 0, 2), np.int64)
