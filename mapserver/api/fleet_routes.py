"""Endpoints of fleet health: figures by site, robot, version, tile, area or cause; failures; tiles to resurvey."""

import time
from dataclasses import replace
from itertools import accumulate
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request, Response

from fleetmap.encoding import to_json, to_plain
from fleetmap.mapformat.names import sha256_hex
from mapserver.api import parameters as p
from mapserver.api import views
from mapserver.api.bytes_response import PICTURE_HEADERS, bytes_response
from mapserver.api.moments import hours_within
from mapserver.fleet.fleet import RobotStatus
from mapserver.fleet.resurvey_list import ResurveyList, resurvey_list
from mapserver.fleet_statistics.kpis import HOUR_NS, kpis
from mapserver.fleet_statistics.resurvey_decision import route_geojson
from mapserver.store import FailureRow

_MAX_PAGE_BYTES = 4_000_000


def _span(within: p.TimeRange, hours: p.Hours = 24) -> tuple[int, int]:
    """Return the first hour since 1970, and that behind the last."""
    return hours_within(*within, time.time_ns(), hours)


Asked = Annotated[tuple[int, int], Depends(_span)]
router = APIRouter()


@router.get("/v1/robots")
def robots(service: p.Service, page: p.NamePage, site: p.SiteFilter = None) -> views.Page[RobotStatus]:
    """Robots (of a site) by site and name: the version that each runs and should run, and its last messages.

    A page ends early where these are long.
    """
    robots, name = service.fleet.robots(site), lambda robot: f"{robot.site}/{robot.robot}"
    sizes = accumulate(len(to_json(robot)) for robot in page.cut(robots, name)[0])
    fitting = max(1, sum(size <= _MAX_PAGE_BYTES for size in sizes))
    return replace(page, limit=min(page.limit, fitting)).of(robots, name)


@router.get("/v1/fleet/measures")
def fleet_measures(
    store: p.Store, span: Asked, page: p.NamePage, by: p.Axis = "site", site: p.SiteFilter = None
) -> views.Page[views.KpisView]:
    """Failures per robot-day with interval, availability and the rest, by site, robot, version, tile, area or cause.

    Whole hours are counted, including those that contain `since` and `until`.
    """
    found = store.fleet.counters(site, by, since_hour=span[0], until_hour=span[1])
    shown, following = page.cut(found.items(), lambda item: "/".join(item[0]))
    measures = [views.KpisView(site=site, key=key, measures=kpis(counts)) for (site, key), counts in shown]
    return views.Page(items=measures, next=following)


@router.get("/v1/sites/{site}/hours")
def fleet_hours(
    store: p.Store, site: p.Site, span: Asked, page: p.NumberPage, by: p.Axis = "site", key: p.KeyFilter = None
) -> views.Page[views.HourView]:
    """The same figures hour by hour, of a site or of one of its robots, versions, tiles, areas or causes."""
    store.current(site)  # raises for an unknown site
    first = max(span[0], -1 if page.cursor is None else page.cursor + 1)
    found = store.fleet.hours(site, by, key=key, since_hour=first, until_hour=span[1])
    shown, following = page.cut(found.items(), lambda item: item[0])
    hours = [views.HourView(hour_ns=hour * HOUR_NS, measures=kpis(counts)) for hour, counts in shown]
    return views.Page(items=hours, next=following)


@router.get("/v1/failures")
def failures(store: p.Store, wanted: p.FailuresWanted, page: p.NumberPage) -> views.Page[FailureRow]:
    """Failures, latest arrival first; kind `suspected` marks estimated silent failures."""
    found = store.fleet.failures(wanted, before=page.cursor, limit=page.limit + 1)
    return page.of(found, lambda failure: failure.number)


@router.get("/v1/failures/{number}")
def failure(store: p.Store, number: p.Number) -> views.FailureView:
    """One failure with the robot's report."""
    found = store.fleet.failure(number)
    return views.FailureView(failure=found.failure, report=to_plain(found.report), pictures=found.pictures)


@router.get("/v1/failures/{number}/pictures/{place}", response_class=Response)
def failure_picture(store: p.Store, number: p.Number, place: p.PictureNumber) -> Response:
    """A picture of a failure, as JPEG."""
    headers = {"Cache-Control": "private, max-age=86400", **PICTURE_HEADERS}
    return Response(store.fleet.picture(number, place), media_type="image/jpeg", headers=headers)


@router.get("/v1/failures/{number}/replay.mcap", response_class=Response)
def failure_recording(request: Request, store: p.Store, number: p.Number) -> Response:
    """The recording of the seconds around a failure, as MCAP: `mapserver fleet replay` and Foxglove open it."""
    data = store.fleet.replay(number)
    response = bytes_response(request, data, sha256_hex(data), "application/octet-stream", immutable=False)
    response.headers["Content-Disposition"] = f'attachment; filename="failure-{number}.mcap"'
    return response


@router.get("/v1/sites/{site}/resurvey")
def resurvey(service: p.Service, site: p.Site) -> ResurveyList:
    """Tiles to resurvey, the most urgent first, each with its reasons, and a route through them."""
    return resurvey_list(service.store, site, service.settings.config.resurvey, time.time_ns())


@router.get("/v1/sites/{site}/resurvey/route")
def resurvey_route(service: p.Service, site: p.Site) -> dict[str, Any]:
    """The route as GeoJSON, with metres in `map` instead of degrees."""
    found = resurvey(service, site)
    return route_geojson(site, found.version or 0, found.route)
