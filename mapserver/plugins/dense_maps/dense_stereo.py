"""Disparities of whole pictures, and the ground height below the camera. Source of the matcher: Hirschmueller 2008, in OpenCV's version."""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.features.settings import StereoSettings
from fleetmap.geometry import AnyArray, Array
from fleetmap.sensors.rectification import RectifiedFrame, StereoCamera

DENSE_SIGMA_PX = 0.3  # of a disparity of the matcher on textured surfaces
_ROW_STEP, _BLOCK = 2, 3
BLOCK_PX = _ROW_STEP * (_BLOCK - 1) + 3  # rows that a disparity depends on: of a block, each smoothed over three
_NEAREST_M, _FRACTIONS = 0.6, 16
_ROWS = np.array([[1.0], [2.0], [1.0]], np.float32) / 4
_SMOOTH, _SPECKLE_SHARE, _SMALLER = 16 * _BLOCK * _BLOCK, 3000, 4
_MIN_TEXTURE, _TEXTURE_PX = 1.5, 9  # mean horizontal gradient in grey levels, of a square around the pixel
_FLOOR_REACH_M, _FLOOR_BIN_M, _MIN_FLOOR_POINTS = 4.0, 0.02, 400
_FLOOR_APART_M, _FLOOR_SHARE = 0.05, 0.6


def dense_disparity(
    frame: RectifiedFrame, camera: StereoCamera, settings: StereoSettings
) -> tuple[NDArray[np.float32], float]:
    """Return (H, W) disparities of the left picture, NaN if unknown, and their standard deviation in pixels.

    From the depth sensor if present. A pair is matched in both directions; areas without texture are unknown.
    """
    if frame.disparity_px is not None:
        return frame.disparity_px, settings.depth_sigma_px
    assert frame.right is not None
    farther_px = min(camera.focal_px * camera.baseline_m / _NEAREST_M, 0.4 * camera.width_px)
    nearest_px = min(farther_px, _largest_disparity_px(frame.left, frame.right, farther_px))
    # Rows weigh little in a disparity, and the time goes by them: every second one is matched, smoothed as far as it stands for.
    left, right = (cv2.filter2D(picture, -1, _ROWS)[::_ROW_STEP].copy() for picture in (frame.left, frame.right))
    rows = _between(_matched(left, right, nearest_px), len(frame.left))
    gradient = np.abs(cv2.Sobel(frame.left, cv2.CV_32F, 1, 0, ksize=3)) / np.float32(8.0)
    is_textured = cv2.blur(gradient, (_TEXTURE_PX, _TEXTURE_PX)) >= _MIN_TEXTURE
    return np.where(is_textured, rows, np.float32(np.nan)), DENSE_SIGMA_PX


def _matched(left: AnyArray, right: AnyArray, nearest_px: float) -> NDArray[np.float32]:
    """Return the disparities of a pair of grey pictures up to `nearest_px`, NaN if unknown."""
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=16 * int(np.ceil(nearest_px / 16)),
        blockSize=_BLOCK,
        P1=_SMOOTH,
        P2=4 * _SMOOTH,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=10,
        speckleWindowSize=left.size // _SPECKLE_SHARE,
        speckleRange=2,
        mode=cv2.StereoSGBM_MODE_SGBM_3WAY,
    )
    disparity = matcher.compute(left, right).astype(np.float32) / np.float32(_FRACTIONS)
    return np.where(disparity > 0.5, disparity, np.float32(np.nan))


def _largest_disparity_px(left: NDArray[np.uint8], right: NDArray[np.uint8], farther_px: float) -> float:
    """Return the largest disparity of a pair, found in small pictures: a matcher's time and its blind left edge go by its range."""
    small = [
        cv2.resize(each, None, fx=1 / _SMALLER, fy=1 / _SMALLER, interpolation=cv2.INTER_AREA) for each in (left, right)
    ]
    disparity = _matched(small[0], small[1], farther_px / _SMALLER)
    return _SMALLER * (float(np.nanmax(disparity, initial=0.0)) + 1.0)


def _between(rows: NDArray[np.float32], height: int) -> NDArray[np.float32]:
    """Return (height, W) disparities from those of every second row: means of like neighbours between them, NaN elsewhere."""
    every = np.full((height, rows.shape[1]), np.float32(np.nan))
    every[::_ROW_STEP] = rows
    above, below = rows[: (height - 1) // 2], rows[1 : 1 + (height - 1) // 2]
    every[1 : height - 1 : _ROW_STEP] = np.where(np.abs(above - below) <= 1.0, (above + below) / 2, np.float32(np.nan))
    return every


def nearest_around(disparity_px: NDArray[np.float32], reach_px: int) -> NDArray[np.float32]:
    """Return (H, W) the largest disparity around each pixel, 0 if unknown."""
    block = np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)
    return np.asarray(cv2.dilate(np.fmax(disparity_px, np.float32(0.0)), block), np.float32)


def floor_distance_m(images: Iterable[tuple[NDArray[np.float32], Array]], camera: StereoCamera) -> float | None:
    """Return the distance of the ground below the camera, from disparities (H, W) and map_from_cam (4, 4) of some images.

    Per view the most frequent height of near points below the camera; the median, if most images agree. None if
    they do not: the camera is carried by hand, or the map is not level.
    """
    found = []
    for disparity_px, map_from_cam in images:
        v, u = np.nonzero(disparity_px > camera.focal_px * camera.baseline_m / _FLOOR_REACH_M)
        pixels = np.stack([u, v], axis=1).astype(np.float64)
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
