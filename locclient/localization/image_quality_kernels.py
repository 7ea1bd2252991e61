"""Sums over the pixels of an image that measure brightness and sharpness; integers, so exact."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.numerics.kernel import kernel

Grey = NDArray[np.uint8]


@kernel
def thin(image: Grey, every: int, bright: int, small: Grey) -> tuple[int, int, int]:
    """Fills `small` with each every-th pixel of each every-th row; returns its sum, its squares' and how many are bright."""
    total, squares, brights = 0, 0, 0
    for v in range(small.shape[0]):
        row, out = image[v * every], small[v]
        for u in range(len(out)):
            value = row[u * every]
            out[u] = value
            total += int(value)
            squares += int(value) * int(value)
            brights += value >= bright
    return total, squares, brights


@kernel
def row_steps(image: Grey, every: int) -> tuple[int, int, int]:
    """Number, sum and sum of squares of the steps from pixel to pixel along each every-th row."""
    count, total, squares = 0, 0, 0
    for v in range(0, image.shape[0], every):
        row = image[v]
        step_sum, square_sum = np.int32(0), np.int32(0)  # of one row: narrow enough for many at once
        for u in range(len(row) - 1):
            step = np.int32(row[u + 1]) - np.int32(row[u])
            step_sum = np.int32(step_sum + step)
            square_sum = np.int32(square_sum + step * step)
        count, total, squares = count + len(row) - 1, total + int(step_sum), squares + int(square_sum)
    return count, total, squares
