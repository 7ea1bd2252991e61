"""The fleet page: how the robots do now, on the map and one by one, and how often they fail."""

from typing import Any

from fastapi import Request
from markupsafe import Markup
from nicegui import ui

from mapserver.dashboard import drawing
from mapserver.dashboard.drawing import Bar, Mark
from mapserver.dashboard.fleet_health import SiteHealth, Trial
from mapserver.dashboard.layout import RESPONSE_TIMEOUT_S, Rooms, Where, html, load, show
from mapserver.dashboard.live import LiveRobot, LiveSite
from mapserver.dashboard.map_page import picture_address
from mapserver.dashboard.markup import age, badge, joined, link, moment, share, table
from mapserver.dashboard.plan import Plan
from mapserver.fleet_statistics.kpis import Rate
from mapserver.fleet_statistics.rate_format import driven_words, figure, is_telling, rate_words

_MOVE_EVERY_S, _LIST_EVERY_S = 1.0, 2.0
_SHAPES = {"good": "circle", "warn": "triangle", "bad": "square", "quiet": "circle"}
_TONE_WORDS = {"good": "localised", "warn": "unsure or starting", "bad": "lost", "quiet": "silent, where last seen"}
_COLUMNS = [
    ("robot", "Robot"), ("state", "State"), ("version", "Map version"), ("rate", "Failures in 24 h"),
    ("localised", "Localised"), ("since", "Last heard"), ("remarks", "Remarks"),
]  # fmt: skip


def install(rooms: Rooms) -> None:
    """Adds the page."""

    @ui.page("/", title="Fleet – fleetmap", response_timeout=RESPONSE_TIMEOUT_S)
    async def fleet_page(request: Request, site: str | None = None) -> None:
        async def build(where: Where) -> None:
            live = await load(rooms.robots.look, where.site)
            health = await load(rooms.health.site, where.site)
            html(Markup("<h1>Robots of {}</h1>").format(where.site))
            trials = html(_trials(health.trials))
            figures = html(_figures(live, health))
            over = await _plan(rooms, where, live)
            html(_legend())
            chart = html(_rates(health))
            robots = _table(where, live, health)
            html(_resurvey(where, health))

            async def move() -> None:
                live = await load(rooms.robots.look, where.site)
                health = await load(rooms.health.site, where.site)
                figures.set_content(str(_figures(live, health)))
                trials.set_content(str(_trials(health.trials)))
                if over is not None:
                    plan, layer = over
                    layer.set_content(str(_robots(plan, where, live)))

            async def list_again() -> None:
                live = await load(rooms.robots.look, where.site)
                health = await load(rooms.health.site, where.site)
                rows = _rows(where, live, health)
                if rows != robots.rows:
                    robots.rows = rows
                chart.set_content(str(_rates(health)))

            ui.timer(_MOVE_EVERY_S, move, immediate=False)
            ui.timer(_LIST_EVERY_S, list_again, immediate=False)

        await show(rooms, request, "", site, build)


def _figures(live: LiveSite, health: SiteHealth) -> Markup:
    heard = len(live.robots) - live.count("quiet")
    lost = live.count("bad")
    silent = health.day.silent_estimated
    return Markup('<div class="figures">{}</div>').format(
        joined(
            Markup('<div><div class="name">{}</div><div class="value {}">{}</div><div class="more">{}</div></div>').format(
                *figure
            )
            for figure in (
                ("Robots heard now", "", f"{heard} of {len(live.robots)}", "reported within 10 s"),
                ("Localised now", "good", live.count("good"), f"{live.count('warn')} unsure or starting"),
                ("Lost now", "bad" if lost else "", lost, "cannot say where they are"),
                _rate_figure("Failures per robot-day, last 24 h", health.day.failures, f"; {health.trend}"),
                _rate_figure("Silent failures per robot-day, an estimate", silent, ""),
                ("Time with a usable position", "", share(health.day.availability) or "–", "of the last 24 h"),
            )
        )
    )  # fmt: skip


def _rate_figure(name: str, found: Rate, more: str) -> tuple[str, str, str, str]:
    """A rate large, its interval and a remark below."""
    if found.low is None:
        return name, "", "–", "nothing was driven"
    counted = f"{found.events} in {driven_words(found.robot_days)}"
    if not is_telling(found):
        return name, "", "–", f"{counted}: too little for a rate"
    return (
        name,
        "",
        figure(found.per_robot_day),
        f"{counted}: {figure(found.low)} to {figure(found.high)} with 95 %{more}",
    )


def _trials(trials: tuple[Trial, ...]) -> Markup:
    """Versions that some robots try, and how those before them ended."""
    words = {
        "running": ("warn", "is tried by {share} of the robots since {when}"),
        "promoted": ("good", "was tried by {share} of the robots and promoted at {when}"),
        "rolled_back": ("bad", "was tried by {share} of the robots and taken back at {when}"),
        "stopped": ("warn", "was tried by {share} of the robots; that was stopped at {when}"),
    }
    parts = []
    for trial in trials:
        canary = trial.canary
        tone, sentence = words[canary.state]
        when = moment(canary.started_ns if canary.ended_ns is None else canary.ended_ns)
        told = sentence.format(share=share(canary.share), when=when)
        parts.append(
            Markup('<div class="notice {}" role="status"><strong>Version {} {}.</strong><br>{}</div>').format(
                tone, canary.version, told, trial.finding
            )
        )
    return joined(parts)


