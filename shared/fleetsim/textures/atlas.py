"""All textures in one flat store with their mip pyramids, the input of shading."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Texture = NDArray[np.float32]
TEXEL_M = 0.0025  # metres per texel: with a 420 px lens one texel is one pixel at 1.05 m
LEVELS = 12


class Atlas:
    """Collects textures; `add` gives each its number.

    texels: every level of every texture, row by row. table (T, 2 + LEVELS): log2 width, log2 height, offset of each level.
    """

    def __init__(self) -> None:
        self._parts: list[NDArray[np.uint8]] = []
        self._rows: list[list[int]] = []
        self._size = 0

    def add(self, image: Texture) -> int:
        """The number of `image` (sides powers of two, grey 0..255), stored with all its coarser levels."""
        height, width = image.shape
        assert width & (width - 1) == 0
        assert height & (height - 1) == 0
        offsets = []
        level = np.asarray(image, np.float32)
        while True:
            offsets.append(self._size)
            texels = np.clip(np.rint(level), 0, 255).astype(np.uint8).ravel()
            self._parts.append(texels)
            self._size += texels.size
            if level.size == 1:
                break
            if level.shape[0] > 1:
                level = 0.5 * (level[0::2] + level[1::2])
            if level.shape[1] > 1:
                level = 0.5 * (level[:, 0::2] + level[:, 1::2])
        offsets += [offsets[-1]] * (LEVELS - len(offsets))
        self._rows.append([width.bit_length() - 1, height.bit_length() - 1, *offsets])
        return len(self._rows) - 1

    @cached_property
    def texels(self) -> NDArray[np.uint8]:
        return np.concatenate(self._parts)

    @cached_property
    def table(self) -> NDArray[np.int32]:
        return np.array(self._rows, np.int32)
