"""Places that people ask to survey again, drawn as polygons: kept with the site until somebody says that it was done."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from fleetmap.errors import StateError, UsageError
from fleetmap.geometry import inside_rings
from mapserver.floor_plan.areas import read_areas
from mapserver.store import Actor, MapStore

MOST_REQUESTS, MOST_CORNERS = 100, 200
MOST_SIDE_M = 500.0
KIND = "survey request "
"""Begins the kind of a request among the files of a site; its id follows."""

_SAMPLES = 8  # of a tile's side
_EDGE = 256  # of an edge: two metres of the longest
Corners = Sequence[tuple[float, float]]


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


def ask_for_survey(store: MapStore, site: str, corners_map_m: Corners, actor: Actor) -> SurveyRequest:
    """Keeps a request, and notes it in the site's history.

    UsageError for an unknown site and what is no simple polygon of at most MOST_SIDE_M each way, StateError without a map and for too many.
    """
    if store.current(site) is None:
        raise StateError(f"site {site} has no published map that could be surveyed again; publish one first")
    open_requests = survey_requests(store, site)
    if len(open_requests) >= MOST_REQUESTS:
        raise StateError(f"site {site} has {MOST_REQUESTS} requests that are not done; say of some that they are")
    if not 3 <= len(corners_map_m) <= MOST_CORNERS:
        raise UsageError(f"{len(corners_map_m)} corners; draw it with 3 to {MOST_CORNERS}")
    ring = [[round(float(x), 2), round(float(y), 2)] for x, y in corners_map_m]
    asked_ns = store.now_ns()
    who = {"name": "survey", "asked_ns": asked_ns, "actor": actor.name, "reason": actor.reason}
    geometry = {"type": "Polygon", "coordinates": [[*ring, *ring[:1]]]}
    feature = {"type": "Feature", "geometry": geometry, "properties": who}
    data = json.dumps({"type": "FeatureCollection", "frame": "map", "features": [feature]}, allow_nan=False).encode()
    (area,) = read_areas(data, None).areas  # refuses what is no simple polygon
    sides_m = np.ptp(np.array(ring), axis=0)
    if sides_m.max() > MOST_SIDE_M:
        raise UsageError(f"{sides_m[0]:.0f} x {sides_m[1]:.0f} m; draw several of at most {MOST_SIDE_M:g} m each way")
    made = SurveyRequest(hashlib.sha256(data).hexdigest()[:8], asked_ns, actor.name, actor.reason, ring)
    middle = np.array(ring).mean(axis=0)
    words = f"asked for {area.size_m2:.0f} m2 around {middle[0]:.1f}, {middle[1]:.1f} m"
    store.keep_site_files(site, {KIND + made.id: data}, words, actor=actor)
    return made


def end_request(store: MapStore, site: str, request: str, actor: Actor) -> None:
    """Takes a request off the list: it was surveyed, or is not wanted any more. UsageError for one that is not there."""
    if request not in {known.id for known in survey_requests(store, site)}:
        raise UsageError(f"site {site} has no open request {request[:40]!r} for a survey; it may be done already")
    store.keep_site_files(site, {KIND + request: None}, "done", actor=actor)


def survey_requests(store: MapStore, site: str) -> list[SurveyRequest]:
    """The open ones, oldest first; UsageError for an unknown site."""
    store.current(site)
    found = []
    for kind in store.site_file_kinds(site):
        data = store.site_file(site, kind) if kind.startswith(KIND) else None
        if data is not None:
            found.append(_read(kind.removeprefix(KIND), data))
    return sorted(found, key=lambda request: (request.asked_ns, request.id))


def _read(request: str, data: bytes) -> SurveyRequest:
    feature: dict[str, Any] = msgspec.json.decode(data)["features"][0]
    ring, who = feature["geometry"]["coordinates"][0], feature["properties"]
    return SurveyRequest(request, who["asked_ns"], who["actor"], who["reason"], ring[:-1])
