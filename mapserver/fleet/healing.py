"""Places that heal by themselves: surveys that the server requests where robots began to fail, and a line of the log on their effect."""

import logging

import numpy as np

from fleetmap.errors import FleetmapError
from mapserver.fleet.building import ask_for_survey
from mapserver.fleet.resurvey_list import resurvey_list
from mapserver.fleet_statistics.kpis import HOUR_NS
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings
from mapserver.floor_plan.survey_requests import EFFECT, KIND
from mapserver.store import Actor, FailureFilter, MapStore

_SERVER = "server"
_AROUND_M = 3.0  # of failures; a robot that is lost tells its last known place
_TOLD_NS = 24 * HOUR_NS  # after which an effect is logged
_MOST_OPEN = 24  # of the server's own requests at a site: people's must have room, too
_log = logging.getLogger(__name__)


def heal(store: MapStore, settings: ResurveySettings, now_ns: int) -> None:
    """Log the effect of each survey a day after its version; with `requests`, request surveys of the tiles that got worse.

    A tile is asked for once in `recent_days`, because failures of before its survey count as recent for so long; around its failures, where
    their places are known. What fails at one site is logged.
    """
    for site in [info.site for info in store.sites() if info.current_version is not None]:
        try:
            _heal(store, site, settings, now_ns)
        except FleetmapError as error:
            _log.error("site %s does not heal by itself: %s", site, error)


def _heal(store: MapStore, site: str, settings: ResurveySettings, now_ns: int) -> None:
    since_ns = now_ns - round(settings.recent_days * 24 * HOUR_NS)
    found = resurvey_list(store, site, settings, now_ns)
    size_m = store.manifest(site, found.version or 0).tile_size_m
    for course in found.courses:
        if course.effect and not course.told_ns and now_ns - course.used_ns > _TOLD_NS:
            store.audit(KIND + course.id, EFFECT + course.effect, actor=Actor(_SERVER), site=site)
    asked = {f"{x},{y}" for request in found.requests for x, y in request.tiles(size_m)}
    asked |= {tile for course in found.courses if course.asked_ns > since_ns for tile in course.tiles}
    room = _MOST_OPEN - sum(request.actor == _SERVER for request in found.requests)
    wanted = [concern for concern in found.tiles if settings.requests and concern.tile not in asked]
    for concern in wanted[: max(room, 0)]:
        low = size_m * np.array(concern.tile.split(","), float)
        rows = store.fleet.failures(FailureFilter(site=site, tile=concern.tile, since_ns=since_ns))
        if len({row.robot for row in rows}) == 1 < len(store.robots(site)):  # it may be the robot's own fault
            continue
        places = [np.array([row.x_map_m, row.y_map_m], float) for row in rows if row.x_map_m is not None]
        # In the tile, whatever places robots tell
        around = np.clip(np.array(places or [low, low + size_m]), low + _AROUND_M, low + size_m - _AROUND_M - 0.01)
        (x0, y0), (x1, y1) = (around.min(axis=0) - _AROUND_M).tolist(), (around.max(axis=0) + _AROUND_M).tolist()
        corners, why = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)], "; ".join(concern.reasons)
        ask_for_survey(store, site, corners, Actor(_SERVER, why))
