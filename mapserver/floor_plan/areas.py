"""Named areas of a site, such as aisles: read from GeoJSON, queried by position or by tile. Pure.

GeoJSON (RFC 7946) uses degrees of WGS 84. Here coordinates are metres, and the member "frame" names their frame.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from fleetmap.encoding import decode_json, to_json, to_plain
from fleetmap.errors import InvalidValueError, StateError
from fleetmap.geometry import Array, Mask, Rings, inside_any, inside_rings, se3_inverse, transform_points
from fleetmap.mapformat.building import BuildingFrame
from fleetmap.mapformat.manifest import Manifest

OUTSIDE = "outside"
"""Key of counts outside of all areas and tiles."""

CORRECTIONS_KEY = "corrections"
"""Key in `configuration` of a manifest with the corrections that a version has, as GeoJSON; older readers ignore it."""

MAX_AREAS_BYTES = 8 << 20
_MAX_AREAS, _MAX_CORNERS, _MAX_RING = 2000, 50_000, 2000
_MAX_NAME = 64
MAX_REASON = 500
_MAX_M = 1e6
_EDGES_AT_ONCE = 64
_SAMPLES = 16  # sample points of a tile each way
_LEAST_SHARE = 0.1  # smallest share of a tile for an area to name it
_NAMED = 3
_MASK_WORDS = 'for a mask "mask": "keep-out", or "mask": "speed" and "percent": 1 to 99'
_TILE = re.compile(r"\btile (-?\d{1,10}),(-?\d{1,10})\b", re.ASCII)


class _Polygon(msgspec.Struct, tag_field="type", tag="Polygon"):
    coordinates: list[list[list[float]]]


class _MultiPolygon(msgspec.Struct, tag_field="type", tag="MultiPolygon"):
    coordinates: list[list[list[list[float]]]]


class MaskKind(StrEnum):
    """Effect of an area on a planner: forbidden, or driven at a share of the speed."""

    KEEP_OUT = "keep-out"
    SPEED = "speed"


class CorrectionKind(StrEnum):
    """Effect of an area on maps: learned anew once, never used, or not changed by surveys."""

    FORGET = "forget"
    NEVER_USE = "never-use"
    FREEZE = "freeze"


class Correction(msgspec.Struct, frozen=True):
    """Why an area corrects the map, and since when, in nanoseconds since 1970. since_ns: None until the site keeps it."""

    kind: CorrectionKind
    reason: Annotated[str, msgspec.Meta(max_length=MAX_REASON)] = ""
    since_ns: Annotated[int, msgspec.Meta(ge=0)] | None = None


class _Properties(msgspec.Struct):
    name: str
    mask: MaskKind | None = None
    percent: Annotated[int, msgspec.Meta(ge=1, le=99)] | None = None
    correction: Correction | None = None
    lift: Annotated[str, msgspec.Meta(min_length=1, max_length=64)] | None = None


class _Feature(msgspec.Struct):
    type: Literal["Feature"]
    geometry: _Polygon | _MultiPolygon
    properties: _Properties


class _Collection(msgspec.Struct):
    type: Literal["FeatureCollection"]
    features: list[_Feature]
    frame: Literal["map", "building"] | None = None


@dataclass(frozen=True, slots=True)
class Area:
    """polygons: in `map`; each by itself, so that what two of them share is inside.

    mask: effect on planners, None if absent. percent: of the robot's largest speed, in an area of the kind SPEED.
    correction: effect on maps, None if absent. lift: name of the lift whose cabin stands here, the same on every floor of a building.
    """

    name: str
    polygons: tuple[Rings, ...]
    mask: MaskKind | None = None
    percent: int | None = None
    correction: Correction | None = None
    lift: str | None = None

    @property
    def effects(self) -> str:
        """Effects on planners and maps as text, each after a comma; empty without any."""
        speed = "" if self.percent is None else f" {self.percent} %"
        masked = "" if self.mask is None else f", {self.mask.value}{speed}"
        lift = "" if self.lift is None else f", lift {self.lift}"
        corrects = "" if self.correction is None else f", {self.correction.kind.value}: {self.correction.reason}"
        return masked + lift + corrects

    @property
    def rings(self) -> Rings:
        """All outlines and holes."""
        return tuple(ring for polygon in self.polygons for ring in polygon)

    @property
    def size_m2(self) -> float:
        """Of the largest outline; holes are neglected."""
        return max(abs(_doubled_area(ring)) for ring in self.rings) / 2

    @property
    def outlines(self) -> list[Array]:
        """Its rings but for holes: those within no other ring of their polygon."""
        return [
            ring
            for polygon in self.polygons
            for ring in polygon
            if not any(inside_rings(ring, [other]).mean() >= 0.5 for other in polygon if other is not ring)
        ]

    def holds(self, points_m: Array) -> Mask:
        """Return a mask (N,) of the points (N, 2) inside."""
        return inside_any(points_m, self.polygons)

    def feature(self, target_from_map: Array) -> dict[str, Any]:
        """Return it as a feature of GeoJSON in another frame."""
        effects = {"mask": self.mask, "percent": self.percent} if self.mask else {}
        corrects = {"correction": to_plain(self.correction)} if self.correction else {}
        polygons = [[_closed(moved(ring, target_from_map)) for ring in polygon] for polygon in self.polygons]
        geometry = {"type": "MultiPolygon", "coordinates": polygons}
        return {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": polygons[0]} if len(polygons) == 1 else geometry,
            "properties": {"name": self.name} | effects | corrects | ({"lift": self.lift} if self.lift else {}),
        }


@dataclass(frozen=True, slots=True)
class Areas:
    """Areas, the smallest first: the smallest one that contains a position gives its name. frame: in which they were drawn."""

    areas: tuple[Area, ...] = ()
    frame: Literal["map", "building"] = "map"
    _boxes_m: Array = field(default_factory=lambda: np.zeros((0, 4)))

    @classmethod
    def of(cls, areas: Sequence[Area], frame: Literal["map", "building"] = "map") -> "Areas":
        """Sort the areas."""
        ordered = tuple(sorted(areas, key=lambda area: (area.size_m2, area.name)))
        corners = [np.concatenate(area.rings) for area in ordered]
        boxes = [(*points.min(axis=0), *points.max(axis=0)) for points in corners]
        return cls(ordered, frame, np.array(boxes, float).reshape(-1, 4))

    def __bool__(self) -> bool:
        return bool(self.areas)

    @property
    def corrections(self) -> list[Area]:
        """Areas that correct the map."""
        return [area for area in self.areas if area.correction is not None]

    @property
    def names(self) -> list[str]:
        """Names in alphabetical order."""
        return sorted(area.name for area in self.areas)

    def at(self, x_m: float, y_m: float) -> str | None:
        """Return the name of the area at a position in `map`; None outside of all, and for NaN."""
        point = np.array([[x_m, y_m]])
        for area in self._near((x_m, y_m, x_m, y_m)):
            if area.holds(point)[0]:
                return area.name
        return None

    def of_tile(self, tile: tuple[int, int], size_m: float) -> list[str]:
        """Return the names of the areas that cover a tenth of a tile or more, the largest share first."""
        corner = np.array(tile) * size_m
        steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES * size_m
        points = corner + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        left, shares = np.ones(len(points), bool), {}
        for area in self._near((*corner, *(corner + size_m))):
            mine = left & area.holds(points)
            left &= ~mine
            shares[area.name] = float(mine.mean())
        return sorted((n for n, share in shares.items() if share >= _LEAST_SHARE), key=lambda n: (-shares[n], n))

    def tile_words(self, tile: tuple[int, int], size_m: float) -> str:
        """Return a tile's display name: "aisle 5 (tile 3,-2)"; "tile 3,-2" without an area."""
        names, plain = self.of_tile(tile, size_m), f"tile {tile[0]},{tile[1]}"
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        return f"{', '.join(names[:_NAMED])}{more} ({plain})" if names else plain

    def name_tiles(self, text: str, size_m: float) -> str:
        """Replace every "tile 3,-2" in a sentence as in `tile_words`."""
        if not self.areas:
            return text
        return _TILE.sub(lambda found: self.tile_words((int(found[1]), int(found[2])), size_m), text)

    def geojson(self, site: str, building: BuildingFrame | None = None) -> dict[str, Any]:
        """Return all areas, in `map` or in the building."""
        frame, target_from_map = "map", np.eye(4)
        if building is not None:
            frame, target_from_map = "building", building.building_from_map
        features = [area.feature(target_from_map) for area in self.areas]
        return {"type": "FeatureCollection", "site": site, "frame": frame, "units": "metres", "features": features}

    def with_lifts(self, outlines: Mapping[str, Array], building: BuildingFrame) -> "Areas":
        """Return them with other lifts: outlines (N, 2) in the building by name. A lift that there was keeps its area's name and effects,
        and an area of a lift's name becomes the lift."""
        map_from_building = se3_inverse(building.building_from_map)
        known = {area.name: area for area in self.areas} | {area.lift: area for area in self.areas if area.lift}
        lifts = [
            replace(known.get(name, Area(name, ())), polygons=((moved(outline, map_from_building),),), lift=name)
            for name, outline in outlines.items()
        ]
        taken = {area.name for area in lifts}
        others = [area for area in self.areas if area.lift is None and area.name not in taken]
        return Areas.of([*lifts, *others], self.frame if self else "building")

    def _near(self, box_m: tuple[float, ...]) -> list[Area]:
        """Return the areas whose boxes meet a box (low x, low y, high x, high y)."""
        low, high = self._boxes_m[:, :2], self._boxes_m[:, 2:]
        meets = ((low <= np.array(box_m[2:])) & (high >= np.array(box_m[:2]))).all(axis=1)
        return [self.areas[n] for n in np.flatnonzero(meets)]


