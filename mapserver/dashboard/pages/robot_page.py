"""The page of a robot: what it is now and since when, where it drove, its states one after the other, its failures."""

import time

from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from fleetmap.errors import UsageError
from mapserver.dashboard.failures import failure_marks, tone_of
from mapserver.dashboard.fleet_health import FAILURES_SHOWN
from mapserver.dashboard.layout import (
    RESPONSE_TIMEOUT_S,
    PageContext,
    Services,
    back_link,
    html,
    load,
    notice,
    show,
    version_map,
)
from mapserver.dashboard.live import STATUSES, LiveRobot
from mapserver.dashboard.map_layers import Layer, Line, Mark
from mapserver.dashboard.markup import age, badge, facts, joined, link, table
from mapserver.dashboard.pages.placing import CHOSEN, place_form
from mapserver.dashboard.robot_history import SILENT, Stretch, stretches
from mapserver.fleet_statistics.robot_calibration import PARAMETERS
from mapserver.floor_plan.areas import Areas
from mapserver.store import FailureDetail, FailureFilter, FailureRow, TraceRow

_REFRESH_S = 1.0
_USUAL_NS = 24 * 3_600_000_000_000
_ROWS = 60
_LAST_FAILURES, _PICTURES, _FRAMES = 5, 3, {"frame", "replay"}
_BROKEN_NS = 30_000_000_000  # rows further apart are no way
_SHAPES = {"good": "circle", "warn": "triangle", "bad": "square", "quiet": "circle"}
Range = tuple[int, int]


