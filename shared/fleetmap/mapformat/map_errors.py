"""Errors of a map at its places: sigmas of each tile, as the build of the map measured them."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array


class ErrorSigmas(NamedTuple):
    """Sigmas of the error of a map at a place: rotation about each axis, and position along and across the ground."""

    turn_rad: float = 0.006
    horizontal_m: float = 0.02
    up_m: float = 0.02


UNKNOWN_ERROR = ErrorSigmas()
"""Wide values, for what no build has measured."""


class MapErrors(NamedTuple):
    """Errors of the tiles (x, y) of size_m; any other place has UNKNOWN_ERROR."""

    size_m: float
    by_tile: Mapping[tuple[int, int], ErrorSigmas]

    def sigmas(self, position_map_m: Array) -> Array:
        """Return (6,), rotation first in radians, then metres, in map axes, at a position (3,)."""
        x, y = np.floor(position_map_m[:2] / self.size_m)
        turn_rad, horizontal_m, up_m = self.by_tile.get((int(x), int(y)), UNKNOWN_ERROR)
        return np.array([turn_rad, turn_rad, turn_rad, horizontal_m, horizontal_m, up_m])


UNKNOWN_ERRORS = MapErrors(1.0, {})
