"""Installation of the dashboard in the API's server: pages under /dashboard, their pictures, and sign-in."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple
from urllib.parse import parse_qsl

from anyio import to_thread
from fastapi import FastAPI, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from starlette.middleware.gzip import GZipMiddleware

from fleetmap.errors import FleetmapError, StateError
from fleetmap.hooks import plugins
from mapserver.api.bytes_response import PICTURE_HEADERS
from mapserver.api.guard import SIGN_IN, SIGN_OUT, STYLE, GuardSettings, address_of, set_session
from mapserver.api.parameters import ApiSettings
from mapserver.dashboard import administration, docs, failure, failures, map_page, overview, robot, survey_jobs
from mapserver.dashboard.console import PATH, Console, Page, Services
from mapserver.dashboard.data import MapData
from mapserver.dashboard.fleet_health import HealthData
from mapserver.dashboard.live import LiveRobots
from mapserver.dashboard.rendering import TEMPLATES
from mapserver.fleet.alerts import active_alerts
from mapserver.fleet.fleet import Fleet
from mapserver.store import MapStore

_HELP = {
    "trends": "service.md#the-fleets-health",
    "robots": "troubleshooting.md#status-of-a-robot",
    "map": "how_to.md#correct-the-map",
    "failures": "service.md#causes",
    "surveys": "how_to.md#build-a-map-every-night",
    "administration": "operations.md",
}
LASTING = "private, max-age=31536000, immutable"  # versions do not change
Hear = Callable[[str, str, Callable[[str, bytes], None]], None]
"""`BusService.hear`."""
_MAX_ADDRESS = 300  # percent-encoded it must fit into the sign-in's body, beside name and password


class Host(NamedTuple):
    """A server for its parts, which add endpoints to `app`, pages to `console`, and messages of the bus; hear: None without a bus."""

    store: MapStore
    fleet: Fleet
    settings: ApiSettings
    app: FastAPI
    console: Console
    hear: Hear | None


def install_dashboard(
    app: FastAPI, store: MapStore, fleet: Fleet, settings: ApiSettings, hear: Hear | None = None
) -> None:
    """Adds the pages to `app`, and the parts that plug-ins have."""
    alerts = partial(active_alerts, store, fleet, settings.config.alerts)
    services = Services(
        MapData(store, settings.config.gate, settings.config.canary.share, settings.inbox),
        HealthData(store, settings.config.canary, settings.config.resurvey, time.time_ns, alerts),
        LiveRobots(fleet, time.monotonic),
        settings,
    )
    pages = FastAPI(openapi_url=None)
    pages.add_middleware(GZipMiddleware, compresslevel=5)
    console = Console(pages, services, help=_HELP.copy())
    console.files("static", Path(__file__).parent / "static")
    _install_pages(console)
    for install in plugins("mapserver.parts").values():
        install(Host(store, fleet, settings, app, console, hear))
    link = _link("Administration")  # behind those of the parts
    console.page("administration", Page("administration.html", administration.page, link=link, of_site=False))
    console.page("administration/people", Page("people.html", administration.people, of_site=False))
    knows = (*administration.LOG_FILTERS, "older")
    console.page("administration/log", Page("log.html", administration.log, knows=knows, usual="All", of_site=False))
    console.page("docs/{document:path}", Page("docs.html", docs.page, of_site=False))
    console.files("pictures", docs.FOLDER)
    console.nothing_else()
    _install_files(pages, services)
    app.mount(PATH, pages)
    install_sign_in(app, settings.guard)

    @app.get("/", include_in_schema=False)
    def to_dashboard(request: Request) -> RedirectResponse:
        """Redirects the bare address to the dashboard."""
        return RedirectResponse(f"{request.scope.get('root_path', '')}{PATH}/")


def _link(title: str) -> tuple[str, str]:
    return title, f"static/icons.svg#{title.lower()}"


def _install_pages(console: Console) -> None:
    """What a page is asked with beside its site, and what it follows."""
    console.page("", Page("overview.html", overview.page, link=_link("Overview")))
    console.stream("now", overview.now, shows=("fleet",))
    console.page("trends", Page("trends.html", overview.trends, link=_link("Trends"), usual="Last 24 h"))
    console.page("robots", Page("robots.html", overview.robots, link=_link("Robots"), knows=("state", "without")))
    console.page("robots/{robot}", Page("robot.html", robot.page, usual="Last drive"))
    console.stream("robots/{robot}/now", robot.now, shows=("robot", "facts"))
    compared = ("version", "before", "after")
    console.page("map", Page("map.html", map_page.page, link=_link("Map"), knows=compared, usual="Last 14 days"))
    filters = (*failures.AXES, "older", "sort")
    console.page("failures", Page("failures.html", failures.page, link=_link("Failures"), knows=filters, usual="All"))
    console.page("failures/{failure}", Page("failure.html", failure.page, of_site=False))
    console.page(
        "surveys", Page("surveys.html", survey_jobs.page, link=_link("Surveys"), knows=("job",), usual="All jobs")
    )


def _install_files(pages: FastAPI, services: Services) -> None:
    @pages.exception_handler(FleetmapError)
    def missing(_: Request, error: FleetmapError) -> Response:
        return Response(str(error), 404, media_type="text/plain")

    @pages.get("/plans/{site}/{version}.png")
    def plan(site: str, version: int) -> Response:
        """The picture of a version's plan."""
        return file_response(services.maps.plan(site, version).png, "image/png")

    @pages.get("/underlays/{site}/{version}/{kind}.png")
    def underlay(site: str, version: int, kind: Literal["floor", "grid"]) -> Response:
        """What lies under a map: the floor plan or the occupancy grid."""
        found = services.maps.underlay(site, version, kind)
        if found is None:
            raise StateError(f"version {version} of {site} has no {kind}")
        return file_response(found[0], "image/png", "private, no-cache")


