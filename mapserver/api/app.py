"""The HTTP API. No page of it names an address outside; the interactive documentation of FastAPI does, so it is off."""

import shlex
import time
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import replace
from http import HTTPMethod
from itertools import accumulate

from fastapi import Depends, FastAPI, Request, Response
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import fleetmap
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.encoding import to_json
from fleetmap.mapformat.manifest import MANIFEST_FORMAT
from fleetmap.mapformat.tile_codec import TILE_FORMAT
from mapserver.api import building_routes, describe, fleet_routes, inbox_routes, problems, views
from mapserver.api import parameters as p
from mapserver.api.bytes_response import bytes_response
from mapserver.api.file_routes import install_file_routes
from mapserver.api.guard import Guard
from mapserver.api.metrics import CONTENT_TYPE, Metrics
from mapserver.api.people_routes import install_people_routes
from mapserver.api.request_limits import RequestLimits
from mapserver.api.server_routes import install_server_routes
from mapserver.api.version_routes import ApiSettings, install_version_routes
from mapserver.fleet.fleet import Fleet
from mapserver.operators.operators import Operators
from mapserver.serving.robot_placing import RobotPlacing
from mapserver.store import JobInfo, MapStore

Lifespan = Callable[[FastAPI], AbstractAsyncContextManager[None]]
USUAL_SETTINGS = ApiSettings()
_MAX_PAGE_BYTES = 4_000_000


def create_app(
    store: MapStore,
    fleet: Fleet,
    metrics: Metrics,
    bus: Bus | None,
    lifespan: Lifespan | None = None,
    settings: ApiSettings = USUAL_SETTINGS,
) -> FastAPI:
    """Return the application over an open store. `bus`: checked for readiness, and notifies robots; None if the server has none."""
    app = FastAPI(
        title="fleetmap",
        description="Versions of maps, the robots that use them, and the jobs that make them.",
        version=str(fleetmap.__version__),
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
        responses=problems.PROBLEM_RESPONSES,
        dependencies=[Depends(p.known_parameters)],
        default_response_class=describe.ExactJson,
    )
    problems.install(app)
    operators = settings.guard.operators or Operators(store)
    app.add_middleware(Guard, settings=replace(settings.guard, operators=operators))
    app.add_middleware(RequestLimits)
    app.add_middleware(_Measured, metrics=metrics)
    app.state.store, app.state.resurvey, app.state.placing = store, settings.resurvey, RobotPlacing(store, fleet, bus)
    app.state.nights, app.state.uploads = settings.nights, set()
    for routes in (inbox_routes, fleet_routes, building_routes):
        app.include_router(routes.router)
    _install_service_routes(app, store, fleet, metrics, bus)
    _install_list_routes(app, store, fleet)
    _install_map_routes(app, store)
    install_file_routes(app, store)
    install_version_routes(app, store, settings)
    install_server_routes(app, store, fleet, settings)
    install_people_routes(app, store, operators, bus)
    describe.install(app)
    return app


def _install_service_routes(app: FastAPI, store: MapStore, fleet: Fleet, metrics: Metrics, bus: Bus | None) -> None:
    @app.get("/healthz")
    def healthz() -> views.ServiceState:
        """The process runs."""
        return views.ServiceState("ok")

    @app.get("/readyz")
    def readyz() -> views.ServiceState:
        """The store answers, robots' reports can be stored, and the bus is open."""
        store.sites()
        if fleet.storage_fault:
            raise HTTPException(503, f"reports of robots cannot be stored: {fleet.storage_fault}")
        if bus is not None and bus.closed():
            raise HTTPException(503, "the bus is closed; the server is stopping")
        return views.ServiceState("ok")

    @app.get("/version")
    def version() -> views.ServerVersion:
        """Version and formats of the server."""
        return views.ServerVersion(str(fleetmap.__version__), TILE_FORMAT, MANIFEST_FORMAT)

    @app.get("/metrics", response_class=Response)
    def metrics_text() -> Response:
        """Metrics in Prometheus's text format."""
        return Response(metrics.text(), headers={"Content-Type": CONTENT_TYPE})


