"""The common layout of all pages: navigation, light or dark look, and errors as sentences instead of a broken page."""

import asyncio
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, tzinfo
from functools import cache
from pathlib import Path
from typing import TypeVar

from fastapi import Request
from markupsafe import Markup, escape
from nicegui import ui

from fleetmap.errors import FleetmapError, UsageError
from mapserver.api.guard import SIGN_IN, SIGN_OUT, GuardSettings
from mapserver.api.moments import moment_text, read_moment, read_range, zone_of
from mapserver.dashboard.data import MapData
from mapserver.dashboard.fleet_health import HealthData
from mapserver.dashboard.live import LiveRobots
from mapserver.dashboard.map_layers import Layer, box_around, box_of, ground
from mapserver.dashboard.markup import address, age, joined, link, time_fields
from mapserver.dashboard.site_map import SiteMap
from mapserver.serving.live_surveys import LiveSurveys

T = TypeVar("T")

PAGES = {"": "Overview", "trends": "Trends", "map": "Map", "failures": "Failures", "surveys": "Surveys", "live": "Live"}
RESPONSE_TIMEOUT_S = 30.0
_HOUR_NS = 3_600_000_000_000
_WEEK_NS = 7 * 24 * _HOUR_NS
LOOK_COOKIE = "fleetmap_look"
ZONE_COOKIE = "fleetmap_zone"
_TELL_ZONE = (
    f"<script>document.cookie = '{ZONE_COOKIE}=' + Intl.DateTimeFormat().resolvedOptions().timeZone"
    " + ';path=/;max-age=31536000;samesite=strict'</script>"
)
_SWITCH_LOOK = (
    "const dark = !document.body.classList.contains('body--dark');"
    f"document.cookie = '{LOOK_COOKIE}=' + (dark ? 'dark' : 'light') + ';path=/;max-age=31536000;samesite=strict';"
    "setDark(dark)"
)
_CHOOSE_SITE = "this.form.submit()"
HANDLERS = (_SWITCH_LOOK, _CHOOSE_SITE)
"""The code of all event handlers in markup; the guard's policy lets browsers run no other."""
_SESSION_EVERY_S = 10.0


@dataclass(frozen=True, slots=True)
class Services:
    """Services of the pages: maps and surveys, fleet health, the robots now, who is let in, surveys under way."""

    maps: MapData
    health: HealthData
    robots: LiveRobots
    guard: GuardSettings
    surveys: LiveSurveys


@dataclass(frozen=True, slots=True)
class PageContext:
    """The page and the site that are shown; root: prefix of all addresses; zone: the browser's, None: the server's own."""

    root: str
    page: str
    site: str
    zone: tzinfo | None = None
    query: Mapping[str, str] = field(default_factory=dict)

    def moment(self, stamp_ns: int | None) -> str | None:
        """A stamp of the server's clock by the clock of whoever looks."""
        return moment_text(stamp_ns, self.zone)

    def when(self, moment: int | str) -> Markup:
        """How long ago a stamp of the server's clock or ISO 8601 text is, and where the pointer is the moment."""
        stamp_ns = moment if isinstance(moment, int) else read_moment(moment, "time", UTC) or 0
        words = f"{age(max(0.0, time.time() - stamp_ns / 1e9))} ago"
        return Markup('<time title="{}">{}</time>').format(self.moment(stamp_ns), words)

    def written_moment(self, text: str | None) -> str | None:
        """The same of ISO 8601 text."""
        return self.moment(read_moment(text, "time", UTC))

    def time_range(self) -> tuple[int | None, int | None]:
        """`since` and `until` of the address; UsageError for what is no time."""
        return read_range(self.query.get("since"), self.query.get("until"), self.zone)

    def range_fields(self) -> Markup:
        """Fields to choose that range by."""
        return time_fields(*("" if ns is None else self.written(ns) for ns in self.time_range()))

    def range_form(self, path: str, *, usual: str, chosen: Mapping[str, object] | None = None) -> Markup:
        """A form that shows a page for a range of time, and presets of one click that keep what is chosen beside it.

        usual: names what is shown without a range. chosen: other query parameters.
        """
        kept, now_ns = dict(chosen or {}), time.time_ns()
        day = self.written(now_ns)[:10]
        spans = (
            ("Last hour", self.written(now_ns - _HOUR_NS)),
            ("Today", day),
            ("Last 7 days", self.written(now_ns - _WEEK_NS)),
        )
        presets = [link(self.to(path, **kept | {"since": since}), words) for words, since in spans]
        hidden = {"site": self.site} | {name: value for name, value in kept.items() if value}
        return Markup(
            '<form class="ask" method="get" action="{}">{}{}<button type="submit">Show</button>'
            '<span class="presets">{}</span></form>'
        ).format(
            f"{self.root}/{path}",
            joined(Markup('<input type="hidden" name="{}" value="{}">').format(*pair) for pair in hidden.items()),
            self.range_fields(),
            joined([*presets, link(self.to(path, **kept), usual)], " "),
        )

    def written(self, stamp_ns: int) -> str:
        """A stamp as `since` and `until` of an address take it, to the minute."""
        return f"{datetime.fromtimestamp(stamp_ns / 1e9, UTC).astimezone(self.zone):%Y-%m-%dT%H:%M}"

    def to(self, path: str, **query: object) -> str:
        """The address of a page of the same site."""
        return address(f"{self.root}/{path}", site=self.site, **query)

    def plan_picture(self, version: int) -> str:
        """The address of the picture of a version's plan."""
        return f"{self.root}/plans/{self.site}/{version}.png"


def html(content: Markup | str, *, classes: str = "") -> ui.html:
    """Markup on the page. It is not sanitized: `Markup` is made by escaping everything that comes from elsewhere."""
    shown = ui.html(str(content) if isinstance(content, Markup) else str(escape(content)), sanitize=False)
    return shown.classes(classes) if classes else shown


