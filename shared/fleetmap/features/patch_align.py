"""Sub-pixel positions of matched features: the match finds the correspondence, the patch gives the coordinate."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.features.settings import AlignSettings
from fleetmap.geometry import Array
from fleetmap.sensors.samples import Image

Pyramid = tuple[Image, Image, Image]


def half_pyramid(image: Image) -> Pyramid:
    """The image and its halvings; a level-0 pixel (x, y) lies at (x, y) / 2^level."""
    half, quarter = core.halvings(image, 2)
    return image, half, quarter


def warps_from_features(
    octaves_reference: NDArray[np.int8],
    angles_reference_deg: NDArray[np.floating],
    octaves_current: NDArray[np.int8],
    angles_current_deg: NDArray[np.floating],
) -> Array:
    """(N, 2, 3) warps for `refine_matches`, from two features' octaves and orientations; the surface's slant is unknown."""
    scale = SCALE_FACTOR ** (octaves_reference.astype(np.float64) - octaves_current)
    angle = np.radians(angles_reference_deg.astype(np.float64) - angles_current_deg)
    cosine, sine, none = scale * np.cos(angle), scale * np.sin(angle), np.zeros(len(scale))
    return np.stack([np.stack([cosine, -sine, none], -1), np.stack([sine, cosine, none], -1)], 1)


def warps_from_motion(points_reference: Array, current_from_reference: Array) -> Array:
    """(N, 2, 3) warps for `refine_matches` around points (N, 3) of the reference camera. NaN where degenerate."""
    return core.warps_from_motion(
        np.ascontiguousarray(points_reference, np.float64), np.ascontiguousarray(current_from_reference, np.float64)
    )


class Patches(NamedTuple):
    """Features of an image: its `half_pyramid`, pixels (N, 2) at level 0, octaves (N,)."""

    pyramid: Pyramid
    pixels: Array
    octaves: NDArray[np.int8]


def refine_matches(reference: Patches, current: Patches, warps: Array, settings: AlignSettings) -> Array:
    """(N, 3) x, y, sigma_px in level-0 pixels of the current image; NaN where the patches do not agree.

    warps (N, 2, 3): the first two columns are reference_from_current of offsets on a surface that faces the camera, the third one is
    the way of a pixel, for a slant of 1 and an offset of 1 (shared/core/patch_align.cpp). Each feature is aligned on the halving of the
    pyramid nearest to the scale at which it was found.
    """
    limits = settings.half_window_px, settings.max_shift_px, settings.min_correlation
    both = *_as_core(reference), *_as_core(current)
    return core.align_patches(*both, np.ascontiguousarray(warps, np.float64), *limits)


def _as_core(patches: Patches) -> tuple[Pyramid, Array, NDArray[np.int8]]:
    pixels = np.ascontiguousarray(patches.pixels, np.float64)
    return patches.pyramid, pixels, np.ascontiguousarray(patches.octaves, np.int8)


def halvings(octaves: NDArray[np.int8]) -> NDArray[np.int64]:
    """(N,) the level of `half_pyramid` nearest to the scale of each octave."""
    return np.asarray(np.clip(np.rint(octaves * np.log2(SCALE_FACTOR)), 0, 2), np.int64)
