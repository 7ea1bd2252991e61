"""Development of radiance to grey levels: gain, vignetting, shot and read noise."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap.numerics.kernel import kernel


class Noise(NamedTuple):
    """Shot noise of variance `shot` * value, read noise of standard deviation `read`, both in grey levels.

    normals: table of standard normals, its length a power of two; each row starts at a place mixed from `key`.
    """

    shot: float
    read: float
    normals: NDArray[np.float32]
    key: int


@kernel
def develop(
    radiance: NDArray[np.float64],
    gain: float,
    noise: Noise,
    vignetting: NDArray[np.float32],
    image: NDArray[np.uint8],
) -> None:
    """Fills `image` (H, W) with gain * vignetting * radiance plus noise, clipped. Source of the mixing: splitmix64."""
    shot, read, normals, noise_key = noise
    height, width = radiance.shape
    mask = normals.shape[0] - 1
    state = np.uint64(noise_key) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(0x1234567)
    for y in range(height):
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state = (state ^ (state >> np.uint64(31))) + np.uint64(0x9E3779B97F4A7C15)
        start = int(state >> np.uint64(40))
        for x in range(width):
            value = radiance[y, x] * gain * vignetting[y, x]
            value += normals[(start + x) & mask] * math.sqrt(read * read + shot * value)
            image[y, x] = np.uint8(min(max(value + 0.5, 0.0), 255.0))