async def load(function: Callable[..., T], *arguments: object) -> T:
    """Result of a blocking function, computed on another thread."""
    return await asyncio.to_thread(function, *arguments)


async def show(
    services: Services,
    request: Request,
    page: str,
    site: str | None,
    build: Callable[[PageContext], Awaitable[None]],
    knows: Sequence[str] = (),
) -> None:
    """The layout of a page with the content of `build`; a FleetmapError becomes a notice in its place.

    knows: query parameters of the page beside the site; others are refused, since a filter that is not applied misleads.
    Pages of what goes on know sites of which the store has no version yet: those that are being surveyed or built.
    """
    root = str(request.scope.get("root_path", ""))
    _set_look(request)
    try:
        sites = await load(services.maps.sites)
        under_way = services.surveys.sites() if page == "live" else []
        if site is None and under_way and (page == "live" or not sites):
            site = under_way[0]
        chosen = site if site in under_way else await load(services.maps.chosen_site, site)
        zone = zone_of(request.cookies.get(ZONE_COOKIE))
        sites, context = sorted({*sites, *under_way}), PageContext(root, page, chosen, zone, request.query_params)
    except FleetmapError as error:
        _head(services, request, page, None, [])
        html(notice("bad", str(error)))
        return
    _head(services, request, page, context.site, sites)
    _end_with_session(services, request)
    try:
        check_query(request, knows)
        await build(context)
    except FleetmapError as error:
        html(notice("bad", str(error)))


def check_query(request: Request, knows: Sequence[str]) -> None:
    """Raises UsageError for a query parameter beside `site` and those that a page knows."""
    unknown = [name for name in request.query_params if name not in {"site", *knows}]
    if unknown:
        raise UsageError(f"unknown parameter {unknown[0][:40]!r}; this page knows {', '.join(('site', *knows))}")


async def version_map(
    services: Services,
    context: PageContext,
    version: int,
    over: Sequence[Layer],
    *,
    is_small: bool = False,
    places_m: Sequence[tuple[float, float]] = (),
) -> SiteMap:
    """A version's map with layers over it; their items may change. places_m: what is in sight first, everything without them."""
    plan = await load(services.maps.plan, context.site, version)
    below = await load(services.maps.underlays, context.site, version, context.root)
    areas = await load(services.maps.areas, context.site)
    layers = [*ground(plan, context.plan_picture(version), areas, below), *over]
    with ui.element("div"):
        return SiteMap(
            f"Map of {context.site}, version {version}", box_around(places_m, box_of(plan)), layers, is_small=is_small
        )


def notice(tone: str, words: object) -> Markup:
    """A sentence that must be seen."""
    return Markup('<p class="notice {}" role="status">{}</p>').format(tone, words)


def number(text: str | None, name: str) -> int | None:
    """A number of the query string, None if it is empty; UsageError for other text."""
    if text is None or text == "":
        return None
    if not text.isascii() or not text.isdecimal() or len(text) > 12:
        raise UsageError(f"{name} {text[:40]!r} is not a number; choose one from the list")
    return int(text)


@cache
def _style() -> str:
    return f"<style>{(Path(__file__).parent / 'static' / 'style.css').read_text('utf-8')}</style>"


def _set_look(request: Request) -> None:
    """The look that was chosen with the button, else that of the browser."""
    ui.add_head_html(_style() + _TELL_ZONE)
    look = request.cookies.get(LOOK_COOKIE)
    if look in {"dark", "light"}:
        ui.dark_mode(look == "dark")


def _end_with_session(services: Services, request: Request) -> None:
    """Leaves the page when the session has ended that opened it: an open page must not outlive it."""
    if getattr(request.state, "operator", None) is None:
        return
    client = ui.context.client

    async def look() -> None:
        if await load(lambda: services.guard.identify(request.scope, uses=False)) is None:
            ui.navigate.to(SIGN_IN)
            client.content.clear()  # for one that does not follow

    ui.timer(_SESSION_EVERY_S, look)


def person(request: Request) -> Markup:
    """Name and role of the operator who is signed in, and the way out."""
    who = getattr(request.state, "operator", None)
    if who is None:
        return Markup("")
    if not who.proof:  # signed in by a proxy, which has its own way out
        return Markup('<span class="quiet">{} ({})</span>').format(who.name, who.role)
    return Markup(
        '<form method="post" action="{}"><span class="quiet">{} ({})</span> <button class="plain" type="submit">Sign out</button></form>'
    ).format(SIGN_OUT, who.name, who.role)


def _head(services: Services, request: Request, page: str, site: str | None, sites: list[str]) -> None:
    root = str(request.scope.get("root_path", ""))
    links = joined(
        Markup('<a href="{}"{}>{}</a>').format(
            address(f"{root}/{path}", site=site), Markup(' aria-current="page"') if path == page else "", name
        )
        for path, name in PAGES.items()
    )
    options = joined(
        Markup('<option value="{0}"{1}>{0}</option>').format(name, Markup(" selected") if name == site else "")
        for name in sites
    )
    chooser = Markup(
        '<form method="get" action="{}"><label>Site <select name="site" onchange="{}">{}</select></label></form>'
    ).format(f"{root}/{page}", _CHOOSE_SITE, options)
    html(
        Markup(
            '<nav class="top"><strong>fleetmap</strong>{}<span class="space"></span>{}'
            '<button class="plain" type="button" onclick="{}">Light or dark</button>{}</nav>'
        ).format(links, chooser if sites else "", _SWITCH_LOOK, person(request))
    )
    if services.guard.warning:
        html(notice("bad", services.guard.warning))
