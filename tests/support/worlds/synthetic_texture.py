"""Band-limited pictures that are exact at every sub-pixel place, so that no resampling biases a test."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array

Texture = Callable[[Array, Array], Array]


def smooth_texture(rng: np.random.Generator, *, shortest_px: float = 7.0, longest_px: float = 60.0) -> Texture:
    """A sum of plane waves: grey value (as given, 0 to 255) of real-valued pixel coordinates u, v of any shape."""
    waves = 60
    lengths = np.exp(rng.uniform(np.log(shortest_px), np.log(longest_px), waves))
    angles, phases = rng.uniform(0, 2 * np.pi, waves), rng.uniform(0, 2 * np.pi, waves)
    waves_u, waves_v = 2 * np.pi * np.cos(angles) / lengths, 2 * np.pi * np.sin(angles) / lengths

    def grey(u: Array, v: Array) -> Array:
        total = np.zeros(np.broadcast(u, v).shape)
        for wave_u, wave_v, phase in zip(waves_u, waves_v, phases, strict=True):
            total += np.sin(wave_u * u + wave_v * v + phase)
        return np.asarray(np.clip(128 + 90 * total / np.sqrt(waves), 0, 255))

    return grey


def picture(texture: Texture, u: Array, v: Array) -> NDArray[np.uint8]:
    """The texture at coordinates u, v (H, W), rounded to bytes."""
    return np.rint(texture(u, v)).astype(np.uint8)


def pixel_grid(width: int, height: int) -> tuple[Array, Array]:
    """u, v (height, width) of every pixel."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return u, v
