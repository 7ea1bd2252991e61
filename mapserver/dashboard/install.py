"""Installation of the dashboard in the API's server: pages under /dashboard, and their pictures."""

import time
from typing import Literal

from fastapi import FastAPI, Request, Response
from fastapi.responses import RedirectResponse
from nicegui import app as pages
from nicegui import ui
from starlette.middleware.gzip import GZipMiddleware

from fleetmap.errors import FleetmapError
from mapserver.api.bytes_response import PICTURE_HEADERS
from mapserver.api.version_routes import ApiSettings
from mapserver.dashboard import (
    failure,
    failures,
    live_page,
    map_page,
    overview,
    robot,
    sign_in_page,
    space_page,
    survey_jobs,
)
from mapserver.dashboard.console import PATH, Console
from mapserver.dashboard.data import MapData
from mapserver.dashboard.fleet_health import HealthData
from mapserver.dashboard.layout import Services
from mapserver.dashboard.live import LiveRobots
from mapserver.fleet.fleet import Fleet
from mapserver.serving.live_surveys import LiveSurveys
from mapserver.store import MapStore


def install_dashboard(app: FastAPI, store: MapStore, fleet: Fleet, settings: ApiSettings, surveys: LiveSurveys) -> None:
    """Adds the pages to `app`. Once in a process: NiceGUI keeps its pages in the module."""
    services = Services(
        MapData(store, settings.gate, settings.canary.share),
        HealthData(store, settings.canary, settings.resurvey, time.time_ns),
        LiveRobots(fleet, time.monotonic),
        settings.guard,
        surveys,
    )
    sign_in_page.install(app, settings.guard)
    console = Console(pages, services)
    console.files()
    for module in (overview, map_page, failures, failure, space_page, live_page, robot, survey_jobs):
        module.install(console)
    console.nothing_else()
    _install_pictures(services)

    @app.get("/", include_in_schema=False)
    def to_dashboard(request: Request) -> RedirectResponse:
        """Redirects the bare address to the dashboard."""
        return RedirectResponse(f"{request.scope.get('root_path', '')}{PATH}/")

    ui.run_with(
        app,
        mount_path=PATH,
        title="fleetmap",
        favicon="🗺",
        dark=None,
        tailwind=False,
        reconnect_timeout=10.0,
        binding_refresh_interval=None,
        show_welcome_message=False,
        gzip_middleware_factory=lambda app: GZipMiddleware(app, compresslevel=5),
    )


def _install_pictures(services: Services) -> None:
    @pages.get("/plans/{site}/{version}.png", include_in_schema=False)
    def plan(site: str, version: int) -> Response:
        """The picture of a version's plan; versions do not change."""
        try:
            return _picture(services.maps.plan(site, version).png, "image/png", "private, max-age=31536000, immutable")
        except FleetmapError as error:
            return Response(str(error), 404, media_type="text/plain")

    @pages.get("/spaces/{site}/{version}.bin", include_in_schema=False)
    def space(site: str, version: int) -> Response:
        """Landmarks and places of a version; versions do not change."""
        try:
            data = services.maps.space(site, version)
        except FleetmapError as error:
            return Response(str(error), 404, media_type="text/plain")
        return _picture(data, "application/octet-stream", "private, max-age=31536000, immutable")

    @pages.get("/underlays/{site}/{version}/{kind}.png", include_in_schema=False)
    def underlay(site: str, version: int, kind: Literal["floor", "grid"]) -> Response:
        """What lies under a map: the floor plan or the occupancy grid."""
        try:
            found = services.maps.underlay(site, version, kind)
        except FleetmapError as error:
            return Response(str(error), 404, media_type="text/plain")
        if found is None:
            return Response(f"version {version} of {site} has no {kind}", 404, media_type="text/plain")
        return _picture(found[0], "image/png", "private, no-cache")


def _picture(data: bytes, media_type: str, cache_control: str) -> Response:
    return Response(data, media_type=media_type, headers={"Cache-Control": cache_control, **PICTURE_HEADERS})
