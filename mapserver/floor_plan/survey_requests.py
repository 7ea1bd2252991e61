"""Polygons that people want surveyed again, as a site keeps them, and how much of one a survey has covered. Pure."""

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import scipy

from fleetmap.geometry import Array, inside_rings

KIND = "survey request "
"""Begins the kind of a request among the files of a site; its id follows."""

COVERED_SHARE = 0.9
"""Of a request's places: so many near what was driven are a survey of it."""

_SAMPLES = 8  # of a tile's side
_EDGE = 256  # of an edge: two metres of the longest
_NEAR_M = 2.0  # the other lane of an aisle, not the next aisle


@dataclass(frozen=True, slots=True)
class SurveyRequest:
    """Who asked when (nanoseconds since 1970) and why; corners in `map`, the first not repeated at the end."""

    id: str
    asked_ns: int
    actor: str
    reason: str
    corners_map_m: list[list[float]]

    def tiles(self, size_m: float) -> list[tuple[int, int]]:
        """Tiles that the polygon lies in, in order."""
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
        """The share of places (K, 2) in the polygon that lie within 2 m of somewhere that was driven (F, 2); 0 without places in it."""
        inside = places_map_m[inside_rings(places_map_m, [np.array(self.corners_map_m)])]
        if not len(inside) or not len(driven_map_m):
            return 0.0
        return float(np.mean(scipy.spatial.cKDTree(driven_map_m).query(inside)[0] <= _NEAR_M))


def read_request(kind: str, data: bytes) -> SurveyRequest:
    """A request as a site keeps it, under this kind."""
    feature: dict[str, Any] = msgspec.json.decode(data)["features"][0]
    ring, who = feature["geometry"]["coordinates"][0], feature["properties"]
    return SurveyRequest(kind.removeprefix(KIND), who["asked_ns"], who["actor"], who["reason"], ring[:-1])
