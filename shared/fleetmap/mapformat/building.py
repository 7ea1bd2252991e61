"""The building's frame, used by operators and fleet managers, and the pose of `map` in it."""

from math import pi
from typing import Annotated

import msgspec
import numpy as np

from fleetmap.errors import MapFormatError
from fleetmap.geometry import Array, se3, so3_exp

BUILDING_KEY = "building"
"""Key in `configuration` of a manifest, where older readers ignore it: elsewhere format 1 refuses unknown keys."""

ALIGNMENT, AREAS, FLOORS = FOR_ROBOTS = ("alignment", "areas", "floors")
"""Kinds of a site's further files, beside its versions, which robots may fetch by the addresses in the signed list."""

Coordinate = Annotated[float, msgspec.Meta(ge=-1e7, le=1e7)]
Angle = Annotated[float, msgspec.Meta(ge=-pi - 1e-9, le=pi + 1e-9)]
Sigma = Annotated[float, msgspec.Meta(ge=0, le=1e7)]


class BuildingFrame(msgspec.Struct, frozen=True, kw_only=True):
    """The origin of `map` in building coordinates (metres), and the direction of its x axis (radians, counter-clockwise).

    Both share the floor: z and the vertical are those of `map`. sigma_m: of a position amid the points of the alignment.
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
