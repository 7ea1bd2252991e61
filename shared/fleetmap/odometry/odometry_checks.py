"""Checks of what the odometry gets and makes: faults of an IMU, a wrong IMU, a diverged filter, standstill."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, rotation_angle_rad, se3_inverse
from fleetmap.odometry.tracking import tracker_kernels
from fleetmap.sensors.samples import ImuSamples

_DISAGREEMENT_RAD = 0.02  # between the rotation of one step by images and by gyro
_MAX_DISAGREEMENTS = 8  # frames that disagree beyond those that agree, before the IMU is given up
_MAX_OFFSET_SIGMAS = 3.0  # a larger time offset cannot be one
_DIVERGED_M, _MAX_DIVERGED_FRAMES = 0.5, 3  # from the motion of one step by images, for so many frames in a row


class DivergenceMonitor:
    """Counts disagreements with the images. Motions are cam_from_previous (4, 4), None where unknown."""

    def __init__(self, offset_sigma_s: float) -> None:
        """offset_sigma_s: of the time between the two clocks before anything was seen."""
        self._max_offset_s = _MAX_OFFSET_SIGMAS * offset_sigma_s
        self._disagreements = 0
        self._diverged_frames = 0

    def is_wrong_imu(self, predicted: Array | None, seen: Array | None) -> bool:
        """Whether images and gyro have disagreed on rotation too often, this frame included.

        Such an IMU belongs to another recording, or its mounting differs from the calibration.
        """
        if predicted is None or seen is None:
            return False
        off_rad = rotation_angle_rad(predicted[:3, :3].T @ seen[:3, :3])
        self._disagreements = max(self._disagreements + (1 if off_rad > _DISAGREEMENT_RAD else -1), 0)
        return self._disagreements >= _MAX_DISAGREEMENTS

    def is_wrong_start(self, offset_s: float, predicted: Array | None, seen: Array | None) -> bool:
        """Whether the filter must be initialized again, this frame included.

        A static initialization under constant acceleration is tilted by degrees. The filter then estimates an impossible
        time offset, or its motion differs from that of the images frame after frame.
        """
        if abs(offset_s) > self._max_offset_s:
            return True
        if predicted is None or seen is None:
            return False
        off_m = float(np.linalg.norm((predicted @ se3_inverse(seen))[:3, 3]))
        self._diverged_frames = 0 if off_m < _DIVERGED_M else self._diverged_frames + 1
        return self._diverged_frames >= _MAX_DIVERGED_FRAMES

    def begin_again(self) -> None:
        """Starts the count of diverged frames anew, for a new filter."""
        self._diverged_frames = 0


# No body that carries cameras changes so much between two samples and back.
_SPIKE_RADPS, _SPIKE_MPS2 = 6.0, 40.0


def joined(parts: Sequence[ImuSamples]) -> ImuSamples:
    """The parts one after another."""
    return ImuSamples(
        np.concatenate([p.stamps_ns for p in parts]),
        np.concatenate([p.gyro_radps for p in parts]),
        np.concatenate([p.accel_mps2 for p in parts]),
    )


def without_spikes(known: ImuSamples, new: ImuSamples) -> ImuSamples:
    """Known samples and the new ones after them, without spikes: new samples far from both neighbours.

    The last sample is judged by one neighbour alone; the very first one has none and stays.
    """
    if not len(new):
        return known
    tail = min(len(known), 1)
    around = joined([ImuSamples(known.stamps_ns[-1:], known.gyro_radps[-1:], known.accel_mps2[-1:]), new])
    off = _off_neighbours(around.gyro_radps, _SPIKE_RADPS) | _off_neighbours(around.accel_mps2, _SPIKE_MPS2)
    keep = ~off[tail:]
    return joined([known, ImuSamples(new.stamps_ns[keep], new.gyro_radps[keep], new.accel_mps2[keep])])


def _off_neighbours(values: Array, limit: float) -> NDArray[np.bool_]:
    """(N,) whether rows (N, 3) differ from the row before and from the row after by more than the limit."""
    jumps: NDArray[np.bool_] = np.linalg.norm(np.diff(values, axis=0), axis=1) > limit
    if not len(jumps):
        return np.zeros(len(values), bool)
    ends = np.concatenate([[False], jumps, [True]])
    return np.asarray(ends[:-1] & ends[1:])


def longest_gap_ns(imu: ImuSamples, start_ns: int, end_ns: int) -> int:
    """The longest time between start and end, both included, without a sample."""
    inside = imu.between(start_ns, end_ns + 1).stamps_ns
    before = imu.stamps_ns[np.searchsorted(imu.stamps_ns, start_ns, side="right") - 1 :][:1]
    after = imu.stamps_ns[np.searchsorted(imu.stamps_ns, end_ns) :][:1]
    first = before if len(before) and before[0] <= start_ns else np.array([start_ns])
    last = after if len(after) else np.array([end_ns])
    edges = np.concatenate([first, inside, last])
    return int(np.diff(edges).max())


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
