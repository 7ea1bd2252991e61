"""Corners to track: FAST candidates ranked by how well they can be tracked, spread over the image."""

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.features.corner_kernels import min_eigenvalue_scores, select_spread
from fleetmap.sensors.samples import Image

Pixels = NDArray[np.float32]
_HALF_WINDOW = 3


def fast_corners(image: Image, threshold: int) -> Pixels:
    """(N, 2) whole-pixel FAST corners of `image`, non-maximum suppressed."""
    keypoints = cv2.FastFeatureDetector.create(threshold, True).detect(image, None)
    if not keypoints:
        return np.zeros((0, 2), np.float32)
    return np.asarray(cv2.KeyPoint.convert(keypoints), np.float32).reshape(-1, 2)


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
    held = np.zeros((0, 2), np.float32) if taken is None else taken.astype(np.float32)
    candidates = fast_corners(image, threshold)
    if len(candidates) < 2 * count:
        candidates = fast_corners(image, max(threshold // 2, 4))
    inside = (
        (candidates[:, 0] >= border_px)
        & (candidates[:, 1] >= border_px)
        & (candidates[:, 0] < width - border_px)
        & (candidates[:, 1] < height - border_px)
    )
    candidates = candidates[inside]
    scores = min_eigenvalue_scores(image, candidates, _HALF_WINDOW)
    order = np.argsort(-scores, kind="stable")
    order = order[scores[order] > 0]
    return np.asarray(candidates[select_spread(candidates, order, held, min_distance_px, count, width, height)])
