"""The re-survey list of a site, from the store's counters, and a route through the current map."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from fleetmap.errors import FleetmapError
from fleetmap.mapformat.manifest import TileEntry
from fleetmap.mapformat.tile import decode_tile
from mapserver.fleet_statistics import resurvey_decision as decision
from mapserver.fleet_statistics.kpis import HOUR_NS, Counters, driven_words, hour_of, kpis
from mapserver.floor_plan.survey_requests import SurveyCourse, SurveyRequest, courses
from mapserver.store import MapStore

_COURSES_NS = 14 * 24 * HOUR_NS


@dataclass(frozen=True, slots=True)
class ResurveyList:
    """Tiles to resurvey, the most urgent first, and a route through them; version: the current one, None if absent.

    requests: open ones; their tiles come first. courses: of the requests of the last 14 days, the latest first.
    """

    site: str
    version: int | None
    tiles: list[decision.TileConcern]
    route: list[decision.Waypoint]
    requests: list[SurveyRequest]
    courses: list[SurveyCourse]


def resurvey_list(store: MapStore, site: str, settings: decision.ResurveySettings, now_ns: int) -> ResurveyList:
    """Return the list as of now; raises UsageError for an unknown site."""
    current = store.current(site)
    recent_hour = hour_of(now_ns) - round(settings.recent_days * 24)
    before_hour = recent_hour - round(settings.before_days * 24)
    recent = store.fleet.counters_of(site, "tile", recent_hour)
    before = store.fleet.counters_of(site, "tile", before_hour, recent_hour)
    found = decision.concerns(recent, before, settings)
    requests, became = store.survey_requests(site), courses_of(store, site, settings, now_ns)
    if current is None:
        return ResurveyList(site, None, found, [], requests, became)
    manifest = store.manifest(site, current.version)
    # Requested tiles come first; a request is a reason beside the statistical ones.
    asked, known = _asked(requests, manifest.tile_size_m), {concern.tile: concern for concern in found}
    first = [
        replace(known[tile], reasons=[*words, *known[tile].reasons])
        if tile in known
        else decision.concern_of(tile, words, recent.get(tile, Counters()), before.get(tile, Counters()))
        for tile, words in asked.items()
    ]
    found = [*first, *(concern for concern in found if concern.tile not in asked)]
    entries = {f"{tile.x},{tile.y}": tile for tile in manifest.tiles}
    areas = store.areas(site)
    found = [replace(concern, name=areas.name_tiles(concern.name, manifest.tile_size_m)) for concern in found]
    tiles = [concern.tile for concern in found if concern.tile in entries]
    places = {tile: _place(store, entries[tile], manifest.tile_size_m) for tile in tiles}
    return ResurveyList(site, current.version, found, decision.route(found, places), requests, became)


def courses_of(store: MapStore, site: str, settings: decision.ResurveySettings, now_ns: int) -> list[SurveyCourse]:
    """Return what became of the requests of the last 14 days, the latest first, with the effect of those in use.

    Before: from `recent_days` ahead of the request to its use. The hour in which the version was published counts for neither side.
    """
    found = courses((e.stamp_ns, e.kind, e.detail) for e in store.events(site, (now_ns - _COURSES_NS, None)))
    for course in (course for course in found if course.used_ns and course.tiles):
        used, told = hour_of(course.used_ns), []
        for span in ((hour_of(course.asked_ns) - round(settings.recent_days * 24), used), (used + 1, 1 << 60)):
            total, sums = Counters(), store.fleet.counters_of(site, "tile", *span)
            for tile in course.tiles:
                total.add(sums.get(tile, Counters()))
            share = kpis(total).localised_share_of_all
            driven = f"{total.position_failures} in {driven_words(total.robot_days)}"
            told.append(driven + ("" if share is None else f", localised {share:.1%}"))
        course.effect = f"before {told[0]}; since {told[1]}"
    return found


def _asked(requests: Sequence[SurveyRequest], size_m: float) -> dict[str, list[str]]:
    """Return by tile the requests for a survey of it: author, time and reason."""
    found: dict[str, list[str]] = {}
    for request in requests:
        day = f"{datetime.fromtimestamp(request.asked_ns / 1e9, UTC):%Y-%m-%d}"
        why = f": {request.reason}" if request.reason else ""
        for x, y in request.tiles(size_m):
            found.setdefault(f"{x},{y}", []).append(f"{request.actor or 'unnamed'} asked for it on {day}{why}")
    return found


def _place(store: MapStore, entry: TileEntry, size_m: float) -> tuple[float, float]:
    """Return the survey position nearest to the tile's middle, which is reachable; the middle if the survey never was in the tile."""
    middle = ((entry.x + 0.5) * size_m, (entry.y + 0.5) * size_m)
    try:
        stood = decode_tile(store.blob(entry.sha256)).map_from_cam[:, :2, 3]
    except FleetmapError:
        return middle  # a damaged tile needs a survey most
    return min(((float(x), float(y)) for x, y in stood), key=lambda place: math.dist(place, middle), default=middle)
