"""Checks of the odometry: a wrong IMU, a diverged filter, standstill."""

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array, Indices, rotation_angle_rad

_DISAGREEMENT_RAD = 0.02  # between the rotation of one step by images and by gyro
_MAX_DISAGREEMENTS = 8  # surplus of disagreeing over agreeing frames, at which the IMU is abandoned
_DOUBTED = 2  # the same at which nobody knows which of the two is right: one frame may have matched wrongly
MAX_OFFSET_SIGMAS = 3.0  # a larger time offset is implausible
_DIVERGED_MPS, _MAX_DIVERGED_FRAMES = 5.0, 3  # from the speed by images, for so many consecutive frames


class DivergenceMonitor:
    """Counts disagreements with the images. Motions are cam_from_previous (4, 4), None where unknown."""

    def __init__(self, offset_sigma_s: float) -> None:
        """offset_sigma_s: initial standard deviation of the offset between the two clocks."""
        self._max_offset_s = MAX_OFFSET_SIGMAS * offset_sigma_s
        self._disagreements = 0
        self._diverged_frames = 0

    def is_wrong_imu(self, predicted: Array | None, seen: Array | None) -> bool:
        """True if images and gyro have disagreed on rotation too often, this frame included.

        Such an IMU belongs to another recording, or its mounting differs from the calibration.
        """
        if predicted is None or seen is None:
            return False
        is_off = rotation_angle_rad(predicted[:3, :3].T @ seen[:3, :3]) > _DISAGREEMENT_RAD
        self._disagreements = max(self._disagreements + (1 if is_off else -1), 0)
        return self._disagreements >= _MAX_DISAGREEMENTS

    @property
    def is_in_doubt(self) -> bool:
        """True while images and gyro contradict each other, and either may be wrong."""
        return self._disagreements >= _DOUBTED

    def is_wrong_start(self, offset_s: float, off_mps: float) -> bool:
        """True if the filter must be initialized again, this frame included; off_mps: difference between its speed and that of the images.

        A static initialization under constant acceleration is tilted by degrees. The filter then estimates an impossible
        time offset, or its speed differs from that of the images frame after frame.
        """
        if abs(offset_s) > self._max_offset_s:
            return True
        self._diverged_frames = 0 if off_mps < _DIVERGED_MPS else self._diverged_frames + 1
        return self._diverged_frames >= _MAX_DIVERGED_FRAMES

    def begin_again(self) -> None:
        """Restart the count of diverged frames, for a new filter."""
        self._diverged_frames = 0


class ZeroVelocityDetector:
    """Compares each image with the one a window earlier."""

    def __init__(self, window_s: float, limit_px: float) -> None:
        self._window_ns, self._limit_px = int(window_s * 1e9), limit_px
        self._images: list[tuple[int, Indices, Array]] = []

    def since(self, now_ns: int, ids: Indices, pixels: Array) -> tuple[int, int] | None:
        """Start of the standstill of the image, at least a window ago, and stamp of the previous image; None if it moved.

        ids (N,), pixels (N, 3) of the points seen at now_ns, later than any before.
        """
        self._images = [image for image in self._images if image[0] >= now_ns - 2 * self._window_ns]
        self._images.append((now_ns, ids, pixels))
        old = [image for image in self._images if image[0] <= now_ns - self._window_ns]
        if not old or not core.is_image_still(old[-1][1], old[-1][2], ids, pixels, self._limit_px):
            return None
        return old[-1][0], self._images[-2][0]


def middle(values: Array) -> float:
    """Median of a few values, in a tenth of numpy's time."""
    ordered = np.sort(values)
    return 0.5 * float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])
