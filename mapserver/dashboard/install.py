"""Installation of the dashboard in the API's server: pages under /dashboard, and their pictures."""

import time
from functools import partial
from typing import Literal

from fastapi import FastAPI, Request, Response
from fastapi.responses import RedirectResponse
from starlette.middleware.gzip import GZipMiddleware

from fleetmap.errors import FleetmapError, StateError
from mapserver.api.bytes_response import PICTURE_HEADERS
from mapserver.api.version_routes import ApiSettings
from mapserver.dashboard import (
    administration,
    failure,
    failures,
    live_page,
    map_page,
    overview,
    people,
    robot,
    robots,
    sign_in_page,
    space_page,
    survey_jobs,
)
from mapserver.dashboard.console import PATH, Console, Services
from mapserver.dashboard.data import MapData
from mapserver.dashboard.fleet_health import HealthData
from mapserver.dashboard.live import LiveRobots
from mapserver.fleet.alerts import active_alerts
from mapserver.fleet.fleet import Fleet
from mapserver.serving.live_surveys import LiveSurveys
from mapserver.store import MapStore


def install_dashboard(app: FastAPI, store: MapStore, fleet: Fleet, settings: ApiSettings, surveys: LiveSurveys) -> None:
    """Adds the pages to `app`."""
    inbox = None if settings.nights is None else settings.nights.inbox
    alerts = partial(active_alerts, store, fleet, settings.alerts)
    services = Services(
        MapData(store, settings.gate, settings.canary.share, inbox),
        HealthData(store, settings.canary, settings.resurvey, time.time_ns, alerts),
        LiveRobots(fleet, time.monotonic),
        settings,
        surveys,
    )
    pages = FastAPI(openapi_url=None)
    pages.add_middleware(GZipMiddleware, compresslevel=5)
    console = Console(pages, services)
    console.files()
    _install_pages(console)
    console.nothing_else()
    _install_files(pages, services)
    app.mount(PATH, pages)
    sign_in_page.install(app, settings.guard)

    @app.get("/", include_in_schema=False)
    def to_dashboard(request: Request) -> RedirectResponse:
        """Redirects the bare address to the dashboard."""
        return RedirectResponse(f"{request.scope.get('root_path', '')}{PATH}/")


def _install_pages(console: Console) -> None:
    """What a page is asked with beside its site, and what it follows."""
    span, growing = ("since", "until"), console.services.surveys.sites
    console.page("", "overview.html", overview.page, knows=("find",))
    console.stream("now", overview.now)
    console.page("trends", "trends.html", overview.trends, knows=span)
    console.page("robots", "robots.html", robots.page, knows=("find", "state", "without"))
    console.page("robots/{robot}", "robot.html", robot.page, knows=span)
    console.stream("robots/{robot}/now", robot.now)
    console.page("map", "map.html", map_page.page, knows=("version", "before", "after", *span))
    console.page("space", "space.html", space_page.page, knows=("version", "x", "y"))
    console.page("failures", "failures.html", failures.page, knows=(*failures.AXES, *span, "before", "sort"))
    console.page("failures/{failure}", "failure.html", failure.page, of_site=False)
    console.page("surveys", "surveys.html", survey_jobs.page, knows=("job", *span))
    console.page("live", "live.html", live_page.page, under_way=growing)
    console.stream("live/now", live_page.heard, under_way=growing)
    console.page("administration", "administration.html", administration.page, of_site=False)
    console.page("administration/people", "people.html", people.page, of_site=False)


def _install_files(pages: FastAPI, services: Services) -> None:
    lasting = "private, max-age=31536000, immutable"  # versions do not change

    @pages.exception_handler(FleetmapError)
    def missing(_: Request, error: FleetmapError) -> Response:
        return Response(str(error), 404, media_type="text/plain")

    @pages.get("/plans/{site}/{version}.png")
    def plan(site: str, version: int) -> Response:
        """The picture of a version's plan."""
        return _file(services.maps.plan(site, version).png, "image/png", lasting)

    @pages.get("/spaces/{site}/{version}.bin")
    def space(site: str, version: int) -> Response:
        """Landmarks and places of a version."""
        return _file(services.maps.space(site, version), "application/octet-stream", lasting)

    @pages.get("/surfels/{site}/{version}.bin")
    def surfels(site: str, version: int) -> Response:
        """Surfels of a version."""
        return _file(services.maps.surfels(site, version), "application/octet-stream", lasting)

    @pages.get("/underlays/{site}/{version}/{kind}.png")
    def underlay(site: str, version: int, kind: Literal["floor", "grid"]) -> Response:
        """What lies under a map: the floor plan or the occupancy grid."""
        found = services.maps.underlay(site, version, kind)
        if found is None:
            raise StateError(f"version {version} of {site} has no {kind}")
        return _file(found[0], "image/png", "private, no-cache")


def _file(data: bytes, media_type: str, cache_control: str) -> Response:
    return Response(data, media_type=media_type, headers={"Cache-Control": cache_control, **PICTURE_HEADERS})
