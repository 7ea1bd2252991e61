"""Sub-pixel positions of matched features: the match finds the correspondence, the patch gives the coordinate."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.features.patch_align_kernels import align_patches
from fleetmap.features.settings import AlignSettings
from fleetmap.geometry import Array, transform_points
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import Image

Pyramid = tuple[Image, ...]
_LEVELS = 3


def half_pyramid(image: Image) -> Pyramid:
    """The image and its halvings; a level-0 pixel (x, y) lies at (x, y) / 2^level."""
    levels = [image]
    for _ in range(_LEVELS - 1):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.uint8))
    return tuple(levels)


def similarity_from_features(
    octaves_reference: NDArray[np.int8],
    angles_reference_deg: NDArray[np.floating],
    octaves_current: NDArray[np.int8],
    angles_current_deg: NDArray[np.floating],
) -> Array:
    """(N, 2, 2) reference_from_current for level-0 offsets, from two features' octaves and orientations."""
    scale = SCALE_FACTOR ** (octaves_reference.astype(np.float64) - octaves_current)
    angle = np.radians(angles_reference_deg.astype(np.float64) - angles_current_deg)
    cosine, sine = scale * np.cos(angle), scale * np.sin(angle)
    return np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], 1)


def similarity_from_motion(camera: StereoCamera, points_reference: Array, current_from_reference: Array) -> Array:
    """(N, 2, 2) reference_from_current for pixel offsets around points (N, 3).

    Each point lies on a plane that faces the reference camera. NaN where the warp is degenerate.
    """
    focal = camera.focal_px
    step = 0.01 * points_reference[:, 2:3]
    middle = camera.pixel_from_point(transform_points(current_from_reference, points_reference))[:, :2]
    columns = []
    for axis in range(2):
        shifted = points_reference.copy()
        shifted[:, axis] += step[:, 0]
        moved = camera.pixel_from_point(transform_points(current_from_reference, shifted))[:, :2]
        columns.append((moved - middle) / (focal * step / points_reference[:, 2:3]))
    current_from_reference_px = np.stack(columns, axis=2)
    determinant = np.linalg.det(np.nan_to_num(current_from_reference_px, nan=1.0))
    usable = (
        np.isfinite(current_from_reference_px).all(axis=(1, 2))
        & (np.abs(determinant) > 0.02)
        & (np.abs(determinant) < 50)
    )
    out = np.full((len(points_reference), 2, 2), np.nan)
    out[usable] = np.linalg.inv(current_from_reference_px[usable])
    return out


class Patches(NamedTuple):
    """Features of an image: its `half_pyramid`, pixels (N, 2) at level 0, octaves (N,)."""

    pyramid: Pyramid
    pixels: Array
    octaves: NDArray[np.int8]


def refine_matches(
    reference: Patches, current: Patches, reference_from_current: Array, settings: AlignSettings
) -> Array:
    """(N, 3) x, y, sigma_px in level-0 pixels of the current image; NaN where the patches do not agree.

    reference_from_current (N, 2, 2) warps offsets. Each feature is aligned on the halving of the pyramid nearest to the
    scale at which it was found.
    """
    out = np.full((len(reference.pixels), 3), np.nan)
    level_ref, level_cur = halvings(reference.octaves), halvings(current.octaves)
    for a in range(_LEVELS):
        for b in range(_LEVELS):
            index = np.flatnonzero((level_ref == a) & (level_cur == b))
            if not len(index):
                continue
            found, warp = np.empty((len(index), 4)), reference_from_current[index] * 2.0 ** (b - a)
            pixels_a = np.ascontiguousarray(reference.pixels[index] / 2.0**a)
            pixels_b = np.ascontiguousarray(current.pixels[index] / 2.0**b)
            images, limits = (
                (reference.pyramid[a], current.pyramid[b]),
                (settings.half_window_px, settings.max_shift_px),
            )
            align_patches(*images, pixels_a, pixels_b, warp, *limits, found)
            found[~(found[:, 3] >= settings.min_correlation)] = np.nan
            out[index] = found[:, :3] * 2.0**b
    return out


def halvings(octaves: NDArray[np.int8]) -> NDArray[np.int64]:
    """(N,) the level of `half_pyramid` nearest to the scale of each octave."""
    return np.asarray(np.clip(np.rint(octaves * np.log2(SCALE_FACTOR)), 0, _LEVELS - 1), np.int64)
