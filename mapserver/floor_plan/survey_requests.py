"""Polygons requested for a new survey, as stored for a site, and the covered share of one. Pure."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
import scipy

from fleetmap.geometry import Array, Mask, inside_rings

KIND = "survey request "
"""Prefix of a request's kind among the files of a site; its id follows."""

ASKED, DRIVEN, IN_USE, EFFECT, TILES = "asked for ", "driven by ", "done: version ", "failures there: ", ", tiles "
"""How the entries of a request in the site's log begin."""

COVERED_SHARE = 0.9
"""Covered share of a request's places above which it counts as surveyed."""

_SAMPLES = 8  # of a tile's side
_EDGE = 256  # of an edge: two metres of the longest
_NEAR_M = 2.0  # includes the other lane of an aisle, but not the next aisle


@dataclass(frozen=True, slots=True)
class SurveyRequest:
    """Author, time (nanoseconds since 1970) and reason of a request; corners in `map`, the first not repeated at the end."""

    id: str
    asked_ns: int
    actor: str
    reason: str
    corners_map_m: list[list[float]]

    def tiles(self, size_m: float) -> list[tuple[int, int]]:
        """Return the tiles that the polygon touches, in order."""
        ring = np.array(self.corners_map_m)
        low, high = ring.min(axis=0), ring.max(axis=0)
        step = size_m / _SAMPLES
        grid = np.meshgrid(*(np.arange(a, b, step) for a, b in zip(low + step / 2, high, strict=True)))
        points = np.stack(grid, axis=-1).reshape(-1, 2)
        along = (np.arange(_EDGE) / _EDGE)[:, None, None]
        edges = (ring + along * (np.roll(ring, -1, axis=0) - ring)).reshape(-1, 2)
        points = np.concatenate([edges, points[inside_rings(points, [ring])]])
        return sorted({(int(x), int(y)) for x, y in np.floor(points / size_m)})

    def covered_share(self, places_map_m: Array, driven_map_m: Array) -> float:
        """Return the share of places (K, 2) in the polygon within 2 m of a driven position (F, 2); 0 without places in it."""
        inside = places_map_m[inside_rings(places_map_m, [np.array(self.corners_map_m)])]
        return float(np.mean(near_drives(inside, driven_map_m))) if len(inside) else 0.0


@dataclass(slots=True)
class SurveyCourse:
    """When a request was made, driven, in use by a version, its effect logged; 0 if not yet. effect: failures there before and since."""

    id: str
    place: str
    asked_ns: int
    tiles: list[str]
    driven_ns: int = 0
    robots: list[str] = field(default_factory=list)
    used_ns: int = 0
    told_ns: int = 0
    effect: str = ""


def courses(events: Iterable[tuple[int, str, str]]) -> list[SurveyCourse]:
    """Return the courses of requests by a site's log, the latest first. events: time, kind and text, the oldest first."""
    found: dict[str, SurveyCourse] = {}
    for stamp_ns, kind, words in events:
        if not kind.startswith(KIND):
            continue
        if words.startswith(ASKED):
            place, _, tiles = (words if TILES in words else words + TILES).removeprefix(ASKED).rpartition(TILES)
            found[kind] = SurveyCourse(kind.removeprefix(KIND), place, stamp_ns, tiles.split())
        elif (course := found.get(kind)) is not None and words.startswith(DRIVEN):
            course.driven_ns = course.driven_ns or stamp_ns
            course.robots = sorted({*course.robots, words.removeprefix(DRIVEN)})
        elif course is not None and words.startswith(IN_USE):
            course.used_ns = stamp_ns
        elif course is not None and words.startswith(EFFECT):
            course.told_ns = stamp_ns
    return list(found.values())[::-1]


def near_drives(places_map_m: Array, driven_map_m: Array) -> Mask:
    """Return (K,) which places (K, 2) are within 2 m of a driven position (F, 2)."""
    if not len(driven_map_m):
        return np.zeros(len(places_map_m), bool)
    return np.asarray(scipy.spatial.cKDTree(driven_map_m).query(places_map_m)[0] <= _NEAR_M)


def read_request(kind: str, data: bytes) -> SurveyRequest:
    """Decode a request stored under this kind."""
    feature: dict[str, Any] = msgspec.json.decode(data)["features"][0]
    ring, who = feature["geometry"]["coordinates"][0], feature["properties"]
    return SurveyRequest(kind.removeprefix(KIND), who["asked_ns"], who["actor"], who["reason"], ring[:-1])
