"""Inner loops over IMU samples that came: spikes, gaps."""

import math

import numpy as np

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel
from fleetmap.sensors.samples import Stamps

# No body that carries cameras changes so much between two samples and back.
_SPIKE_RADPS, _SPIKE_MPS2 = 6.0, 40.0


@kernel
def _jumps(values: Array, before: int, after: int, limit: float) -> bool:
    total = 0.0
    for a in range(3):
        step = values[after, a] - values[before, a]
        total += step * step
    return math.sqrt(total) > limit


@kernel
def drop_spikes(stamps_ns: Stamps, gyro: Array, accel: Array, known: int) -> int:
    """End of the samples once spikes are gone from the rows behind the known ones, in place: what is far from both neighbours.

    Rows up to known came earlier. The last sample is judged by one neighbour alone; the very first one has none and stays.
    """
    end = len(stamps_ns)
    kept = np.ones(end - known, np.bool_)
    for n in range(max(known, 1), end):
        is_last = n == end - 1
        turns = _jumps(gyro, n - 1, n, _SPIKE_RADPS) and (is_last or _jumps(gyro, n, n + 1, _SPIKE_RADPS))
        pushes = _jumps(accel, n - 1, n, _SPIKE_MPS2) and (is_last or _jumps(accel, n, n + 1, _SPIKE_MPS2))
        kept[n - known] = not (turns or pushes)
    to = known
    for n in range(known, end):
        if kept[n - known]:
            if to < n:
                stamps_ns[to], gyro[to], accel[to] = stamps_ns[n], gyro[n], accel[n]
            to += 1
    return to


@kernel
def longest_gap_ns(stamps_ns: Stamps, start_ns: int, end_ns: int) -> int:
    """The longest time between start and end, both included, without a sample."""
    first, after = int(np.searchsorted(stamps_ns, start_ns, side="right")), int(np.searchsorted(stamps_ns, end_ns))
    before_ns = stamps_ns[first - 1] if first > 0 else start_ns
    longest_ns = 0
    for n in range(first, after):
        longest_ns = max(longest_ns, stamps_ns[n] - before_ns)
        before_ns = stamps_ns[n]
    return max(longest_ns, (stamps_ns[after] if after < len(stamps_ns) else end_ns) - before_ns)
