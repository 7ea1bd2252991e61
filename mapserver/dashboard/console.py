"""The frame of every page: templates filled from the same functions as the HTTP API, under a policy that runs no script of a page's text.

What a page needs to know goes into `fill`; what moves from second to second comes by a stream of server-sent events, and what changes
now and then is fetched anew by `static/renew.js`. Acts are requests to the HTTP API, by `static/acts.js`.
"""

import time
from asyncio import sleep, to_thread
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, timedelta, tzinfo
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from fastapi import FastAPI, Request, Response
from fastapi.responses import HTMLResponse, StreamingResponse
from fastapi.staticfiles import StaticFiles
from jinja2 import Template
from markupsafe import Markup
from starlette.datastructures import QueryParams

from fleetmap.encoding import to_json
from fleetmap.errors import FleetmapError, StoreError, UsageError
from fleetmap.mapformat.names import sha256_hex
from mapserver.api.guard import SIGN_IN, SIGN_OUT
from mapserver.api.moments import moment_text, read_moment, read_range, written, zone_of
from mapserver.api.parameters import ApiSettings
from mapserver.dashboard.data import MapData
from mapserver.dashboard.fleet_health import HealthData
from mapserver.dashboard.live import LiveRobots
from mapserver.dashboard.map_layers import Layer, box_around, ground, heat, with_areas
from mapserver.dashboard.rendering import TEMPLATES, address, age
from mapserver.fleet_statistics.kpis import HOUR_NS
from mapserver.operators.roles import Scope

PATH = "/dashboard"
_LOOK_COOKIE, _ZONE_COOKIE = "fleetmap_look", "fleetmap_zone"
RANGE = ("since", "until")
"""The parameters by which every address keeps a range of time."""

_EVERY_S = 1.0
_THEMES = {"dark": "body--dark", "light": ""}  # else as the system has it


@dataclass(frozen=True, slots=True)
class Services:
    """Services of the pages: maps and surveys, fleet health, the robots now, settings of the API; panels: see `shown`."""

    maps: MapData
    health: HealthData
    robots: LiveRobots
    settings: ApiSettings
    panels: dict[str, list[Callable[..., Any]]] = field(default_factory=dict)

    def shown(self, place: str, *of: object) -> list[Any]:
        """What parts add to a place of a page: Markup, or layers of a map, of these services, the page's context and what it is about."""
        return [panel(self, *of) for panel in self.panels.get(place, ())]


class PageContext(NamedTuple):
    """The site that is shown; root: prefix of all addresses; zone: the browser's, None: the server's own."""

    root: str
    site: str
    zone: tzinfo | None = None
    query: Mapping[str, str] = MappingProxyType({})

    def moment(self, stamp_ns: int | None) -> str | None:
        """A stamp of the server's clock by the clock of whoever looks."""
        return moment_text(stamp_ns, self.zone)

    def when(self, moment: int | str) -> Markup:
        """How long ago a stamp of the server's clock or ISO 8601 text is, and where the pointer is the moment."""
        stamp_ns = moment if isinstance(moment, int) else read_moment(moment, "time", UTC) or 0
        words = f"{age(max(0.0, time.time() - stamp_ns / 1e9))} ago"
        return Markup('<time title="{}">{}</time>').format(self.moment(stamp_ns), words)

    def time_range(self) -> tuple[int | None, int | None]:
        """`since` and `until` of the address; UsageError for what is no time."""
        return read_range(self.query.get("since"), self.query.get("until"), self.zone)

    def range_fields(self) -> dict[str, str]:
        """Values of the fields to choose that range by."""
        both = zip(RANGE, self.time_range(), strict=True)
        return {name: "" if ns is None else self.written(ns)[:16] for name, ns in both}

    def range_words(self, usual: str) -> str:
        """That range in words; usual: those without one."""
        since, until = (value.replace("T", " ") for value in self.range_fields().values())
        if since and until:
            return f"{since} to {until[11:] if since[:10] == until[:10] else until}"
        return f"since {since}" if since else f"until {until}" if until else usual

    def range_presets(self, usual: str) -> list[tuple[str, str]]:
        """Ranges of one click: their words and addresses. usual: words of none."""
        now_ns, today = time.time_ns(), date.fromisoformat(self.today)
        hour, day, week = (self.written(now_ns - hours * HOUR_NS) for hours in (1, 24, 7 * 24))
        monday = str(today - timedelta(today.weekday()))
        found = {"Last hour": hour, "Today": self.today, "Last 24 h": day, "Since Monday": monday, "Last 7 days": week}
        kept = self.kept_in_range()
        return [(words, address("", **kept, since=since)) for words, since in (found | {usual: None}).items()]

    @property
    def today(self) -> str:
        """The day, as `since` of an address takes it."""
        return self.written(time.time_ns())[:10]

    def kept_in_range(self) -> dict[str, str]:
        """The parameters of the address that stay when another range is chosen."""
        of_one = (*RANGE, "older", "job")  # what is chosen in a range is perhaps not in another one
        return {"site": self.site} | {name: value for name, value in self.query.items() if name not in of_one}

    def written(self, stamp_ns: int) -> str:
        """A stamp as `since` and `until` of an address take it."""
        return written(stamp_ns, self.zone)

    def to(self, path: str, **query: object) -> str:
        """The address of a page of the same site, in the same time unless `query` has another."""
        return address(f"{self.root}/{path}", **{"site": self.site} | self.range_kept | query)

    @property
    def range_kept(self) -> dict[str, str | None]:
        """Both ends of the range as the address has them."""
        return {name: self.query.get(name) for name in RANGE}

    def doc(self, place: str) -> str:
        """The address of a document, or of a section of it: "floors.md#lifts"."""
        document, mark, section = place.removeprefix("docs/").partition("#")
        return f"{self.to(f'docs/{document}')}{mark}{section}"

    @property
    def api(self) -> str:
        """Prefix of the API's addresses."""
        return f"{self.root.removesuffix(PATH)}/v1"

    def plan_picture(self, version: int) -> str:
        """The address of the picture of a version's plan."""
        return f"{self.root}/plans/{self.site}/{version}.png"


