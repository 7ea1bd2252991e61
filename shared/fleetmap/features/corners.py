"""Corners to track: FAST candidates ranked by how well they can be tracked, spread over the image."""

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.features.corner_kernels import clear_discs, min_eigenvalue_scores, select_spread
from fleetmap.sensors.samples import Image

Pixels = NDArray[np.float32]
_HALF_WINDOW = 3
_FAST_BORDER_PX = 3  # of the circle that FAST looks at


def fast_corners(image: Image, threshold: int, border_px: int = 3, free: NDArray[np.uint8] | None = None) -> Pixels:
    """(N, 2) whole-pixel FAST corners of `image`, non-maximum suppressed, at least border_px from its edges.

    free (H, W): 0 where none is wanted. Every corner is an object of OpenCV first, which costs more than to find it: what is not
    wanted is left out before.
    """
    height, width = image.shape
    off = border_px - _FAST_BORDER_PX - 1  # one more row, for the suppression
    if off <= 0 or height <= 2 * border_px or width <= 2 * border_px:
        part, mask, off = image, free, 0
    else:
        part = image[off : height - off, off : width - off]
        mask = None if free is None else free[off : height - off, off : width - off]
    keypoints = cv2.FastFeatureDetector.create(threshold, True).detect(part, mask)
    if not keypoints:
        return np.zeros((0, 2), np.float32)
    pixels = np.asarray(cv2.KeyPoint.convert(keypoints), np.float32).reshape(-1, 2) + np.float32(off)
    inside = (
        (pixels[:, 0] >= border_px)
        & (pixels[:, 1] >= border_px)
        & (pixels[:, 0] < width - border_px)
        & (pixels[:, 1] < height - border_px)
    )
    return np.asarray(pixels[inside])


def corner_candidates(
    image: Image, enough: int, threshold: int, border_px: int, free: NDArray[np.uint8] | None = None
) -> Pixels:
    """FAST corners as of `fast_corners`, by half the threshold where the whole image has fewer than `enough`."""
    found = fast_corners(image, threshold, border_px, free)
    if len(found) >= enough or len(fast_corners(image, threshold)) >= enough:
        return found
    return fast_corners(image, max(threshold // 2, 4), border_px, free)


def spread_corners(
    image: Image,
    count: int,
    *,
    min_distance_px: float,
    taken: Pixels | None = None,
    threshold: int = 12,
    border_px: int = 8,
) -> Pixels:
    """Up to `count` corners (N, 2), best first, at least min_distance_px from each other and from `taken` (M, 2).

    The threshold is lowered once where the image is too plain to give them.
    """
    height, width = image.shape
    held, free = np.zeros((0, 2), np.float32), None
    if taken is not None and len(taken):
        held, free = taken.astype(np.float32), np.full(image.shape, 255, np.uint8)
        clear_discs(free, held, min_distance_px)
    candidates = corner_candidates(image, 2 * count, threshold, border_px, free)
    scores = min_eigenvalue_scores(image, candidates, _HALF_WINDOW)
    order = np.argsort(-scores, kind="stable")
    order = order[scores[order] > 0]
    return np.asarray(candidates[select_spread(candidates, order, held, min_distance_px, count, width, height)])
