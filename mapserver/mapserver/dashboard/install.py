"""The dashboard in the server that has the API: pages under /dashboard, and the pictures that they show."""

import time

from fastapi import FastAPI, Request, Response
from fastapi.responses import RedirectResponse
from nicegui import app as pages
from nicegui import ui

from fleetmap.errors import FleetmapError
from mapserver.api.writers import Writers
from mapserver.dashboard import failure_page, fleet_page, map_page, survey_page
from mapserver.dashboard.compression_cache import CompressionCache
from mapserver.dashboard.data import MapData
from mapserver.dashboard.fleet_health import HealthData
from mapserver.dashboard.layout import Rooms
from mapserver.dashboard.live import LiveRobots
from mapserver.fleet.fleet import Fleet
from mapserver.fleet_statistics.canary_test import CanarySettings
from mapserver.fleet_statistics.resurvey_test import ResurveySettings
from mapserver.quality.gate import GateSettings
from mapserver.store import MapStore

PATH = "/dashboard"


def install_dashboard(
    app: FastAPI, store: MapStore, fleet: Fleet, writers: Writers, gate: GateSettings, canary: CanarySettings,
    resurvey: ResurveySettings,
) -> None:  # fmt: skip
    """Adds the pages to `app`. Once in a process: NiceGUI keeps its pages in the module."""
    rooms = Rooms(
        MapData(store, gate, canary.share),
        HealthData(store, canary, resurvey, time.time_ns),
        LiveRobots(fleet, time.monotonic),
        writers,
    )
    for room in (fleet_page, map_page, failure_page, survey_page):
        room.install(rooms)
    _install_pictures(rooms, store)

    @app.get("/", include_in_schema=False)
    def to_dashboard(request: Request) -> RedirectResponse:
        """Where people who type the bare address want to go."""
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
        gzip_middleware_factory=CompressionCache,
    )


def _install_pictures(rooms: Rooms, store: MapStore) -> None:
    @pages.get("/plans/{site}/{version}.png", include_in_schema=False)
    def plan(site: str, version: int) -> Response:
        """The picture of a version's plan; versions do not change."""
        try:
            return _picture(rooms.maps.plan(site, version).png, "image/png", "private, max-age=31536000, immutable")
        except FleetmapError as error:
            return Response(str(error), 404, media_type="text/plain")

    @pages.get("/pictures/{failure}/{place}.jpg", include_in_schema=False)
    def picture(failure: int, place: int) -> Response:
        """A picture of a failure."""
        try:
            return _picture(store.fleet.picture(failure, place), "image/jpeg", "private, max-age=86400")
        except FleetmapError as error:
            return Response(str(error), 404, media_type="text/plain")


def _picture(data: bytes, media_type: str, kept: str) -> Response:
    # Robots send the bytes: a browser must not take them for anything but a picture.
    return Response(data, media_type=media_type, headers={"Cache-Control": kept, "X-Content-Type-Options": "nosniff"})