class Page(NamedTuple):
    """A page. fill: what its template needs beside `context`, of the services, it and the parts of its path in braces; may block.

    A FleetmapError of that becomes a notice within the frame. link: title and icon by which all pages link to it; under: the page that
    leads to it, without one that of the first part of its path. knows: query parameters beside those of the frame. usual: what is shown
    of a page over time where its address has no range, in words. under_way: sites that the page knows though the store has no
    version of them, of the one that its address names. of_site: False for a page that shows the same whatever site its address names.
    """

    template: str | Template
    fill: Callable[..., dict[str, object]]
    link: tuple[str, str] | None = None
    under: str = ""
    knows: Sequence[str] = ()
    usual: str = ""
    under_way: Callable[[str | None], list[str]] = lambda _: []
    of_site: bool = True


@dataclass(frozen=True, slots=True)
class Console:
    """Where pages are added. links: title and icon of each page that all pages link to, by its path, in their order; help: what documents
    say of it, as of `PageContext.doc`.
    """

    app: FastAPI
    services: Services
    links: dict[str, tuple[str, str]] = field(default_factory=dict)
    help: dict[str, str] = field(default_factory=dict)

    def files(self, path: str, folder: Path) -> None:
        """Adds what pages load: the files of a folder."""
        self.app.mount(f"/{path}", StaticFiles(directory=folder))

    def nothing_else(self) -> None:
        """Adds the page for addresses that no page has."""

        def no_page(*_: object) -> dict[str, object]:
            raise UsageError("There is no such page here.")

        @self.app.exception_handler(404)
        async def missing(request: Request, _: Exception) -> Response:
            """Within the frame, with a way back."""
            return await self._shown(request, Page("", no_page, under="none", knows=tuple(request.query_params)))

    def page(self, path: str, page: Page) -> None:
        """Adds a page."""
        if page.link is not None:
            self.links[path] = page.link
        page = page._replace(under=page.under or path.partition("/")[0])

        @self.app.get(f"/{path}", include_in_schema=False)
        async def shown(request: Request) -> Response:
            """A page."""
            return await self._shown(request, page)

    def stream(
        self,
        path: str,
        one: Callable[..., dict[str, Any]],
        *,
        shows: Sequence[str] = (),
        under_way: Callable[[str | None], list[str]] = lambda _: [],
    ) -> None:
        """Adds what a page follows: looked at every second and told when it has changed, for as long as the session lasts.

        one: as `fill` of a page. shows: macros of `now.html` that make parts of the page of it, beside the marks on its map.
        """

        @self.app.get(f"/{path}", include_in_schema=False)
        async def followed(request: Request, site: str) -> StreamingResponse:
            """A stream of server-sent events."""
            is_new = site in await to_thread(under_way, site)
            chosen = site if is_new else await to_thread(self.services.maps.chosen_site, site)
            context = PageContext(_root(request), chosen, _zone(request), request.query_params)
            guard, ended = self.services.settings.guard, b"event: ended\ndata: %s\n\n" % SIGN_IN.encode()

            def event() -> bytes:
                if guard.is_sign_in_on and guard.identify(request.scope, uses=False) is None:
                    return ended
                found = one(self.services, context, **request.path_params)
                if shows:
                    made: Any = TEMPLATES.get_template("now.html").make_module({**_rights(request), "context": context})
                    parts = (str(getattr(made, name)(found)) for name in shows)
                    found = {"html": "".join(parts), "marks": found["marks"]}
                return b"data: %s\n\n" % to_json(found)

            async def events() -> AsyncIterator[bytes]:
                told = b""
                while told != ended and not await request.is_disconnected():
                    found = await to_thread(event)
                    yield b":\n\n" if found == told else found
                    told = found
                    await sleep(_EVERY_S)

            return StreamingResponse(events(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})

    async def _shown(self, request: Request, page: Page) -> Response:
        template, root, query, status = page.template, _root(request), request.query_params, 200
        site, sites, maps = query.get("site"), list[str](), self.services.maps
        try:
            growing, stored = await to_thread(page.under_way, site), await to_thread(maps.sites)
            sites = sorted({*stored, *growing})
            if site is None and growing:
                site = growing[0]
            elif not page.of_site:
                site = site if site in sites else next(iter(sites), "")
            elif site not in growing:
                lost = await to_thread(self.services.robots.lost) if site is None else ()
                site = await to_thread(maps.chosen_site, next((one for one in lost if one in stored), site))
            known = ("site", "find", *RANGE, *page.knows)
            if unknown := [name for name in query if name not in known]:
                names = ", ".join(known)
                raise UsageError(f"unknown parameter {unknown[0][:40]!r}; this page knows {names}")
            context = PageContext(root, site, _zone(request), query)
            found = {"context": context} | await to_thread(page.fill, self.services, context, **request.path_params)
            site = str(found.get("site", site))  # a failure and a job have one, whatever the address names
        except FleetmapError as error:
            template, query, found = "problem.html", QueryParams(), {"words": str(error)}
            status = 503 if isinstance(error, StoreError) else 404
            site = site if site in sites else None  # links lead somewhere
        here = PageContext(root, site or "", query=query)
        kept = here.range_kept
        listed = f"{root}/{page.under if page.under in self.links else ''}"  # what is of one site is not looked for in another
        look = request.cookies.get(_LOOK_COOKIE, "")
        frame = {
            **_rights(request),
            "root": root,
            "pages": {path: (*link, address(f"{root}/{path}", site=site, **kept)) for path, link in self.links.items()},
            "kept": {name: value for name, value in kept.items() if value},
            "usual": page.usual,
            "help": here.doc(self.help.get(page.under, "service.md#dashboard")),
            "page": page.under,
            "sites": sites,
            "elsewhere": listed if request.path_params or page.under not in self.links else None,
            "site": site,
            "find": request.query_params.get("find", ""),
            "look": look if look in _THEMES else "",
            "theme": _THEMES.get(look, "print"),
            "sign_out": SIGN_OUT,
            "warning": self.services.settings.guard.warning,
        }
        text = TEMPLATES.get_template(template).render(frame | found)
        headers = {"Cache-Control": "no-store", "ETag": f'"{sha256_hex(text.encode())}"'}
        if request.headers.get("if-none-match") == headers["ETag"]:  # renew.js has it
            return Response(status_code=304, headers=headers)
        return HTMLResponse(text, status, headers)


