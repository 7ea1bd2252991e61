"""Disparities of whole pictures, and the ground height below the camera."""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import Array, Array32
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera

DENSE_SIGMA_PX = 0.3  # of a disparity of the matcher on textured surfaces
STEP_PX, BLOCK_PX = core.DENSE_STEP_PX, core.DENSE_BLOCK_PX
_NEAREST_M, _FRACTIONS = 0.6, core.DENSE_FRACTIONS
_SPECKLE_SHARE, _SPECKLE_RANGE_PX, _SMALLER = 5000, 2, 4
_FLOOR_REACH_M, _FLOOR_BIN_M, _MIN_FLOOR_POINTS = 4.0, 0.02, 100
_FLOOR_APART_M, _FLOOR_SHARE = 0.05, 0.6


def dense_disparity(frame: RectifiedFrame, camera: StereoCamera, settings: StereoSettings) -> tuple[Array32, float]:
    """Return disparities of every STEP_PX-th pixel each way, NaN if unknown, and their standard deviation in pixels.

    From the depth sensor if present. A pair is matched in both directions; areas without texture are unknown.
    """
    if frame.disparity_px is not None:
        return np.ascontiguousarray(frame.disparity_px[::STEP_PX, ::STEP_PX]), settings.depth_sigma_px
    assert frame.right is not None
    farthest_px = min(camera.focal_px * camera.baseline_m / _NEAREST_M, 0.4 * camera.width_px, core.DENSE_MOST_PX)
    # The largest disparity is found in small pictures: the matcher's time goes by its range.
    small = _matched(_smaller(frame.left), _smaller(frame.right), farthest_px / _SMALLER)
    nearest_px = _SMALLER * (float(small.max(initial=0)) / _FRACTIONS + 1.0)
    found = _matched(frame.left, frame.right, min(farthest_px, nearest_px))
    return np.where(found > 0, found / np.float32(_FRACTIONS), np.float32(np.nan)), DENSE_SIGMA_PX


def _matched(left: NDArray[np.uint8], right: NDArray[np.uint8], farthest_px: float) -> NDArray[np.int16]:
    """Return a pair's disparities in _FRACTIONS of a pixel, 0 if unknown, without small patches."""
    found = core.match_densely(left, right, farthest_px)
    cv2.filterSpeckles(found, 0, found.size // _SPECKLE_SHARE, _SPECKLE_RANGE_PX * _FRACTIONS)
    return found


def _smaller(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size = picture.shape[1] // _SMALLER, picture.shape[0] // _SMALLER
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def nearest_around(disparity_px: Array32, reach_px: int) -> Array32:
    """Return the largest disparity around each of `dense_disparity`, 0 if unknown."""
    block = np.ones((2 * (reach_px // STEP_PX) + 1,) * 2, np.uint8)
    return np.asarray(cv2.dilate(np.fmax(disparity_px, np.float32(0.0)), block), np.float32)


def floor_distance_m(images: Iterable[tuple[Array32, Array]], camera: StereoCamera) -> float | None:
    """Return the distance of the ground below the camera, of some images by `dense_disparity` and map_from_cam (4, 4).

    Per view the most frequent height of near points below the camera; the median, if most images agree. None if
    they do not: the camera is carried by hand, or the map is not level.
    """
    found = []
    for disparity_px, map_from_cam in images:
        v, u = np.nonzero(disparity_px > camera.focal_px * camera.baseline_m / _FLOOR_REACH_M)
        pixels = np.stack([u, v], axis=1).astype(np.float64) * STEP_PX
        points = camera.point_from_pixel(pixels, disparity_px[v, u].astype(np.float64))
        below_m = -(points @ map_from_cam[2, :3])
        counts = np.bincount((below_m[below_m > 0.1] / _FLOOR_BIN_M).astype(np.int64), minlength=3)
        smooth = np.convolve(counts, np.ones(3), "same")
        if smooth.max() >= _MIN_FLOOR_POINTS:
            near = np.abs(below_m - (int(smooth.argmax()) + 0.5) * _FLOOR_BIN_M) < 1.5 * _FLOOR_BIN_M
            found.append(float(np.median(below_m[near])))
    if not found:
        return None
    middle = float(np.median(found))
    return middle if np.mean(np.abs(np.array(found) - middle) < _FLOOR_APART_M) >= _FLOOR_SHARE else None
