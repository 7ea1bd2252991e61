"""Detection of standstill (ZUPT) from images."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.odometry.tracking import tracker_kernels

_MIN_POINTS = 10


class ZeroVelocityDetector:
    """Compares each image with the one of a window ago."""

    def __init__(self, window_s: float, limit_px: float) -> None:
        self._window_ns, self._limit_px = int(window_s * 1e9), limit_px
        self._images: list[tuple[int, NDArray[np.int64], Array]] = []

    def since(self, now_ns: int, ids: NDArray[np.int64], pixels: Array) -> tuple[int, int] | None:
        """Stamps since when the image has not moved, at least a window ago, and of the previous one; None where it moved.

        ids (N,), pixels (N, 3) of the points seen at now_ns, later than any before.
        """
        self._images = [image for image in self._images if image[0] >= now_ns - 2 * self._window_ns]
        self._images.append((now_ns, ids, pixels))
        old = [image for image in self._images if image[0] <= now_ns - self._window_ns]
        if not old or not is_image_still(old[-1][1], old[-1][2], ids, pixels, self._limit_px):
            return None
        return old[-1][0], self._images[-2][0]


def is_image_still(
    old_ids: NDArray[np.int64], old_pixels: Array, ids: NDArray[np.int64], pixels: Array, limit_px: float
) -> bool:
    """Whether most of at least ten points seen in both images, pixels (N, 3), have stayed within the limit; ids ascend."""
    ways_px = np.empty(len(ids))
    count = tracker_kernels.ways_of_common(old_ids, old_pixels, ids, pixels, ways_px)
    return count >= _MIN_POINTS and middle(ways_px[:count]) < limit_px


def middle(values: Array) -> float:
    """The median of some values, at a tenth of numpy's cost for so few."""
    ordered = np.sort(values)
    return 0.5 * float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])