def read_areas(data: bytes, building: BuildingFrame | None) -> Areas:
    """Read the areas of a file. building: the map's pose in it, for areas drawn there.

    Raises InvalidValueError, naming the area, for polygons that are not closed or simple, repeated names and exceeded limits.
    """
    if len(data) > MAX_AREAS_BYTES:
        raise InvalidValueError(f"areas of more than {MAX_AREAS_BYTES} bytes; draw them with fewer corners")
    wanted = f"give a GeoJSON FeatureCollection of polygons with properties.name, and {_MASK_WORDS}"
    collection = decode_json(data, _Collection, f"areas: {{}}; {wanted}", InvalidValueError)
    if collection.frame is None:
        words = 'add "frame": "map" or "frame": "building" beside "features", and write metres'
        raise InvalidValueError(
            f"areas: the file does not name the frame of its coordinates (plain GeoJSON means degrees); {words}"
        )
    map_from_drawn = np.eye(4)
    if collection.frame == "building":
        if building is None:
            raise StateError(
                "areas drawn in the building need the map's pose in it; run `mapserver align --plan FILE --pin ...` first"
            )
        map_from_drawn = se3_inverse(building.building_from_map)
    if not 1 <= len(collection.features) <= _MAX_AREAS:
        raise InvalidValueError(f"areas: {len(collection.features)} features; give 1 to {_MAX_AREAS}")
    areas: dict[str, Area] = {}
    corners = 0
    for feature in collection.features:
        area = _area(feature, map_from_drawn)
        corners += sum(len(ring) for ring in area.rings)
        if area.name in areas:
            raise InvalidValueError(
                f"area {area.name!r} occurs twice; give each its own name, or make one MultiPolygon of them"
            )
        if corners > _MAX_CORNERS:
            raise InvalidValueError(f"areas of more than {_MAX_CORNERS} corners; draw them with fewer")
        areas[area.name] = area
    return Areas.of(list(areas.values()), collection.frame)


