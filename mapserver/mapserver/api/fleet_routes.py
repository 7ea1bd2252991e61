"""Reading the fleet's health: figures by what they are counted by, failures with their context and pictures."""

import time
from typing import Annotated

from fastapi import FastAPI, Path, Query, Response

from fleetmap.messages import report_dict
from mapserver.api.fleet_views import FailureList, FailureView, HourList, HourView, KpisList, KpisView
from mapserver.api.pages import CounterCursor, Limit, NumberCursor, page
from mapserver.api.parameters import Axis, FailureNumber, Hours, KeyFilter, Site, SiteFilter
from mapserver.fleet.fleet import finite
from mapserver.fleet_statistics.kpis import HOUR_NS, hour_of, kpis
from mapserver.store import FailureFilter, MapStore

VersionFilter = Annotated[int | None, Query(ge=1, le=1 << 31, description="on this version alone", examples=[None])]


def install_fleet_routes(app: FastAPI, store: MapStore) -> None:
    """Adds the endpoints."""

    @app.get("/v1/fleet/measures")
    def fleet_measures(
        by: Axis = "site", site: SiteFilter = None, hours: Hours = 24, limit: Limit = 100, cursor: CounterCursor = None
    ) -> KpisList:
        """Failures per robot-day with interval, availability and the rest, by site, robot, version, tile or cause."""
        found = store.fleet.counters(site, by, since_hour=_since(hours))
        chosen = [(f"{key[0]}/{key[1]}", key, counts) for key, counts in found.items()]
        chosen = sorted(item for item in chosen if cursor is None or item[0] > cursor)
        shown, following = page(chosen, limit, lambda item: item[0])
        return KpisList(by, [KpisView(*key, kpis(counts)) for _, key, counts in shown], following)

    @app.get("/v1/sites/{site}/hours")
    def fleet_hours(
        site: Site, by: Axis = "site", key: KeyFilter = None, hours: Hours = 24, limit: Limit = 100,
        cursor: NumberCursor = None,
    ) -> HourList:  # fmt: skip
        """The same figures hour by hour, of a site or of one of its robots, versions, tiles or causes."""
        store.current(site)  # an unknown site is not an empty one
        found = store.fleet.hours(site, by, key=key, since_hour=max(_since(hours), (cursor or -1) + 1))
        shown, following = page(list(found.items()), limit, lambda item: str(item[0]))
        return HourList([HourView(hour * HOUR_NS, kpis(counts)) for hour, counts in shown], following)

    @app.get("/v1/failures")
    def failures(
        site: SiteFilter = None, robot: KeyFilter = None, version: VersionFilter = None, tile: KeyFilter = None,
        cause: KeyFilter = None, kind: KeyFilter = None, limit: Limit = 100, cursor: NumberCursor = None,
    ) -> FailureList:  # fmt: skip
        """Failures, the last to arrive first; kind `suspected` are estimates of silent ones."""
        wanted = FailureFilter(site=site, robot=robot, version=version, tile=tile, cause=cause, kind=kind)
        found = store.fleet.failures(wanted, before=cursor, limit=limit + 1)
        return FailureList(*page(found, limit, lambda failure: str(failure.number)))

    @app.get("/v1/failures/{number}")
    def failure(number: FailureNumber) -> FailureView:
        """One failure with what the robot told about it."""
        found = store.fleet.failure(number)
        return FailureView(found.failure, finite(report_dict(found.report)), found.pictures)

    @app.get("/v1/failures/{number}/pictures/{place}", response_class=Response)
    def picture(number: FailureNumber, place: Annotated[int, Path(ge=0, le=100)]) -> Response:
        """A picture of a failure, as JPEG."""
        headers = {"Cache-Control": "private, max-age=86400", "X-Content-Type-Options": "nosniff"}
        return Response(store.fleet.picture(number, place), media_type="image/jpeg", headers=headers)


def _since(hours: int) -> int:
    return hour_of(time.time_ns()) - hours + 1