async def _plan(rooms: Rooms, where: Where, live: LiveSite) -> tuple[Plan, ui.html] | None:
    """The site map with the robots upon it; the layer of the robots is what moves. None without a version."""
    version = await load(rooms.maps.current_version, where.site)
    if version is None:
        html(Markup('<p class="notice">No map is published yet: robots cannot be shown on it.</p>'))
        return None
    plan = await load(rooms.maps.plan, where.site, version)
    ground = drawing.svg(
        plan, f"Map of {where.site}, version {version}",
        [drawing.ground(plan, picture_address(where, version)), drawing.scale_bar(plan)],
    )  # fmt: skip
    with ui.element("div"), ui.element("div").classes("planbox"):
        html(ground)
        layer = html(_robots(plan, where, live), classes="over")
    return plan, layer


def _robots(plan: Plan, where: Where, live: LiveSite) -> Markup:
    found = [
        Mark(
            *robot.place_m, robot.tone, _SHAPES.get(robot.tone, "circle"), f"{robot.name}: {robot.words}",
            where.to("failures", robot=robot.name),
        )
        for robot in reversed(live.robots)
        if robot.place_m is not None
    ]  # fmt: skip
    return drawing.svg(plan, "Robots on the map", [drawing.marks(plan, found)])


def _legend() -> Markup:
    shapes = {
        "circle": '<circle r="1"/>',
        "triangle": '<path d="M0-1.2L1.15.9H-1.15Z"/>',
        "square": '<path d="M-1-1h2v2h-2z"/>',
    }
    return Markup('<div class="legend">{}</div>').format(
        joined(
            Markup(
                '<span><svg viewBox="-1.5 -1.5 3 3" aria-hidden="true"><g class="mark {}">{}</g></svg>{}</span>'
            ).format(tone, Markup(shapes[_SHAPES[tone]]), words)
            for tone, words in _TONE_WORDS.items()
        )
    )


def _rates(health: SiteHealth) -> Markup:
    """Failures per robot-day of the last days."""
    found = [
        Bar(
            "24 h" if n == len(health.days) - 1 else f"-{len(health.days) - 1 - n} d",
            *((day.per_robot_day, day.low, day.high) if is_telling(day) else (None, None, None)),
            f"{day.events} in {driven_words(day.robot_days)}: {rate_words(day)} per robot-day",
        )
        for n, day in enumerate(health.days)
    ]  # fmt: skip
    return Markup(
        "<h2>Failures per robot-day</h2>{}<p class=\"quiet\">A bar for each 24 hours; a robot-day is 16 hours of driving. The thin line "
        "holds the true rate with 95 %; days with little driving have no bar. Last 24 hours: {} in {}, {}.</p>"
    ).format(
        drawing.bars(found, "Failures per robot-day of the last days"), health.day.failures.events,
        driven_words(health.day.failures.robot_days), health.trend,
    )  # fmt: skip


def _table(where: Where, live: LiveSite, health: SiteHealth) -> ui.table:
    html(Markup("<h2>Robots, those in trouble first</h2>"))
    columns = [
        {"name": name, "label": label, "field": name, "sortable": True, "align": "left"} for name, label in _COLUMNS
    ]
    with ui.element("div"):
        look_for = ui.input("Find a robot, state or version").props("outlined dense clearable").style("width:320px")
    shown = ui.table(columns=columns, rows=_rows(where, live, health), row_key="robot", pagination=25)
    shown.props('flat wrap-cells color=ink :rows-per-page-options="[25, 100, 0]"')
    look_for.bind_value_to(shown, "filter")
    shown.add_slot(
        "body-cell-state",
        '<q-td :props="props"><span :class="\'badge \' + props.row.tone">{{ props.value }}</span></q-td>',
    )
    shown.add_slot("body-cell-robot", '<q-td :props="props"><a :href="props.row.to">{{ props.value }}</a></q-td>')
    return shown


def _rows(where: Where, live: LiveSite, health: SiteHealth) -> list[dict[str, Any]]:
    return [_row(where, robot, health) for robot in live.robots]


def _row(where: Where, robot: LiveRobot, health: SiteHealth) -> dict[str, Any]:
    own = health.robots.get(robot.name)
    version = "none" if robot.version is None else str(robot.version)
    if robot.is_behind and robot.wanted_version is not None:
        version += f", should be {robot.wanted_version}"
    remarks = [*robot.flags]
    if robot.is_canary:
        remarks.append("tries a version")
    if robot.refused:
        remarks.append(f"refuses: {robot.refused}")
    if robot.clock_ahead_s is not None and abs(robot.clock_ahead_s) >= 1:
        remarks.append(f"clock wrong by {robot.clock_ahead_s:+.0f} s")
    return {
        "robot": robot.name, "state": robot.words, "tone": robot.tone, "version": version,
        "rate": 0 if own is None else own.failures.events,
        "localised": "–" if own is None else share(own.localised_share) or "–",
        "since": "now" if robot.seconds_since < 3 else f"{age(robot.seconds_since)} ago",
        "remarks": ", ".join(remarks), "to": where.to("failures", robot=robot.name),
    }  # fmt: skip


def _resurvey(where: Where, health: SiteHealth) -> Markup:
    rows = [
        (
            link(where.to("failures", tile=concern.tile), f"Tile {concern.tile}"),
            "; ".join(concern.reasons),
            rate_words(concern.failures),
            rate_words(concern.failures_before),
        )
        for concern in health.resurvey
    ]
    if not rows:
        return Markup("<h2>To survey again</h2><p>{} No tile stands out.</p>").format(badge("good", "nothing"))
    head = ("Tile", "Why", "Failures per robot-day lately", "Before")
    return Markup("<h2>To survey again</h2>{}").format(table(head, rows, empty="", name="Tiles to survey again"))