def corrections_of(manifest: Manifest) -> Areas:
    """Return the corrections that a version has. UsageError for invalid ones."""
    found = manifest.configuration.get(CORRECTIONS_KEY)
    return read_areas(to_json(found), None) if found else Areas()


def due_corrections(areas: Areas, manifest: Manifest) -> list[Area]:
    """Return the areas to be learned anew that a version has not forgotten yet."""
    done = {area.correction.since_ns for area in corrections_of(manifest).areas if area.correction}
    wanted = [(area, area.correction) for area in areas.areas if area.correction is not None]
    return [area for area, word in wanted if word.kind is CorrectionKind.FORGET and word.since_ns not in done]


def _area(feature: _Feature, map_from_drawn: Array) -> Area:
    name = feature.properties.name.strip()
    if not 1 <= len(name) <= _MAX_NAME or not name.isprintable() or name == OUTSIDE:
        raise InvalidValueError(
            f"area {name[:80]!r}: a name has 1 to {_MAX_NAME} printable characters, and is not {OUTSIDE!r}"
        )
    correction = feature.properties.correction
    if correction is not None and not correction.reason.isprintable():
        raise InvalidValueError(
            f"area {name!r}: the reason of its correction has characters that cannot be shown; write one line"
        )
    mask, percent = feature.properties.mask, feature.properties.percent
    if (percent is None) == (mask is MaskKind.SPEED):
        raise InvalidValueError(f"area {name!r}: mask {mask and mask.value} with percent {percent}; give {_MASK_WORDS}")
    geometry = feature.geometry
    drawn = [geometry.coordinates] if isinstance(geometry, _Polygon) else geometry.coordinates
    polygons = [tuple(moved(_ring(ring, f"area {name!r}"), map_from_drawn) for ring in rings) for rings in drawn]
    if not polygons or not all(polygons):
        raise InvalidValueError(f"area {name!r} has no corners; draw it as a polygon")
    return Area(name, tuple(polygons), mask, percent, correction, feature.properties.lift)