def number(text: str | None, name: str) -> int | None:
    """A number of the query string, None if it is empty; UsageError for other text."""
    if text is None or text == "":
        return None
    if not text.isascii() or not text.isdecimal() or len(text) > 12:
        raise UsageError(f"{name} {text[:40]!r} is not a number; choose one from the list")
    return int(text)


def scene_of(
    services: Services,
    context: PageContext,
    version: int | None,
    over: Sequence[Layer],
    *,
    dense_m: Mapping[str, Iterable[tuple[float, float]]] = MappingProxyType({}),
    places_m: Sequence[tuple[float, float]] = (),
    shows_coverage: bool = False,
) -> dict[str, object] | None:
    """A version's map with layers over it, for `site_map` of templates; None for a version that is not there.

    dense_m: places by the name of a layer that shows how dense they are, once somebody wants it. places_m: what is in sight first,
    everything without them.
    """
    if version is None or not services.maps.has_version(context.site, version):
        return None
    plan = services.maps.plan(context.site, version)
    over = [*(Layer(name, heat(found, plan.box), shown=False) for name, found in dense_m.items()), *over]
    below = services.maps.underlays(context.site, version, context.root)
    picture, areas = context.plan_picture(version), services.maps.store.areas(context.site)
    layers = [*ground(plan, picture, areas, below, shows_coverage=shows_coverage), *over]
    box = box_around(places_m, with_areas(plan.box, areas))
    return {"label": f"Map of {context.site}, version {version}", "box": box, "layers": layers, "follows": False}


def _rights(request: Request) -> dict[str, object]:
    """Who looks, what they may do, and where the API is."""
    who = getattr(request.state, "operator", None)
    return {
        "api": PageContext(_root(request), "").api,
        "person": who,
        "may": (may := frozenset[str](Scope) if who is None else who.scopes),
        "may_change": Scope.CHANGE in may,
        "may_administer": Scope.OPERATORS in may,
    }


def _zone(request: Request) -> tzinfo | None:
    return zone_of(request.cookies.get(_ZONE_COOKIE))


def _root(request: Request) -> str:
    return str(request.scope.get("root_path", ""))
