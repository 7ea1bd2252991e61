"""The list of failures by robot, version, area, tile, cause and time."""

from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from fleetmap.messages import FailureKind
from mapserver.dashboard.data import EVER
from mapserver.dashboard.fleet_health import FAILURES_SHOWN, FilterChoices
from mapserver.dashboard.layout import (
    RESPONSE_TIMEOUT_S,
    PageContext,
    Services,
    html,
    load,
    number,
    show,
    version_map,
)
from mapserver.dashboard.map_layers import Box, Layer, Mark, box_of, heat
from mapserver.dashboard.markup import badge, choices, joined, link, table
from mapserver.store import FailureFilter, FailureRow

_REFRESH_S = 3.0
_KNOWN = ("robot", "version", "area", "tile", "cause", "since", "until", "before")
_KINDS = {FailureKind.NOT_FOUND: "does not find itself"}


def install(services: Services) -> None:
    """Adds the page."""

    @ui.page("/failures", title="Failures – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def failures_page(request: Request, site: str | None = None) -> None:
        async def build(context: PageContext) -> None:
            query = request.query_params
            since_ns, until_ns = context.time_range()
            wanted = FailureFilter(
                site=context.site,
                robot=query.get("robot") or None,
                version=number(query.get("version"), "version"),
                tile=query.get("tile") or None,
                cause=query.get("cause") or None,
                area=query.get("area") or None,
                since_ns=since_ns,
                until_ns=until_ns,
            )
            html(Markup("<h1>Failures of {}</h1>").format(context.site))
            html(_filters(context, wanted, await load(services.health.choices, context.site)))
            await _list(services, context, wanted, number(query.get("before"), "failure"))

        await show(services, request, "failures", site, build, _KNOWN)


def _filters(context: PageContext, wanted: FailureFilter, known: FilterChoices) -> Markup:
    fields = [
        choices("robot", "Robot", known.robots, wanted.robot),
        choices("version", "Map version", known.versions, None if wanted.version is None else str(wanted.version)),
        choices("area", "Area", known.areas, wanted.area) if known.areas or wanted.area else "",
        choices("tile", "Tile", known.tiles, wanted.tile),
        choices("cause", "Cause", known.causes, wanted.cause),
    ]
    chosen = {name: context.query.get(name) for name in _KNOWN if name not in {"since", "until", "before"}}
    form = context.range_form("failures", usual="Show all", chosen=chosen, fields=joined(fields))
    return Markup("{}{}").format(form, _areas(context, known.areas))


def _areas(context: PageContext, names: list[str]) -> Markup:
    """Every named area, one click away; what else is chosen stays."""
    if not names:
        return Markup("")
    kept = {name: context.query.get(name) for name in _KNOWN if name not in {"area", "tile", "before"}}
    links = joined((link(context.to("failures", **kept | {"area": name}), name) for name in names), " ")
    return Markup('<nav class="areas" aria-label="Areas">{}</nav>').format(links)


async def _list(services: Services, context: PageContext, wanted: FailureFilter, before: int | None) -> None:
    """The map and the table; the newest page is refreshed when failures arrive."""
    shown = await load(services.health.failures, wanted, before)
    version = wanted.version or await load(services.maps.current_version, context.site)
    shown_map = None
    if version is not None:
        box = box_of(await load(services.maps.plan, context.site, version))
        layers = [
            Layer("Density", heat(_places(shown), box), shown=False),
            Layer("Failures", failure_marks(context, shown)),
        ]
        shown_map = await version_map(services, context, version, layers)
    listed = html(_rows(context, shown))

    async def refresh() -> None:
        nonlocal shown
        found = await load(services.health.failures, wanted, None)
        if found != shown:
            shown = found
            listed.set_content(str(_rows(context, found)))
            if shown_map is not None:
                shown_map.show("Failures", failure_marks(context, found))
                shown_map.show("Density", heat(_places(found), box))

    if before is None:
        ui.timer(_REFRESH_S, refresh, immediate=False)


def _places(shown: list[FailureRow]) -> list[tuple[float, float]]:
    return [(row.x_map_m, row.y_map_m) for row in shown if row.x_map_m is not None and row.y_map_m is not None]


def failure_marks(context: PageContext, shown: list[FailureRow]) -> list[Mark]:
    """Crosses at the failures that have a position."""
    found = []
    for row in reversed(shown):
        if row.x_map_m is not None and row.y_map_m is not None:
            words, to_failure = f"failure {row.number}: {row.robot}, {row.cause}", context.to(f"failures/{row.number}")
            found.append(Mark(row.x_map_m, row.y_map_m, tone_of(row), "cross", words, to_failure))
    return found


async def failure_heat(services: Services, context: PageContext, box: Box) -> Layer:
    """Where failures of the range in the address are dense, without one those of the last days; not shown until it is chosen."""
    span_ns = context.time_range()
    name = "Failures of the last days" if span_ns == EVER else "Failures of the chosen time"
    return Layer(name, heat(await load(services.health.places, context.site, *span_ns), box), shown=False)


def tone_of(row: FailureRow) -> str:
    """The tone of a failure: a suspected one is an estimate."""
    return "warn" if row.kind == FailureKind.SUSPECTED else "bad"


def _kind(row: FailureRow) -> Markup:
    return badge(
        tone_of(row), _KINDS.get(FailureKind(row.kind), row.kind) if row.kind in set(FailureKind) else row.kind
    )


def _rows(context: PageContext, found: list[FailureRow]) -> Markup:
    shown = found[:FAILURES_SHOWN]
    listed = failure_table(context, shown, "No failures match these filters.")
    if len(found) <= FAILURES_SHOWN:
        return listed
    filters = {name: context.query.get(name) for name in _KNOWN}
    older = context.to("failures", **(filters | {"before": shown[-1].number}))
    return Markup("{}<p>{}</p>").format(listed, link(older, "Older failures"))


def failure_table(context: PageContext, shown: list[FailureRow], empty: str) -> Markup:
    """Failures as a table; empty: the sentence where there are none."""
    rows = [
        (
            link(context.to(f"failures/{row.number}"), f"Failure {row.number}"),
            context.moment(row.happened_ns),
            link(context.to(f"robots/{row.robot}"), row.robot),
            row.cause.replace("_", " "),
            _kind(row),
            row.version,
            row.where,
            f"{row.duration_s:.0f} s",
        )
        for row in shown
    ]
    head = ("Failure", "When", "Robot", "Cause", "Kind", "Map version", "Where", "Duration")
    return table(head, rows, empty=empty, name="Failures")
