"""The building's frame, in which people and fleet managers speak of places: where the origin of `map` stands in it."""

from math import pi
from typing import Annotated

import msgspec
import numpy as np

from fleetmap.errors import MapFormatError
from fleetmap.geometry import Array, se3, so3_exp

BUILDING_KEY = "building"
"""In `configuration` of a manifest, where readers of before look over it: format 1 refuses keys that it does not know elsewhere."""

ALIGNMENT, AREAS = FOR_ROBOTS = ("alignment", "areas")
"""Kinds of what a site keeps beside its versions and robots may have, by the address that the site's signed list names."""

Coordinate = Annotated[float, msgspec.Meta(ge=-1e7, le=1e7)]
Angle = Annotated[float, msgspec.Meta(ge=-pi - 1e-9, le=pi + 1e-9)]
Sigma = Annotated[float, msgspec.Meta(ge=0, le=1e7)]


class BuildingFrame(msgspec.Struct, frozen=True, kw_only=True):
    """The origin of `map` in the building (metres), and the direction of its x axis there (radians, counter-clockwise).

    The floor is the same: z and the vertical are those of `map`. sigma_m: of a position in the middle of what both were aligned by.
    """

    x_m: Coordinate
    y_m: Coordinate
    yaw_rad: Angle
    sigma_m: Sigma = 0.0
    sigma_rad: Sigma = 0.0

    @property
    def building_from_map(self) -> Array:
        """(4, 4)."""
        return se3(so3_exp(np.array([0.0, 0.0, self.yaw_rad])), np.array([self.x_m, self.y_m, 0.0]))


class _Alignment(msgspec.Struct):
    frame: BuildingFrame


def aligned_frame(data: bytes) -> BuildingFrame:
    """The frame in a site's file of kind ALIGNMENT; MapFormatError for anything else."""
    try:
        return msgspec.json.decode(data, type=_Alignment).frame
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise MapFormatError(f"the site's alignment cannot be read ({error}); run `mapserver align` again") from error
