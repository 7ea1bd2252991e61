"""The fleet page: the robots now, on the map and one by one, and their failure rates."""

import time
from typing import Any

from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from fleetmap.messages import Status
from mapserver.dashboard import fleet_parts
from mapserver.dashboard.data import EVER
from mapserver.dashboard.fleet_health import SiteHealth
from mapserver.dashboard.fleet_parts import Figure
from mapserver.dashboard.layout import RESPONSE_TIMEOUT_S, PageContext, Services, html, load, notice, show, version_map
from mapserver.dashboard.live import STATUSES, LiveRobot, LiveSite
from mapserver.dashboard.map_layers import Layer, Mark, box_of
from mapserver.dashboard.markup import age, badge, joined, link, share, table
from mapserver.dashboard.pages.failures_page import failure_heat
from mapserver.dashboard.pages.robot_page import where_words
from mapserver.dashboard.site_map import SiteMap
from mapserver.fleet_statistics.kpis import Kpis, driven_words
from mapserver.fleet_statistics.robot_calibration import PARAMETERS, CalibrationFigure
from mapserver.floor_plan.areas import Areas

_ATTENTION_ROWS = 6
_MOVE_EVERY_S, _TABLE_EVERY_S = 1.0, 2.0
_SHAPES = {"good": "circle", "warn": "triangle", "bad": "square", "quiet": "circle"}
_TONE_WORDS = {
    "good": "localised",
    "warn": "unsure or starting",
    "bad": "not localised",
    "quiet": "silent, last position",
}
_COLUMNS = {
    "robot": "Robot",
    "state": "State",
    "version": "Map version",
    "rate": "Failures in 24 h",
    "localised": "Localised while driving",
    "since": "Last heard",
    "remarks": "Remarks",
}


