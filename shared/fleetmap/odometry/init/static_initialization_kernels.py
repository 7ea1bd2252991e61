"""Inner loops of the search for a steady IMU in the last seconds of samples."""

import math

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel

PARTS = 10  # of a window whose means must agree; it has twice as many samples at least


@kernel
def is_steady(gyro: Array, accel: Array, limits: Array) -> bool:
    """Whether the means of the parts of a window, gyro and accel (N, 3), agree, and are those of a body at rest or rolling evenly.

    limits: largest standard deviation of the parts' means of gyro and of accel, largest mean of gyro, size of gravity and by how
    much it may be missed.
    """
    count = len(gyro)
    means, total, spread = np.zeros((PARTS, 6)), np.zeros(6), np.zeros(6)
    for part in range(PARTS):
        first = int(part * (count / PARTS))
        last = count if part == PARTS - 1 else int((part + 1) * (count / PARTS))
        for n in range(first, last):
            for a in range(3):
                means[part, a] += gyro[n, a]
                means[part, 3 + a] += accel[n, a]
        means[part] /= last - first
        total += means[part] / PARTS
    for part in range(PARTS):
        off = means[part] - total
        spread += off * off / PARTS
    turning = math.sqrt(total[0] * total[0] + total[1] * total[1] + total[2] * total[2])
    force = math.sqrt(total[3] * total[3] + total[4] * total[4] + total[5] * total[5])
    return bool(
        math.sqrt(spread[:3].max()) < limits[0]
        and math.sqrt(spread[3:].max()) < limits[1]
        and turning < limits[2]
        and abs(force - limits[3]) < limits[4]
    )


@kernel
def latest_steady(
    stamps_ns: NDArray[np.int64], gyro: Array, accel: Array, first_ns: int, until_ns: int, window_ns: int, limits: Array
) -> int:
    """End of the latest steady window, by quarters of a window back from until_ns, none of which begins before first_ns.

    A stamp before first_ns where there is none.
    """
    end_ns = until_ns
    while end_ns - window_ns >= first_ns:
        a, b = np.searchsorted(stamps_ns, end_ns - window_ns), np.searchsorted(stamps_ns, end_ns)
        if b - a >= 2 * PARTS and is_steady(gyro[a:b], accel[a:b], limits):
            return end_ns
        end_ns -= window_ns // 4
    return first_ns - 1
