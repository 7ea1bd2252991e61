"""The HTTP API, its OpenAPI document and JSON, and the endpoints of the server itself: state, version, metrics, alerts.

No page of it names an address outside; the interactive documentation of FastAPI does, so it is off. The document is FastAPI's own, with
problem documents for its validation errors. Stamps keep all digits: nanoseconds since 1970 exceed 2^53, above which programs that use
doubles round.
"""

import time
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from functools import cache, partial
from http import HTTPMethod
from typing import Any

from fastapi import APIRouter, Depends, FastAPI, Response
from fastapi.openapi.utils import get_openapi
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

import fleetmap
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import StateError
from fleetmap.hooks import plugins
from fleetmap.mapformat.manifest import MANIFEST_FORMAT
from fleetmap.mapformat.tile import TILE_FORMAT
from mapserver.api import building_routes, fleet_routes, inbox_routes, people_routes, problems, version_routes, views
from mapserver.api import parameters as p
from mapserver.api.guard import Guard, Sender
from mapserver.api.incidents import incidents
from mapserver.api.metrics import CONTENT_TYPE, Metrics
from mapserver.api.operation_routes import router_of_operations
from mapserver.api.request_limits import RequestLimits
from mapserver.api.views import Problem
from mapserver.fleet.alerts import Incident, active_alerts
from mapserver.fleet.fleet import Fleet
from mapserver.operators.operators import Operators
from mapserver.serving.server_health import ServerHealth, server_health
from mapserver.store import MapStore

Lifespan = Callable[[FastAPI], AbstractAsyncContextManager[None]]
USUAL_SETTINGS = p.ApiSettings()
router = APIRouter()


def create_app(
    store: MapStore,
    fleet: Fleet,
    settings: p.ApiSettings = USUAL_SETTINGS,
    *,
    metrics: Metrics | None = None,
    bus: Bus | None = None,
    lifespan: Lifespan | None = None,
) -> FastAPI:
    """Return the application over an open store. metrics: with counts of its bus. `bus`: checked for readiness, and notifies robots."""
    metrics = metrics or Metrics(store, fleet)
    app = FastAPI(
        title="fleetmap",
        description="Versions of maps, the robots that use them, and the jobs that make them.",
        version=str(fleetmap.__version__),
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
        responses=problems.PROBLEM_RESPONSES,
        dependencies=[Depends(p.known_parameters)],
        default_response_class=ExactJson,
        generate_unique_id_function=lambda route: route.name,
    )
    problems.install(app)
    operators = settings.guard.operators or Operators(store)
    app.add_middleware(Guard, settings=settings.guard._replace(operators=operators))
    app.add_middleware(RequestLimits)
    app.add_middleware(_Measured, metrics=metrics)
    app.state.served = p.Served(store, fleet, metrics, bus, settings, operators, set())
    app.include_router(router, tags=["server"])
    for routes in (version_routes, people_routes, inbox_routes, fleet_routes, building_routes):
        app.include_router(routes.router, tags=[routes.__name__.rpartition(".")[2].removesuffix("_routes")])
    app.include_router(router_of_operations())
    for install in plugins("mapserver.routes").values():
        install(app, store, partial(version_routes.offered_file, store))
    app.openapi = cache(partial(_described, app))  # type: ignore[method-assign]  # made at the first request
    return app


@router.get("/healthz")
def healthz() -> views.ServiceState:
    """The process runs."""
    return views.OK


@router.get("/readyz")
def readyz(service: p.Service) -> views.ServiceState:
    """The store answers, robots' reports can be stored, and the bus is open."""
    service.store.sites()
    if service.fleet.storage_fault:
        raise HTTPException(503, f"reports of robots cannot be stored: {service.fleet.storage_fault}")
    if service.bus is not None and service.bus.closed():
        raise HTTPException(503, "the bus is closed; the server is stopping")
    return views.OK