def file_response(data: bytes, media_type: str, cache_control: str = LASTING) -> Response:
    """Answer with a file; LASTING for one that never changes."""
    return Response(data, media_type=media_type, headers={"Cache-Control": cache_control, **PICTURE_HEADERS})


def install_sign_in(app: FastAPI, settings: GuardSettings) -> None:
    """Adds the page and its two actions: without scripts, for those whom nobody knows yet."""

    @app.get(SIGN_IN, include_in_schema=False)
    def sign_in_page(request: Request, next: str = "/") -> Response:
        """The form; whoever needs none goes on."""
        if not settings.is_sign_in_on or settings.identify(request.scope) is not None:
            return RedirectResponse(_local(next), 303)
        return _sign_in_page(next)

    @app.post(SIGN_IN, include_in_schema=False)
    async def sign_in(request: Request) -> Response:
        """Begins a session."""
        given = dict(parse_qsl((await request.body()).decode("utf-8", "replace")))
        then, name, operators = given.get("next", "/"), given.get("name", "").strip().lower(), settings.operators
        if operators is None:
            return RedirectResponse(_local(then), 303)
        found = await to_thread.run_sync(operators.sign_in, name, given.get("password", ""), address_of(request.scope))
        if not found.session:
            page = _sign_in_page(then, name, found.refusal, 429 if found.retry_s else 401)
            if found.retry_s:
                page.headers["Retry-After"] = str(found.retry_s)
            return page
        response = RedirectResponse(_local(then), 303)
        set_session(response, request.scope, found.session)
        return response

    @app.post(SIGN_OUT, include_in_schema=False)
    def sign_out(request: Request) -> Response:
        """Ends the session."""
        who = settings.identify(request.scope)
        if who is not None and settings.operators is not None:
            settings.operators.sign_out(who)
        response = RedirectResponse(SIGN_IN, 303)
        set_session(response, request.scope, "")
        return response


def _sign_in_page(then: str, name: str = "", refusal: str = "", status: int = 200) -> HTMLResponse:
    shown = {"style": STYLE, "action": SIGN_IN, "then": _local(then), "name": name, "refusal": refusal}
    page = TEMPLATES.get_template("sign_in.html").render(shown)
    return HTMLResponse(page, status, {"Cache-Control": "no-store"})


def _local(address: str) -> str:
    """The address where it is one of this server, else the first page: a link from elsewhere must not lead on to elsewhere."""
    is_local = address.startswith("/") and not address.startswith(("//", "/\\")) and address.isprintable()
    is_local = is_local and len(address) <= _MAX_ADDRESS
    return address if is_local and not address.startswith((SIGN_IN, SIGN_OUT)) else "/"
