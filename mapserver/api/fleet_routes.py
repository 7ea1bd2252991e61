"""Endpoints of fleet health: figures by site, robot, version, tile, area or cause; failures; tiles to resurvey."""

import time
from typing import Annotated, Any, NamedTuple, cast

from fastapi import APIRouter, Depends, Query, Request, Response

from fleetmap.encoding import to_plain
from fleetmap.mapformat.names import sha256_hex
from fleetmap.messages import InitialPoseMessage
from mapserver.api import parameters as p
from mapserver.api import views
from mapserver.api.bytes_response import PICTURE_HEADERS, bytes_response
from mapserver.api.guard import actor_of
from mapserver.fleet.resurvey_list import ResurveyList, resurvey_list
from mapserver.fleet.survey_requests import ask_for_survey, end_request
from mapserver.fleet_statistics.kpis import HOUR_NS, hour_of, kpis
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings, route_geojson
from mapserver.floor_plan.survey_requests import SurveyRequest
from mapserver.serving.robot_placing import RobotPlacing


class Span(NamedTuple):
    """Hours since 1970, the end excluded."""

    first: int
    end: int


def _span(hours: p.Hours = 24, since: p.Since = None, until: p.Until = None) -> Span:
    since_ns, until_ns = p.time_range(since, until)
    end = hour_of(time.time_ns()) + 1 if until_ns is None else hour_of(until_ns - 1) + 1
    return Span(end - hours if since_ns is None else hour_of(since_ns), end)


Asked = Annotated[Span, Depends(_span)]


async def _resurvey(request: Request) -> ResurveySettings:
    return cast(ResurveySettings, request.app.state.resurvey)


async def _placing(request: Request) -> RobotPlacing:
    return cast(RobotPlacing, request.app.state.placing)


Resurvey = Annotated[ResurveySettings, Depends(_resurvey)]
Placing = Annotated[RobotPlacing, Depends(_placing)]
router = APIRouter()


@router.post("/v1/sites/{site}/robots/{robot}/initial_pose")
def initial_pose(
    request: Request, placing: Placing, site: p.Site, robot: p.Robot, act: views.PlaceAct
) -> views.ServiceState:
    """Send an operator's pose to a robot: it overrides the tracked pose until fixes outweigh it. `ok`: the robot was notified."""
    told = InitialPoseMessage(
        site=site,
        robot=robot,
        x_map_m=act.x_map_m,
        y_map_m=act.y_map_m,
        heading_rad=act.heading_rad,
        sigma_m=act.sigma_m,
    )
    placing.tell(told, actor_of(request, act.actor, act.reason))
    return views.ServiceState("ok")


@router.get("/v1/fleet/measures")
def fleet_measures(
    store: p.Store,
    span: Asked,
    by: p.Axis = "site",
    site: p.SiteFilter = None,
    limit: p.Limit = 100,
    cursor: p.NameCursor = None,
) -> views.KpisList:
    """Failures per robot-day with interval, availability and the rest, by site, robot, version, tile, area or cause.

    Whole hours are counted, including those that contain `since` and `until`.
    """
    found = store.fleet.counters(site, by, since_hour=span.first, until_hour=span.end)
    chosen = [(f"{key[0]}/{key[1]}", key, counts) for key, counts in found.items()]
    chosen = sorted(item for item in chosen if cursor is None or item[0] > cursor)
    shown, following = p.page(chosen, limit, lambda item: item[0])
    return views.KpisList(by, [views.KpisView(*key, kpis(counts)) for _, key, counts in shown], following)


@router.get("/v1/sites/{site}/hours")
def fleet_hours(
    store: p.Store,
    site: p.Site,
    span: Asked,
    by: p.Axis = "site",
    key: p.KeyFilter = None,
    limit: p.Limit = 100,
    cursor: p.NumberCursor = None,
) -> views.HourList:
    """The same figures hour by hour, of a site or of one of its robots, versions, tiles, areas or causes."""
    store.current(site)  # raises for an unknown site
    first = max(span.first, (cursor or -1) + 1)
    found = store.fleet.hours(site, by, key=key, since_hour=first, until_hour=span.end)
    shown, following = p.page(list(found.items()), limit, lambda item: str(item[0]))
    return views.HourList([views.HourView(hour * HOUR_NS, kpis(counts)) for hour, counts in shown], following)


@router.get("/v1/failures")
def failures(store: p.Store, query: Annotated[p.FailureQuery, Query()]) -> views.FailureList:
    """Failures, latest arrival first; kind `suspected` marks estimated silent failures."""
    found = store.fleet.failures(query.filter(), before=query.cursor, limit=query.limit + 1)
    return views.FailureList(*p.page(found, query.limit, lambda failure: str(failure.number)))


@router.get("/v1/failures/{number}")
def failure(store: p.Store, number: p.Number) -> views.FailureView:
    """One failure with the robot's report."""
    found = store.fleet.failure(number)
    return views.FailureView(found.failure, to_plain(found.report), found.pictures)


@router.get("/v1/failures/{number}/pictures/{place}", response_class=Response)
def picture(store: p.Store, number: p.Number, place: p.PictureNumber) -> Response:
    """A picture of a failure, as JPEG."""
    headers = {"Cache-Control": "private, max-age=86400", **PICTURE_HEADERS}
    return Response(store.fleet.picture(number, place), media_type="image/jpeg", headers=headers)


@router.get("/v1/failures/{number}/replay.mcap", response_class=Response)
def replay(request: Request, store: p.Store, number: p.Number) -> Response:
    """The recording of the seconds around a failure, as MCAP: `mapserver fleet replay` and Foxglove open it."""
    data = store.fleet.replay(number)
    response = bytes_response(request, data, sha256_hex(data), "application/octet-stream", immutable=False)
    response.headers["Content-Disposition"] = f'attachment; filename="failure-{number}.mcap"'
    return response


@router.get("/v1/sites/{site}/resurvey")
def resurvey(settings: Resurvey, store: p.Store, site: p.Site) -> ResurveyList:
    """Tiles to resurvey, the most urgent first, each with its reasons, and a route through them."""
    return resurvey_list(store, site, settings, time.time_ns())


@router.post("/v1/sites/{site}/resurvey/requests")
def ask(request: Request, store: p.Store, site: p.Site, act: views.SurveyAct) -> SurveyRequest:
    """Request a survey of a polygon; its tiles stay on the list until the request is closed."""
    return ask_for_survey(store, site, act.corners_map_m, actor_of(request, act.actor, act.reason))


@router.post("/v1/sites/{site}/resurvey/requests/{asked}/end")
def end(request: Request, store: p.Store, site: p.Site, asked: p.RequestId, act: views.Act) -> views.ServiceState:
    """Remove a request from the list because it was surveyed or is no longer wanted."""
    end_request(store, site, asked, actor_of(request, act.actor, act.reason))
    return views.ServiceState("ok")


@router.get("/v1/sites/{site}/resurvey/route")
def resurvey_route(settings: Resurvey, store: p.Store, site: p.Site) -> dict[str, Any]:
    """The route as GeoJSON, with metres in `map` instead of degrees."""
    found = resurvey_list(store, site, settings, time.time_ns())
    return route_geojson(site, found.version or 0, found.route)