@router.get("/version")
def server_version() -> views.ServerVersion:
    """Version and formats of the server."""
    return views.ServerVersion(
        fleetmap=str(fleetmap.__version__), tile_format=TILE_FORMAT, manifest_format=MANIFEST_FORMAT
    )


@router.get("/metrics", response_class=Response)
def metrics_text(service: p.Service) -> Response:
    """Metrics in Prometheus's text format."""
    return Response(service.metrics.text(), headers={"Content-Type": CONTENT_TYPE})


@router.get("/v1/server")
def server(service: p.Service) -> ServerHealth:
    """State of the server: version, disk, store, memory, days until certificates and signed lists expire, retention."""
    settings = service.settings
    return server_health(service.store, service.fleet, settings.config.ingest, settings.certificate)


@router.get("/v1/alerts")
def alerts(service: p.Service, page: p.NamePage) -> views.Page[Incident]:
    """Active alerts, by site, name and subject."""
    found = active_alerts(service.store, service.fleet, service.settings.config.alerts, time.time_ns())
    return page.of(found, lambda alert: f"{alert.site}/{alert.name}/{alert.about}")


@router.get("/v1/incidents")
def list_incidents(service: p.Service, page: p.NamePage, site: p.SiteFilter = None) -> views.Page[Incident]:
    """Incidents (of a site) that are not closed: state, who has each, and what people did."""
    settings = service.settings
    found = incidents(service.store, service.fleet, settings.config.alerts, settings.inbox, site)
    return page.of(found, lambda one: one.id)


@router.post("/v1/alerts/test")
def test_alert(service: p.Service, sender: Sender, act: views.Act) -> views.AlertTest:
    """Send a test alert to the webhook and wait for its answer; 502 if it is not accepted, 409 without a webhook."""
    actor, webhook = sender.of(act), service.settings.webhook
    if webhook is None:
        raise StateError(
            "no webhook is set: name its address as `webhook` in [alerts] of the server's configuration file, and restart the server"
        )
    is_accepted, answer = webhook.test(time.time_ns())
    service.store.audit("alert_test", answer, actor=actor)
    if not is_accepted:
        raise HTTPException(502, f"{answer}; check `webhook` and `token_file` in [alerts], and the receiver")
    return views.AlertTest(detail=answer)


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


class ExactJson(JSONResponse):
    """An answer whose fields `..._ns` are decimal numbers in strings."""

    def render(self, content: Any) -> bytes:
        return super().render(_exact(content))


def _exact(value: Any) -> Any:
    if isinstance(value, dict):
        # The type is that of an integer, and not of a bool
        return {k: str(v) if type(v) is int and str(k).endswith("_ns") else _exact(v) for k, v in value.items()}
    return [_exact(item) for item in value] if isinstance(value, list) else value


def _described(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document."""
    found = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
    schemas = found["components"]["schemas"]
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    schemas["Problem"] = Problem.model_json_schema()
    found["components"]["securitySchemes"] = {
        "token": {"type": "http", "scheme": "bearer"},
        "session": {"type": "apiKey", "in": "cookie", "name": "__Host-fleetmap"},
    }
    for path, operations in found["paths"].items():
        for operation in operations.values():
            operation["responses"].pop("422", None)  # one of 4XX
            if path not in ("/healthz", "/readyz"):
                operation["security"] = [{}, {"token": []}, {"session": []}]
    _describe_stamps(found)
    return found


def _describe_stamps(schema: Any) -> None:
    """Describe stamps as strings in the document, in place."""
    if isinstance(schema, list):
        for item in schema:
            _describe_stamps(item)
    elif isinstance(schema, dict):
        for name, value in schema.items():
            if isinstance(name, str) and name.endswith("_ns") and isinstance(value, dict):
                for kind in (value, *value.get("anyOf", ())):
                    if kind.get("type") == "integer":
                        kind.update(type="string", pattern=r"^-?[0-9]+$")
            else:
                _describe_stamps(value)
