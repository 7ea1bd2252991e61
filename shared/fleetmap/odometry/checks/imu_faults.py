"""Faults of an IMU that its samples show: spikes and gaps."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.sensors.samples import ImuSamples

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
