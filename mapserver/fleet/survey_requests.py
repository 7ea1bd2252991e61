"""Survey requests of operators, drawn as polygons: kept with the site until a version covers them or they are closed."""

import hashlib
from collections.abc import Sequence

import numpy as np

from fleetmap.encoding import to_json
from fleetmap.errors import StateError, UsageError
from mapserver.floor_plan.areas import read_areas
from mapserver.floor_plan.survey_requests import ASKED, KIND, SurveyRequest
from mapserver.store import Actor, MapStore

MOST_REQUESTS, MOST_CORNERS = 100, 200
MOST_SIDE_M = 500.0
Corners = Sequence[tuple[float, float]]


def ask_for_survey(store: MapStore, site: str, corners_map_m: Corners, actor: Actor) -> SurveyRequest:
    """Store a request, and log it in the site's history.

    UsageError for an unknown site or an invalid polygon (simple, at most MOST_SIDE_M each way), StateError without a map and for too many.
    """
    if store.current(site) is None:
        raise StateError(f"site {site} has no published map to resurvey; publish one first")
    if len(store.survey_requests(site)) >= MOST_REQUESTS:
        raise StateError(f"site {site} has {MOST_REQUESTS} open requests; close some first")
    if not 3 <= len(corners_map_m) <= MOST_CORNERS:
        raise UsageError(f"{len(corners_map_m)} corners; draw the polygon with 3 to {MOST_CORNERS}")
    ring = [[round(float(x), 2), round(float(y), 2)] for x, y in corners_map_m]
    asked_ns = store.now_ns()
    who = {"name": "survey", "asked_ns": asked_ns, "actor": actor.name, "reason": actor.reason}
    geometry = {"type": "Polygon", "coordinates": [[*ring, *ring[:1]]]}
    feature = {"type": "Feature", "geometry": geometry, "properties": who}
    data = to_json({"type": "FeatureCollection", "frame": "map", "features": [feature]})
    (area,) = read_areas(data, None).areas  # refuses polygons that are not simple
    sides_m = np.ptp(np.array(ring), axis=0)
    if sides_m.max() > MOST_SIDE_M:
        raise UsageError(f"{sides_m[0]:.0f} x {sides_m[1]:.0f} m; draw several of at most {MOST_SIDE_M:g} m each way")
    made = SurveyRequest(hashlib.sha256(data).hexdigest()[:8], asked_ns, actor.name, actor.reason, ring)
    middle = np.array(ring).mean(axis=0)
    named = store.areas(site).at(*middle.tolist())
    words = f"{ASKED}{f'{named}, ' if named else ''}{area.size_m2:.0f} m2 around {middle[0]:.1f}, {middle[1]:.1f} m"
    store.keep_site_files(site, {KIND + made.id: data}, words, actor=actor)
    return made


def end_request(store: MapStore, site: str, request: str, actor: Actor) -> None:
    """Remove a request from the list because it was surveyed or is no longer wanted. UsageError for an unknown one."""
    store.current(site)  # raises for an unknown site
    if request not in {known.id for known in store.survey_requests(site)}:
        raise UsageError(f"site {site} has no open request {request[:40]!r} for a survey; it may be closed already")
    store.keep_site_files(site, {KIND + request: None}, "done", actor=actor)