def install(services: Services) -> None:
    """Adds the page."""

    @ui.page("/", title="Fleet – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def fleet_page(request: Request, site: str | None = None) -> None:
        async def build(context: PageContext) -> None:
            live = await load(services.robots.look, context.site)
            health = await load(services.health.site, context.site)
            areas = await load(services.maps.areas, context.site)
            html(Markup("<h1>Robots of {}</h1>").format(context.site))
            attention = html(_attention(context, live, areas))
            week = html(fleet_parts.worse_sentence(health.areas))
            trials = html(fleet_parts.trial_notices(health.trials, context.moment))
            drawn = await _map(services, context, live)
            html(context.range_form("", usual="Last 24 h"))
            chosen = await _chosen(services, context)
            figures = html(_figures(live, health, chosen))
            worse = html(_worse(context, health))
            chart = html(_rates(health))
            robots = _table(context, live, health)
            calibrations = html(fleet_parts.calibrations(_calibrations(live)))
            html(fleet_parts.resurvey(health.resurvey, lambda tile: context.to("failures", tile=tile)))

            async def move() -> None:
                live = await load(services.robots.look, context.site)
                health = await load(services.health.site, context.site)
                attention.set_content(str(_attention(context, live, areas)))
                figures.set_content(str(_figures(live, health, chosen)))
                trials.set_content(str(fleet_parts.trial_notices(health.trials, context.moment)))
                if drawn is not None:
                    drawn.show("Robots", _marks(context, live))

            async def refresh_table() -> None:
                nonlocal chosen
                chosen = await _chosen(services, context)
                live = await load(services.robots.look, context.site)
                health = await load(services.health.site, context.site)
                rows = _rows(context, live, health)
                if rows != robots.rows:
                    robots.rows = rows
                week.set_content(str(fleet_parts.worse_sentence(health.areas)))
                worse.set_content(str(_worse(context, health)))
                chart.set_content(str(_rates(health)))
                calibrations.set_content(str(fleet_parts.calibrations(_calibrations(live))))

            ui.timer(_MOVE_EVERY_S, move, immediate=False)
            ui.timer(_TABLE_EVERY_S, refresh_table, immediate=False)

        await show(services, request, "", site, build, ("since", "until"))


def _attention(context: PageContext, live: LiveSite, areas: Areas) -> Markup:
    """Whether anything is wrong now: which robots, where, since when and why."""
    heard = [robot for robot in live.robots if robot.tone != "quiet"]
    found = [robot for robot in heard if robot.tone in {"bad", "warn"} or _troubles(robot)]
    silent = len(live.robots) - len(heard)
    more = f" {silent} {'is' if silent == 1 else 'are'} silent." if silent else ""
    if not found:
        words = (
            f"Nothing is wrong now: all {len(heard)} robots that are heard are localised."
            if heard
            else "No robot is heard now."
        )
        return notice("good" if heard else "", words + more)
    lost = sum(robot.tone == "bad" for robot in found)
    rows = [
        (
            link(context.to(f"robots/{robot.name}"), robot.name),
            badge(robot.tone, robot.words),
            _since(context, robot),
            where_words(robot, areas),
            ", ".join((*robot.flags, *_troubles(robot))).replace("_", " "),
        )
        for robot in found[:_ATTENTION_ROWS]
    ]
    head = ("Robot", "State", "Since", "Last seen", "Why")
    rest = f" and {len(found) - _ATTENTION_ROWS} more, in the table below." if len(found) > _ATTENTION_ROWS else ""
    told = f"{len(found)} of {len(heard)} robots need a look; {lost} {'does' if lost == 1 else 'do'} not know where they are.{more}"
    return Markup('<div class="attention">{}{}<p class="quiet">{}</p></div>').format(
        notice("bad" if lost else "warn", told), table(head, rows, empty="", name="Robots that need a look"), rest
    )


def _troubles(robot: LiveRobot) -> list[str]:
    """What is wrong beside the state."""
    found = [f"refuses a version: {robot.refused}"] if robot.refused else []
    found += ["was connected twice: was its certificate copied?"] if robot.is_copied else []
    return found + [f"{PARAMETERS[f.name]} drifts" for f in robot.calibration if f.is_drifted]


def _since(context: PageContext, robot: LiveRobot) -> str | None:
    """When its state began; of a robot that is well, nothing."""
    if robot.since_ns is None or robot.tone == "good":
        return None
    return f"{context.moment(robot.since_ns)} ({age(max(0.0, time.time() - robot.since_ns / 1e9))})"


async def _chosen(services: Services, context: PageContext) -> Kpis | None:
    """Figures of the range in the address, None without one."""
    span_ns = context.time_range()
    return None if span_ns == EVER else await load(services.health.span, context.site, *span_ns)


def _figures(live: LiveSite, health: SiteHealth, chosen: Kpis | None) -> Markup:
    """The robots now, and the figures of the last 24 h or of the chosen time."""
    heard = len(live.robots) - live.count("quiet")
    lost = live.count("bad")
    several = live.count("bad", STATUSES[Status.AMBIGUOUS][0])
    day, when, trend = health.day, "last 24 h", f"; {health.trend}"
    if chosen is not None:
        day, when, trend = chosen, "chosen hours", ""
    return fleet_parts.figures(
        [
            fleet_parts.localised_figure(f"Localised while driving, {when}", day),
            Figure("Robots heard now", f"{heard} of {len(live.robots)}", "reported within 10 s"),
            Figure("Localised now", live.count("good"), f"{live.count('warn')} unsure or starting", "good"),
            Figure(
                "Not localised now",
                lost,
                f"{lost - several} lost, {several} where several places fit",
                "bad" if lost else "",
            ),
            fleet_parts.rate_figure(f"Failures per robot-day, {when}", day.failures, trend),
            fleet_parts.rate_figure("Silent failures per robot-day, an estimate", day.silent_estimated, ""),
            Figure("Time with a usable position", share(day.availability) or "–", f"of the {when}"),
        ]
    )


async def _map(services: Services, context: PageContext, live: LiveSite) -> SiteMap | None:
    """The site map with the robots; None without a version."""
    version = await load(services.maps.current_version, context.site)
    if version is None:
        html(Markup('<p class="notice">No map is published yet: robots cannot be shown on it.</p>'))
        return None
    box = box_of(await load(services.maps.plan, context.site, version))
    layers = [
        await failure_heat(services, context, box),
        Layer("Robots", _marks(context, live)),
    ]
    shown = await version_map(services, context, version, layers)
    html(_legend())
    return shown


def _marks(context: PageContext, live: LiveSite) -> list[Mark]:
    """Robots that ever sent a position, those in trouble on top."""
    found = []
    for robot in reversed(live.robots):
        if robot.place_m is not None:
            shape, words = _SHAPES.get(robot.tone, "circle"), f"{robot.name}: {robot.words}"
            address, (x, y) = context.to(f"robots/{robot.name}"), robot.place_m
            place = round(x, 2), round(y, 2)
            found.append(Mark(*place, robot.tone, shape, words, address, robot.name, robot.heading_rad))
    return found


def _legend() -> Markup:
    entry = Markup('<span class="{0}"><i class="{1}"></i>{2}</span>')
    return Markup('<div class="legend">{}</div>').format(
        joined(entry.format(tone, _SHAPES[tone], words) for tone, words in _TONE_WORDS.items())
    )


def _worse(context: PageContext, health: SiteHealth) -> Markup:
    """Area by area the last week beside the one before, each with its failures of this week."""
    axis, since = ("area" if health.has_areas else "tile"), context.written(health.week_since_ns)
    return fleet_parts.got_worse(
        health.areas, lambda name: context.to("failures", **{axis: name, "since": since}), has_areas=health.has_areas
    )


def _rates(health: SiteHealth) -> Markup:
    """Failures per robot-day of the last days."""
    last = len(health.days) - 1
    bars = [fleet_parts.rate_bar("24 h" if n == last else f"-{last - n} d", day) for n, day in enumerate(health.days)]
    day = health.day.failures
    remark = f"A bar for each 24 hours. Last 24 hours: {day.events} in {driven_words(day.robot_days)}, {health.trend}."
    return fleet_parts.rates(bars, remark)


def _calibrations(live: LiveSite) -> list[tuple[str, tuple[CalibrationFigure, ...]]]:
    return [(robot.name, robot.calibration) for robot in live.robots if robot.calibration]


def _table(context: PageContext, live: LiveSite, health: SiteHealth) -> ui.table:
    html(Markup("<h2>Robots, problems first</h2>"))
    columns = [
        {"name": name, "label": label, "field": name, "sortable": True, "align": "left"}
        for name, label in _COLUMNS.items()
    ]
    with ui.element("div"):
        look_for = ui.input("Find a robot, state or version").props("outlined dense clearable").style("width:320px")
    shown = ui.table(columns=columns, rows=_rows(context, live, health), row_key="robot", pagination=25)
    shown.props('flat wrap-cells color=ink :rows-per-page-options="[25, 100, 0]"')
    look_for.bind_value_to(shown, "filter")
    shown.add_slot(
        "body-cell-state",
        '<q-td :props="props"><span :class="\'badge \' + props.row.tone">{{ props.value }}</span></q-td>',
    )
    shown.add_slot("body-cell-robot", '<q-td :props="props"><a :href="props.row.to">{{ props.value }}</a></q-td>')
    return shown


def _rows(context: PageContext, live: LiveSite, health: SiteHealth) -> list[dict[str, Any]]:
    return [_row(context, robot, health) for robot in live.robots]


def _row(context: PageContext, robot: LiveRobot, health: SiteHealth) -> dict[str, Any]:
    own = health.robots.get(robot.name)
    version = "none" if robot.version is None else str(robot.version)
    if robot.is_behind and robot.wanted_version is not None:
        version += f", should be {robot.wanted_version}"
    remarks = [*robot.flags, *(f"{PARAMETERS[f.name]} {f.words}" for f in robot.calibration if f.is_drifted)]
    if robot.is_canary:
        remarks.append("tries a new version")
    if own is not None and own.silent_estimated.events:
        remarks.append(f"suspected failures: {own.silent_estimated.events}")
    if robot.refused:
        remarks.append(f"refuses: {robot.refused}")
    if robot.clock_ahead_s is not None and abs(robot.clock_ahead_s) >= 1:
        remarks.append(f"clock wrong by {robot.clock_ahead_s:+.0f} s")
    return {
        "robot": robot.name,
        "state": robot.words,
        "tone": robot.tone,
        "version": version,
        "rate": 0 if own is None else own.failures.events + own.failures_running,
        "localised": "–" if own is None else share(own.localised_share_of_all) or "–",
        "since": "now" if robot.seconds_since < 3 else f"{age(robot.seconds_since)} ago",
        "remarks": ", ".join(remarks),
        "to": context.to(f"robots/{robot.name}"),
    }