def _install_list_routes(app: FastAPI, store: MapStore, fleet: Fleet) -> None:
    @app.get("/v1/sites")
    def sites(limit: p.Limit = 100, cursor: p.NameCursor = None) -> views.SiteList:
        """Sites by name."""
        found = [info for info in store.sites() if cursor is None or info.site > cursor]
        return views.SiteList(*p.page(found, limit, lambda info: info.site))

    @app.get("/v1/sites/{site}/versions")
    def versions(site: p.Site, limit: p.Limit = 100, cursor: p.NumberCursor = None) -> views.VersionList:
        """Versions of a site, oldest first, drafts too."""
        found = store.versions(site, after=cursor or 0, limit=limit + 1)
        shown, following = p.page(found, limit, lambda info: str(info.version))
        return views.VersionList([views.version_view(store, info) for info in shown], following)

    @app.get("/v1/sites/{site}/events")
    def events(
        site: p.Site, since: p.Since = None, until: p.Until = None, limit: p.Limit = 100, cursor: p.NumberCursor = None
    ) -> views.EventList:
        """Events of a site, oldest first: actor, action, time and reason."""
        store.current(site)  # raises for an unknown site
        found = store.events(site, p.time_range(since, until), after=cursor or 0, limit=limit + 1)
        return views.EventList(*p.page(found, limit, lambda event: str(event.id)))

    @app.get("/v1/jobs")
    def jobs(
        site: p.SiteFilter = None,
        since: p.Since = None,
        until: p.Until = None,
        limit: p.Limit = 100,
        cursor: p.NumberCursor = None,
    ) -> views.JobList:
        """Jobs (of a site) that began within a range of time, newest first."""
        found = store.jobs(site, p.time_range(since, until), before=cursor, limit=limit + 1)
        return views.JobList(*p.page(found, limit, lambda job: str(job.id)))

    @app.get("/v1/jobs/{job}")
    def job(job: p.Number) -> JobInfo:
        """One job."""
        return store.job(job)

    @app.get("/v1/robots")
    def robots(site: p.SiteFilter = None, limit: p.Limit = 100, cursor: p.NameCursor = None) -> views.RobotList:
        """Robots (of a site) by site and name: the version that each runs and should run, and its last messages.

        A page ends early where these are long.
        """
        found = [robot for robot in fleet.robots(site) if cursor is None or f"{robot.site}/{robot.robot}" > cursor]
        found.sort(key=lambda robot: f"{robot.site}/{robot.robot}")
        shown, following = p.page(found, limit, lambda robot: f"{robot.site}/{robot.robot}")
        sizes = accumulate(len(to_json(robot)) for robot in shown)
        fitting = max(1, sum(size <= _MAX_PAGE_BYTES for size in sizes))
        if fitting < len(shown):
            return views.RobotList(*p.page(shown, fitting, lambda robot: f"{robot.site}/{robot.robot}"))
        return views.RobotList(shown, following)


def _install_map_routes(app: FastAPI, store: MapStore) -> None:
    @app.get("/v1/sites/{site}/versions/{version}", response_class=Response)
    def manifest(request: Request, site: p.Site, version: p.Version) -> Response:
        """The manifest of a version, byte by byte as robots verify it."""
        sha256 = store.version(site, version).manifest_sha256
        return bytes_response(request, store.blob(sha256), sha256, "application/json", immutable=True)

    @app.get("/v1/sites/{site}/current")
    def current(site: p.Site) -> views.VersionView:
        """The current version of a site."""
        info = store.current(site)
        if info is None:
            raise HTTPException(
                404,
                f"site {site} has no published version; "
                f"publish one with `mapserver publish --site {site} --store {shlex.quote(str(store.folder))}`",
            )
        return views.version_view(store, info)

    @app.head("/v1/tiles/{sha256}", response_class=Response, include_in_schema=False)
    @app.get("/v1/tiles/{sha256}", response_class=Response)
    def tile(request: Request, sha256: p.Sha256) -> Response:
        """The bytes of a tile."""
        return _blob(request, store, sha256, "tile")

    @app.head("/v1/vocabularies/{sha256}", response_class=Response, include_in_schema=False)
    @app.get("/v1/vocabularies/{sha256}", response_class=Response)
    def vocabulary(request: Request, sha256: p.Sha256) -> Response:
        """The bytes of a vocabulary."""
        return _blob(request, store, sha256, "vocabulary")


def _blob(request: Request, store: MapStore, sha256: str, kind: str) -> Response:
    if store.served_kind(sha256) != kind:
        raise HTTPException(404, f"no published {kind} has SHA-256 {sha256}")
    return bytes_response(request, store.blob(sha256), sha256, "application/octet-stream", immutable=True)


class _Measured:
    """Counts and times every request. Plain ASGI: Starlette's way with tasks and queues costs more than most answers here."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return await self._app(scope, receive, send)
        started_s, status = time.perf_counter(), 500

        async def noted(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self._app(scope, receive, noted)
        finally:
            route = getattr(scope.get("route"), "path", "other")
            method = scope["method"] if scope["method"] in HTTPMethod.__members__ else "other"
            self._metrics.count_http(method, route, status, time.perf_counter() - started_s)
        return None
