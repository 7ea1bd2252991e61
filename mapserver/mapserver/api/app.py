"""The HTTP API. No page of it names an address outside; the interactive documentation of FastAPI does, so it is off."""

import time
from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from http import HTTPMethod
from importlib import metadata
from typing import Annotated

from fastapi import FastAPI, Path, Request, Response
from starlette.exceptions import HTTPException

from fleetmap.bus import Bus
from fleetmap.mapformat import MANIFEST_FORMAT, TILE_FORMAT
from mapserver.api import problems
from mapserver.api.bytes_response import bytes_response
from mapserver.api.metrics import CONTENT_TYPE, Metrics
from mapserver.api.views import RobotList, ServerVersion, SiteList, SiteView, State, VersionList, VersionView
from mapserver.fleet import Fleet
from mapserver.store import MapStore

Lifespan = Callable[[FastAPI], AbstractAsyncContextManager[None]]
Site = Annotated[str, Path(max_length=64)]
Version = Annotated[int, Path(ge=1, le=1 << 31)]
Sha256 = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")]


def create_app(
    store: MapStore, fleet: Fleet, metrics: Metrics, bus: Bus | None, lifespan: Lifespan | None = None
) -> FastAPI:
    """The application over an open store; `bus` is looked at for readiness only, None where none is served."""
    app = FastAPI(title="fleetmap", version=fleetmap_version(), docs_url=None, redoc_url=None, lifespan=lifespan)
    problems.install(app)
    _install_metrics(app, metrics)
    _install_service_routes(app, store, metrics, bus)
    _install_map_routes(app, store)
    _install_robot_routes(app, fleet)
    return app


def fleetmap_version() -> str:
    """The installed distribution's version, "not installed" in a source tree."""
    try:
        return metadata.version("fleetmap")
    except metadata.PackageNotFoundError:
        return "not installed"  # run from a source tree


def _install_service_routes(app: FastAPI, store: MapStore, metrics: Metrics, bus: Bus | None) -> None:
    @app.get("/healthz")
    def healthz() -> State:
        """The process runs."""
        return State("ok")

    @app.get("/readyz")
    def readyz() -> State:
        """The store answers and the bus is open."""
        store.sites()
        if bus is not None and bus.closed():
            raise HTTPException(503, "the bus is closed; the server is stopping")
        return State("ok")

    @app.get("/version")
    def version() -> ServerVersion:
        """What runs here."""
        return ServerVersion(fleetmap_version(), TILE_FORMAT, MANIFEST_FORMAT)

    @app.get("/metrics", response_class=Response)
    def metrics_text() -> Response:
        """Metrics in Prometheus's text format."""
        return Response(metrics.text(), headers={"Content-Type": CONTENT_TYPE})


def _install_map_routes(app: FastAPI, store: MapStore) -> None:
    @app.get("/v1/sites")
    def sites() -> SiteList:
        """All sites."""
        return SiteList([SiteView.of(info) for info in store.sites()])

    @app.get("/v1/sites/{site}/versions")
    def versions(site: Site) -> VersionList:
        """All versions of a site, drafts too."""
        return VersionList([VersionView.of(info) for info in store.versions(site)])

    @app.get("/v1/sites/{site}/versions/{version}", response_class=Response)
    def manifest(request: Request, site: Site, version: Version) -> Response:
        """The manifest of a version, byte by byte as robots verify it."""
        sha256 = store.version(site, version).manifest_sha256
        return bytes_response(request, store.blob(sha256), sha256, "application/json", immutable=True)

    @app.get("/v1/sites/{site}/current")
    def current(site: Site) -> VersionView:
        """The current version of a site."""
        info = store.current(site)
        if info is None:
            raise HTTPException(404, f"site {site} has no published version; publish one with `mapserver publish`")
        return VersionView.of(info)

    @app.head("/v1/tiles/{sha256}", response_class=Response, include_in_schema=False)
    @app.get("/v1/tiles/{sha256}", response_class=Response)
    def tile(request: Request, sha256: Sha256) -> Response:
        """The bytes of a tile."""
        return _blob(request, store, sha256, "tile")

    @app.head("/v1/vocabularies/{sha256}", response_class=Response, include_in_schema=False)
    @app.get("/v1/vocabularies/{sha256}", response_class=Response)
    def vocabulary(request: Request, sha256: Sha256) -> Response:
        """The bytes of a vocabulary."""
        return _blob(request, store, sha256, "vocabulary")


def _install_robot_routes(app: FastAPI, fleet: Fleet) -> None:
    @app.get("/v1/robots")
    def robots(site: str | None = None) -> RobotList:
        """All robots (of a site): the version that each runs and should run, and its last messages."""
        return RobotList(fleet.robots(site))


def _blob(request: Request, store: MapStore, sha256: str, kind: str) -> Response:
    if store.served_kind(sha256) != kind:
        raise HTTPException(404, f"no published {kind} has SHA-256 {sha256}")
    return bytes_response(request, store.blob(sha256), sha256, "application/octet-stream", immutable=True)


def _install_metrics(app: FastAPI, metrics: Metrics) -> None:
    @app.middleware("http")
    async def measure(request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        started_s = time.perf_counter()
        status = 500
        try:
            response = await call_next(request)
            status = response.status_code
        finally:
            route = getattr(request.scope.get("route"), "path", "other")
            method = request.method if request.method in HTTPMethod.__members__ else "other"
            metrics.count_http(method, route, status, time.perf_counter() - started_s)
        return response
