"""Corners to track: FAST candidates ranked by how well they can be tracked, spread over the image."""

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.geometry import Array
from fleetmap.sensors.samples import Image

Pixels = NDArray[np.float32]


def fast_corners(image: Image, threshold: int, border_px: int = 3, free: NDArray[np.uint8] | None = None) -> Pixels:
    """(N, 2) whole-pixel FAST corners of `image`, non-maximum suppressed, at least border_px from its edges.

    free (H, W): 0 where none is wanted. Source: Rosten and Drummond 2006, nine of sixteen pixels.
    """
    return core.fast_corners(np.ascontiguousarray(image), threshold, max(border_px, 3), free)


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
    image, (height, width) = np.ascontiguousarray(image), image.shape
    held, free = np.zeros((0, 2), np.float32), None
    if taken is not None and len(taken):
        held, free = np.ascontiguousarray(taken, np.float32), np.full(image.shape, 255, np.uint8)
        core.clear_discs(free, held, min_distance_px)
    candidates = corner_candidates(image, 2 * count, threshold, border_px, free)
    scores = core.min_eigenvalue_scores(image, candidates)
    shown = scores > 0
    return select_best(candidates[shown], scores[shown], held, min_distance_px, count, (width, height))


def select_best(
    candidates: Pixels, scores: Array, taken: Pixels, min_distance_px: float, count: int, size_px: tuple[int, int]
) -> Pixels:
    """Up to `count` candidates (N, 2), the best first, none within min_distance_px of another or of `taken`, in an image of that size.

    Only the better ones are put in order, as long as they are enough.
    """
    for most in (4 * count, len(scores)):
        if most < len(scores):
            better = np.flatnonzero(scores >= np.partition(scores, -most)[-most])
        else:
            better = np.arange(len(scores))
        order = better[np.argsort(-scores[better], kind="stable")]
        chosen = core.select_spread(candidates, order, taken, min_distance_px, count, *size_px)
        if len(chosen) == count or len(better) == len(scores):
            break
    return np.asarray(candidates[chosen])