def install(services: Services) -> None:
    """Adds the page."""

    @ui.page("/robots/{robot}", title="Robot – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def robot_page(request: Request, robot: str, site: str | None = None) -> None:
        async def build(context: PageContext) -> None:
            found = (await load(services.robots.look, context.site)).robot(robot)
            if found is None:
                raise UsageError(f"site {context.site} never heard of a robot {robot[:40]!r}; the Overview lists them")
            await _page(services, context, found)

        await show(services, request, "robots", site, build, ("since", "until"))


async def _page(services: Services, context: PageContext, robot: LiveRobot) -> None:
    areas = await load(services.maps.areas, context.site)
    html(back_link(context, "", "All robots"))
    html(Markup("<h1>{}</h1>").format(robot.name))
    answer = html(_answer(context, robot, areas))
    since_ns, until_ns = context.time_range()
    now_ns = time.time_ns()
    shown = (since_ns if since_ns is not None else min(now_ns, until_ns or now_ns) - _USUAL_NS, until_ns or now_ns)
    rows = await load(services.health.trace, context.site, robot.name, *shown)
    wanted = FailureFilter(site=context.site, robot=robot.name, since_ns=shown[0], until_ns=until_ns)
    failures = await load(services.health.failures, wanted, None)
    version = robot.version or await load(services.maps.current_version, context.site)
    drawn = None
    with ui.element("div").classes("pair"):
        with ui.element("div"):
            if version is not None and await load(services.maps.has_version, context.site, version):
                layers = [
                    Layer("Way", way(rows)),
                    Layer("Failures", failure_marks(context, failures)),
                    Layer("Robots", _mark(robot)),
                    CHOSEN,
                ]
                drawn = await version_map(services, context, version, layers)
                place_form(services, context, robot.name, drawn)
        told = html(_facts(context, robot))
    parts = stretches(rows, *shown)
    html(_range_form(context, robot.name))
    html(_timeline(context, parts, shown))
    last = FailureFilter(site=context.site, robot=robot.name, until_ns=shown[0])
    before = [] if failures else (await load(services.health.failures, last, None))[:_LAST_FAILURES]
    html(_failures(context, failures, before))
    newest = next(iter(failures or before), None)
    if newest is not None:
        html(_last_pictures(context, await load(services.health.failure, newest.number)))
    html(_states(context, parts))

    async def refresh() -> None:
        found = (await load(services.robots.look, context.site)).robot(robot.name)
        if found is None:
            return
        answer.set_content(str(_answer(context, found, areas)))
        told.set_content(str(_facts(context, found)))
        if drawn is not None:
            drawn.show("Robots", _mark(found))

    ui.timer(_REFRESH_S, refresh, immediate=False)


def where_words(robot: LiveRobot, areas: Areas) -> str:
    """Where a robot was last, as people know it; empty where it never said."""
    if robot.place_m is None:
        return ""
    x, y = robot.place_m
    return areas.at(x, y) or f"at {x:.1f}, {y:.1f} m"


def _answer(context: PageContext, robot: LiveRobot, areas: Areas) -> Markup:
    """What it is now, and since when."""
    where = where_words(robot, areas)
    if robot.tone == "quiet":
        return notice(
            "", f"{robot.words.capitalize()}: last heard {age(robot.seconds_since)} ago{f', {where}' * bool(where)}."
        )
    since = ""
    if robot.since_ns is not None:
        since = f" since {context.moment(robot.since_ns)} ({age(max(0.0, time.time() - robot.since_ns / 1e9))})"
    words = f"{robot.words.capitalize()}{since}{f', {where}' * bool(where)}."
    flags = f" It reports: {', '.join(robot.flags)}.".replace("_", " ") if robot.flags else ""
    return notice(robot.tone, words + flags)


def _facts(context: PageContext, robot: LiveRobot) -> Markup:
    metrics = robot.metrics

    def figure(name: str, unit: str, digits: int = 1) -> str | None:
        value = metrics.get(name)
        return f"{value:.{digits}f}{unit}" if isinstance(value, int | float) else None

    version = "none" if robot.version is None else link(context.to("map", version=robot.version), robot.version)
    if robot.is_behind and robot.wanted_version is not None:
        version = Markup("{}, should be {}").format(version, robot.wanted_version)
    clock = "–" if robot.clock_ahead_s is None else f"{robot.clock_ahead_s:+.2f} s"
    pairs: list[tuple[str, object]] = [
        ("Map version", version),
        ("Refuses a version", robot.refused or None),
        ("Tries a new version", "yes" if robot.is_canary else "no"),
        ("CPU of a frame, mean", figure("frame_ms_mean", " ms")),
        ("CPU of a frame, slowest of a hundred", figure("frame_ms_p99", " ms")),
        ("Brightness of the image (0 to 1)", figure("exposure", "", 2)),
        ("Sharpness (1 is usual)", figure("sharpness", "", 2)),
        ("Believed uncertainty (95 % radius)", figure("radius_95_m", " m", 2)),
        ("Speed", figure("speed_mps", " m/s", 2)),
        ("Clock against the server's", clock),
        ("Failure reports that wait", figure("spool_waiting", "", 0)),
        ("Cameras against the map", "; ".join(f"{PARAMETERS[f.name]} {f.words}" for f in robot.calibration) or None),
    ]
    return Markup("<div><h2>Now</h2>{}</div>").format(facts(pairs))


def _mark(robot: LiveRobot) -> list[Mark]:
    if robot.place_m is None:
        return []
    words = f"{robot.name}: {robot.words}"
    return [Mark(*robot.place_m, robot.tone, _SHAPES[robot.tone], words, None, robot.name, robot.heading_rad)]


def way(rows: list[TraceRow]) -> list[Line]:
    """Where it drove, by tone; nothing joins what lies apart in time."""
    found: list[Line] = []
    last: tuple[int, float, float] | None = None
    for row in rows:
        if row.x_map_m is None or row.y_map_m is None:
            last = None
            continue
        here, tone = (round(row.x_map_m, 2), round(row.y_map_m, 2)), STATUSES.get(row.status, ("", "quiet"))[1]
        if last is not None and row.heard_ns - last[0] <= _BROKEN_NS:
            if found and found[-1].tone == tone and found[-1].points[-1] == last[1:]:
                found[-1].points.append(here)
            else:
                found.append(Line([last[1:], here], tone))
        last = (row.heard_ns, *here)
    return found


def _range_form(context: PageContext, robot: str) -> Markup:
    return Markup("<h2>What it was, and when</h2>{}").format(context.range_form(f"robots/{robot}", usual="Last 24 h"))


def _failures(context: PageContext, found: list[FailureRow], before: list[FailureRow]) -> Markup:
    """Those of the range; where it has none, the last ones before it."""
    none = (
        "No failures in this time; the last ones before it:"
        if before
        else "No failures in this time, and none before it."
    )
    told = Markup('<p class="quiet">{}</p>').format(none) if not found else ""
    listed = _failure_table(context, (found or before)[:FAILURES_SHOWN])
    return Markup("<h2>Failures</h2>{}{}").format(told, listed if found or before else "")


def _failure_table(context: PageContext, shown: list[FailureRow]) -> Markup:
    """Failures as a table."""
    rows = [
        (
            link(context.to(f"failures/{row.number}"), f"Failure {row.number}"),
            context.moment(row.happened_ns),
            link(context.to(f"robots/{row.robot}"), row.robot),
            row.cause.replace("_", " "),
            badge(tone_of(row), row.kind.replace("_", " ")),
            row.version,
            row.where,
            f"{row.duration_s:.0f} s",
        )
        for row in shown
    ]
    head = ("Failure", "When", "Robot", "Cause", "Kind", "Map version", "Where", "Duration")
    return table(head, rows, empty="", name="Failures")


def _last_pictures(context: PageContext, found: FailureDetail) -> Markup:
    """What its camera last showed: robots send pictures with failures alone."""
    frames = sorted(
        (each for each in found.pictures if each.kind in _FRAMES),
        key=lambda each: abs(each.stamp_ns - found.report.stamp_ns),
    )[:_PICTURES]
    if not frames:
        return Markup("")
    row = found.failure
    figure = Markup('<figure><img src="{0}" alt="{1}" loading="lazy"><figcaption>{1}</figcaption></figure>')
    drawn = joined(
        figure.format(
            f"{context.root}/pictures/{row.number}/{each.place}.jpg", _beside(each.stamp_ns - found.report.stamp_ns)
        )
        for each in sorted(frames, key=lambda each: each.stamp_ns)
    )
    told = Markup("Robots send pictures with failures alone; these are of {} at {}.").format(
        link(context.to(f"failures/{row.number}"), f"failure {row.number}"), context.moment(row.happened_ns)
    )
    return Markup('<h2>Its last pictures</h2><p class="quiet">{}</p><div class="pictures row">{}</div>').format(
        told, drawn
    )


def _beside(after_ns: int) -> str:
    return f"{abs(after_ns) / 1e9:.1f} s {'before' if after_ns < 0 else 'after'} the beginning"


def _timeline(context: PageContext, found: list[Stretch], shown: Range) -> Markup:
    """A bar of the states."""
    if not found:
        return Markup(
            '<p class="quiet">Nothing is kept of this time; traces stay two days unless [ingest] says otherwise.</p>'
        )
    whole_ns = max(1, shown[1] - shown[0])
    part = Markup('<i class="{}" style="left:{:.3f}%;width:{:.3f}%" title="{}"></i>')
    bar = joined(
        part.format(
            _words(stretch)[1],
            100 * (stretch.since_ns - shown[0]) / whole_ns,
            100 * (stretch.until_ns - stretch.since_ns) / whole_ns,
            f"{_words(stretch)[0]}, {context.moment(stretch.since_ns)}, {age((stretch.until_ns - stretch.since_ns) / 1e9)}",
        )
        for stretch in found
    )
    begin, end = (context.moment(ns) for ns in shown)
    return Markup(
        '<div class="timeline" role="img" aria-label="States from {0} to {1}">{2}</div>'
        '<p class="ends quiet"><span>{0}</span><span>{1}</span></p>'
    ).format(begin, end, bar)


def _states(context: PageContext, found: list[Stretch]) -> Markup:
    """The same as a table, the last one first."""
    if not found:
        return Markup("")
    rows = [
        (
            context.moment(stretch.since_ns),
            age((stretch.until_ns - stretch.since_ns) / 1e9),
            badge(_words(stretch)[1], _words(stretch)[0]),
            stretch.flags.replace(",", ", ").replace("_", " "),
            stretch.version,
            None if stretch.frame_ms is None else f"{stretch.frame_ms:.1f} ms",
            None if stretch.exposure is None else f"{stretch.exposure:.2f}",
            None if stretch.sharpness is None else f"{stretch.sharpness:.2f}",
        )
        for stretch in found[::-1][:_ROWS]
    ]
    head = ("Since", "For", "State", "Cause", "Map version", "CPU of a frame", "Brightness", "Sharpness")
    more = f"and {len(found) - _ROWS} before that" if len(found) > _ROWS else ""
    listed = table(head, rows, empty="", name="States, the last one first")
    return Markup('<h2>Its states, the last one first</h2>{}<p class="quiet">{}</p>').format(listed, more)


def _words(stretch: Stretch) -> tuple[str, str]:
    if stretch.status == SILENT:
        return "silent", "quiet"
    return STATUSES.get(stretch.status, (stretch.status.lower(), "warn"))
