"""Errors of a map at its places: sigmas of each tile, as the build of the map measured them."""

from collections.abc import Mapping
from typing import Annotated, NamedTuple

import msgspec
import numpy as np

from fleetmap.geometry import Array

Sigma = Annotated[float, msgspec.Meta(gt=0, le=1.0)]


class ErrorSigmas(NamedTuple):
    """Sigmas of the error of a map at a place: rotation about each axis, and position along each axis of the ground and up."""

    turn_rad: Sigma
    horizontal_m: Sigma
    up_m: Sigma


UNKNOWN_ERROR = ErrorSigmas(0.006, 0.02, 0.02)  # of what no build has measured: wide


class MapErrors(NamedTuple):
    """Errors of the tiles (x, y) of size_m; any other place has UNKNOWN_ERROR."""

    size_m: float
    by_tile: Mapping[tuple[int, int], ErrorSigmas]

    def sigmas(self, position_map_m: Array) -> Array:
        """Return (6,), rotation first in radians, then metres, in map axes, at a position (3,)."""
        x, y = np.floor(position_map_m[:2] / self.size_m)
        turn_rad, horizontal_m, up_m = self.by_tile.get((x, y), UNKNOWN_ERROR)
        return np.array([turn_rad, turn_rad, turn_rad, horizontal_m, horizontal_m, up_m])


UNKNOWN_ERRORS = MapErrors(1.0, {})
