"""Numbers from well mixed bits: the same for a landmark and a frame independent of earlier queries. Arrays (N,) of uint64 throughout."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array

Words = NDArray[np.uint64]
_GOLDEN, _FIRST, _SECOND = (np.uint64(word) for word in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))
_SHIFTS = tuple(np.uint64(bits) for bits in (30, 27, 31))


def mixed(state: Words, value: Words | int) -> Words:
    """`state` with `value` mixed in. Source: splitmix64."""
    state = state + np.asarray(value).astype(np.uint64) + _GOLDEN
    state = (state ^ (state >> _SHIFTS[0])) * _FIRST
    state = (state ^ (state >> _SHIFTS[1])) * _SECOND
    return np.asarray(state ^ (state >> _SHIFTS[2]), np.uint64)


def uniform(bits: Words) -> Array:
    """0 <= x < 1."""
    return (bits >> np.uint64(11)).astype(np.float64) * (1.0 / 9007199254740992.0)


def normal(bits: Words, table: Array) -> Array:
    """Standard normals from a table whose length is a power of two: no library function whose last bit varies."""
    return table[(bits >> np.uint64(44)).astype(np.int64) & (len(table) - 1)]
