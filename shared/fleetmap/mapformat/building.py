"""Buildings: the frame used by operators and fleet managers, the pose of `map` in it, and floors, of which each is a site with its own
map, versions and areas. Lifts are areas of the floors.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import pi
from typing import Annotated, Literal

import msgspec
import numpy as np

from fleetmap.encoding import decode_json
from fleetmap.errors import MapFormatError, UsageError
from fleetmap.geometry import Array, Rings, inside_any, se3, se3_inverse, so3_exp, transform_points
from fleetmap.mapformat.names import check_name

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
    return decode_json(data, _Alignment, "the site's alignment cannot be read ({}); run `mapserver align` again").frame


MAX_FLOORS_BYTES = 64_000
_MAX_FLOORS = 100

_Text = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


class FloorEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One floor: its site, its level's name for fleet managers, and the height of its map's z = 0 in the building."""

    site: _Text
    level: _Text
    height_m: Coordinate


class Building(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The floors of a building, from below; the same bytes are a file (kind FLOORS) of each of its sites."""

    name: _Text
    floors: Annotated[tuple[FloorEntry, ...], msgspec.Meta(min_length=2, max_length=_MAX_FLOORS)]


@dataclass(frozen=True)
class Floor:
    """A floor with the pose of its map in the building, and the polygons of its lifts in its `map`, by the lift's name."""

    entry: FloorEntry
    frame: BuildingFrame
    lifts: Mapping[str, tuple[Rings, ...]] = field(default_factory=dict)

    @property
    def building_from_map(self) -> Array:
        """(4, 4), with the floor's height."""
        building_from_map = self.frame.building_from_map.copy()
        building_from_map[2, 3] += self.entry.height_m
        return building_from_map

    def lifts_at(self, position_m: Array, reach_m: float) -> frozenset[str]:
        """Return the lifts whose outlines hold a position (2,) or are at most reach_m from it: several of a bank of lifts."""
        return frozenset(
            name
            for name, polygons in self.lifts.items()
            if inside_any(position_m[None], polygons)[0]
            or min(edge_distance_m(position_m, rings) for rings in polygons) <= reach_m
        )


def read_building(data: bytes) -> Building:
    """Read a site's file of kind FLOORS, with its floors from below; MapFormatError for anything else, and for repeated sites, levels or
    heights.
    """
    building = decode_json(data, Building, "a building of these floors cannot be read ({}); set the building again")
    try:
        for floor in building.floors:
            check_name(floor.site, "site")
    except UsageError as error:
        raise MapFormatError(str(error)) from error
    for what in ("site", "level", "height_m"):
        values = [getattr(floor, what) for floor in building.floors]
        if twice := [value for value in values if values.count(value) > 1]:
            words = f"two floors have the same {what.removesuffix('_m')}, {twice[0]}"
            raise MapFormatError(f"building {building.name!r}: {words}")
    return msgspec.structs.replace(building, floors=tuple(sorted(building.floors, key=lambda floor: floor.height_m)))


class _Shape(msgspec.Struct):
    type: Literal["Polygon", "MultiPolygon"]
    coordinates: msgspec.Raw


class _Properties(msgspec.Struct):
    lift: str | None = None


class _Feature(msgspec.Struct):
    geometry: _Shape
    properties: _Properties


class _Areas(msgspec.Struct):
    features: list[_Feature]
    frame: Literal["map", "building"] | None = None


def read_lifts(areas: bytes | None, frame: BuildingFrame) -> dict[str, tuple[Rings, ...]]:
    """Return the lifts in a site's file of areas, as `Floor.lifts`; areas of one lift are joined. MapFormatError for an invalid file.

    frame: the site's alignment, for areas that were drawn in the building.
    """
    lifts: dict[str, tuple[Rings, ...]] = {}
    try:
        read = _Areas([]) if areas is None else msgspec.json.decode(areas, type=_Areas)
        for feature in read.features:
            if feature.properties.lift is None:
                continue
            drawn = feature.geometry.coordinates
            several = b"[%b]" % drawn if feature.geometry.type == "Polygon" else drawn
            for polygon in msgspec.json.decode(several, type=list[list[list[list[float]]]]):
                rings = [np.array([corner[:2] for corner in ring[:-1]], float) for ring in polygon]
                if not rings or not all(r.ndim == 2 and r.shape[1] == 2 and len(r) >= 3 for r in rings):
                    raise ValueError(f"lift {feature.properties.lift[:64]!r} has no outline")
                if read.frame == "building":
                    map_from_building = se3_inverse(frame.building_from_map)
                    rings = [transform_points(map_from_building, np.c_[r, np.zeros(len(r))])[:, :2] for r in rings]
                lifts[feature.properties.lift] = (*lifts.get(feature.properties.lift, ()), tuple(rings))
    except (msgspec.MsgspecError, ValueError, IndexError) as error:
        raise MapFormatError(f"the site's areas cannot be read ({error}); import them again") from error
    return lifts


def edge_distance_m(position_m: Array, rings: Iterable[Array]) -> float:
    """Return the distance of a position (2,) from the nearest edge of the rings, as of `inside_rings`."""
    nearest_m = np.inf
    for ring in rings:
        edges, to = np.roll(ring, -1, axis=0) - ring, position_m - ring
        along = np.clip((to * edges).sum(axis=1) / np.maximum((edges**2).sum(axis=1), 1e-12), 0.0, 1.0)
        nearest_m = min(nearest_m, float(np.linalg.norm(to - along[:, None] * edges, axis=1).min()))
    return nearest_m