def _ring(positions: list[list[float]], where: str) -> Array:
    """Return (V, 2) without the repeated end."""
    if len(positions) < 4 or any(len(position) not in (2, 3) for position in positions):
        raise InvalidValueError(f"{where}: a ring has 4 or more positions [x, y], the last one as the first")
    if len(positions) > _MAX_RING:
        raise InvalidValueError(
            f"{where}: a ring of {len(positions)} corners, the limit is {_MAX_RING}; draw it with fewer"
        )
    ring = np.array([position[:2] for position in positions], float)
    if not (np.abs(ring) <= _MAX_M).all():
        raise InvalidValueError(f"{where}: a corner further than {_MAX_M:g} m from the origin; write metres")
    if (ring[0] != ring[-1]).any():
        raise InvalidValueError(
            f"{where} is not closed: it begins at {ring[0].tolist()} and ends at {ring[-1].tolist()}"
        )
    ring = ring[:-1]
    if (ring == np.roll(ring, 1, axis=0)).all(axis=1).any():
        raise InvalidValueError(f"{where}: two corners one after the other are the same; remove one")
    crossing = _crossing(ring)
    if crossing is not None:
        raise InvalidValueError(f"{where}: its outline crosses itself near {ring[crossing].tolist()}; redraw it there")
    if abs(_doubled_area(ring)) < 2e-4:
        raise InvalidValueError(f"{where} is a line without any area; give it a width")
    return ring


def _doubled_area(ring: Array) -> float:
    following = np.roll(ring, -1, axis=0)
    return float((ring[:, 0] * following[:, 1] - following[:, 0] * ring[:, 1]).sum())


def _crossing(ring: Array) -> int | None:
    """Return a corner whose edge meets another edge that is not its neighbour, None in a simple ring."""
    following, count = np.roll(ring, -1, axis=0), len(ring)
    low, high = np.minimum(ring, following), np.maximum(ring, following)

    def side(start: Array, end: Array, point: Array) -> Array:
        along, to = end - start, point - start
        return np.asarray(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])

    for begin in range(0, count, _EDGES_AT_ONCE):
        block = np.s_[begin : begin + _EDGES_AT_ONCE]
        near = ((low[block, None] <= high) & (high[block, None] >= low)).all(axis=2)
        n, others = np.nonzero(np.triu(near, begin + 1))
        n += begin
        a, b, c, d = ring[n], following[n], ring[others], following[others]
        sides = [np.sign(side(a, b, c)), np.sign(side(a, b, d)), np.sign(side(c, d, a)), np.sign(side(c, d, b))]
        apart = (sides[0] * sides[1] > 0) | (sides[2] * sides[3] > 0)
        # Neighbours share a corner; they meet elsewhere only if one runs back along the other.
        in_line = np.all([values == 0 for values in sides], axis=0)
        shares = (others == n + 1) | ((n == 0) & (others == count - 1))
        runs_back = in_line & (((b - a) * (d - c)).sum(axis=1) < 0)
        crossing = np.where(shares, runs_back, ~apart)
        if crossing.any():
            return int(n[crossing][0])
    return None


def moved(ring: Array, target_from_source: Array) -> Array:
    """Return corners (N, 2) of the ground in another frame."""
    return transform_points(target_from_source, np.c_[ring, np.zeros(len(ring))])[:, :2]


def _closed(ring: Array) -> list[list[float]]:
    return [[round(x, 4), round(y, 4)] for x, y in (*ring.tolist(), ring[0].tolist())]
