"""The first pages: Overview (does anything need me?), Robots (which, and what is different about them?) and Trends (what got worse?)."""

import time
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from fleetmap.errors import UsageError
from fleetmap.messages import Flag
from mapserver.api.moments import hours_within
from mapserver.dashboard import fleet_parts
from mapserver.dashboard.administration import cannot_enrol
from mapserver.dashboard.console import PageContext, Services, scene_of
from mapserver.dashboard.fleet_health import DAY_H, DAYS_SHOWN, WEEK_H, SiteHealth
from mapserver.dashboard.fleet_parts import Bar, Bars, Choice, Figure, Sentence, bar_edges, page_of
from mapserver.dashboard.live import ORDER, LiveRobot
from mapserver.dashboard.map_layers import Layer, Mark
from mapserver.dashboard.map_page import verdict_words
from mapserver.dashboard.rendering import age, begun, share
from mapserver.fleet.alerts import Incident, dropped_words, with_acts
from mapserver.fleet_statistics.area_trend import trend_sentence
from mapserver.fleet_statistics.kpis import HOUR_NS, Counters, Kpis, Rate, figure, kpis
from mapserver.fleet_statistics.robot_calibration import PARAMETERS
from mapserver.floor_plan.areas import OUTSIDE
from mapserver.store import EVER
from mapserver.trust.enrolment import RobotRegister

_COLUMNS = {
    "state": "State",
    "since": "Since",
    "where": "Where",
    "remarks": "To look at",
    "map": "Map version",
    "cpu": "CPU of a frame",
    "failures": "Failures, 24 h",
    "dropped": "Drops, 24 h",
}
_NAMES = 7  # below bars
_MANY = 20  # robots, whose places say better than the map's tiles what to show first


Row = tuple[LiveRobot, Kpis, dict[str, str]]
"""A robot in a list, its figures of the last 24 h, and its words by column; `exact`: since which moment; `to`: the address of its page."""


class Notice(NamedTuple):
    """What needs somebody: tone, words, address and name of the page that says more, and the incident to act on."""

    tone: str
    words: str
    to: str
    more: str
    incident: Incident | None = None


def page(services: Services, context: PageContext) -> dict[str, object]:
    """What the template needs."""
    live, version = services.robots.look(context.site), services.maps.current_version(context.site)
    places = [robot.place_m for robot in live if robot.place_m is not None]
    shown, dense = [Layer("Robots", _marks(context, live))], {"Failures": services.health.places(context.site)}
    in_sight = places if len(places) > _MANY else ()
    scene = scene_of(services, context, version, shown, dense_m=dense, places_m=in_sight)
    return {"scene": scene and scene | {"fills_page": True}, "now": now(services, context)}


def now(services: Services, context: PageContext) -> dict[str, object]:
    """What changes from second to second."""
    live, health = services.robots.look(context.site), services.health.site(context.site)
    first_h, end_h = hours_within(None, None, time.time_ns(), DAYS_SHOWN * DAY_H)
    (floors, guests), (alerts, own) = _floors(services, context), alerts_of(services, health)
    rows = _rows(services, context)
    rows.sort(key=lambda row: row[0].tone in {"good", "quiet"} and not _is_troubled(row[0]))
    return {
        "line": site_line(live),
        "notices": _notices(services, context, health, alerts),
        "figures": _figures(live, health),
        "days": [] if health.day.failures.low is None else [day.per_robot_day for day in health.days],
        "span": (first_h * HOUR_NS, end_h * HOUR_NS),
        "trends": context.to("trends"),
        "robots": [_listed(row, own.get(row[0].name)) for row in rows] + guests,
        "marks": _marks(context, live),
        "floors": floors,
    }


def alerts_of(services: Services, health: SiteHealth) -> tuple[list[Incident], dict[str, Incident]]:
    """All alerts that are not closed; those of robots by their names, an open one before others."""
    alerts = [one for one in with_acts(services.maps.store, health.alerts) if one.state != "closed"]
    of_robots = (one for one in alerts if page_of(one).startswith("robots/"))
    own = {one.about: one for one in sorted(of_robots, key=lambda one: one.state == "open")}
    return alerts, own


def _floors(services: Services, context: PageContext) -> tuple[list[Choice], list[dict[str, object]]]:
    """The floors of the site's building with the robots on each, the highest first; and the robots of other floors that are on this one."""
    site, levels = context.site, services.maps.levels(context.site)
    robots = [robot for floor in levels for robot in services.robots.look(floor)]
    counts = Counter(robot.floor or robot.status.site for robot in robots if robot.tone != "quiet")
    floors = [
        (f"{level} ({counts[floor]})", floor == site, context.to("", site=floor))
        for floor, level in reversed(levels.items())
    ]
    homes = sorted({robot.status.site for robot in robots if robot.floor == site})
    rows = (row for home in homes for row in _rows(services, context._replace(site=home)) if row[0].floor == site)
    about = "on this floor: it tells no position here"
    guests = [_listed(row) | {"name": f"{row[0].name} of {row[0].status.site}", "about": about} for row in rows]
    return floors, guests


def site_line(live: Sequence[LiveRobot]) -> Sentence:
    """One sentence for all robots."""
    online, tones = [robot for robot in live if robot.tone != "quiet"], Counter(robot.tone for robot in live)
    if not live:
        return Sentence("quiet", "No robot of this site has reported yet; locclient run on a robot does.")
    if not online:
        last_s = min(robot.status.seconds_since for robot in live)
        return Sentence("quiet", f"All robots are offline; the last one reported {age(last_s)} ago.")
    troubled = sum(map(_is_troubled, online))
    counts = ((tones["bad"], "not localised"), (tones["warn"], "uncertain"), (troubled, "localised with a problem"))
    parts = [f"{count} {words}" for count, words in counts if count]
    if not parts:
        all_of_them = f"All {len(online)} robots online are" if len(online) > 1 else f"{online[0].name} is"
        return Sentence("good", f"{all_of_them} localised.")
    told = f"Of {len(online)} robot{'s' * (len(online) > 1)} online: {', '.join(parts)}."
    return Sentence("bad" if tones["bad"] else "warn", told)


def _is_troubled(robot: LiveRobot) -> bool:
    """True for a robot that is localised with a problem."""
    return robot.tone == "good" and bool(_troubles(robot))


def _troubles(robot: LiveRobot) -> list[str]:
    """What is wrong beside the state."""
    found = [f"refuses a version: {robot.refused}"] if robot.refused else []
    if robot.status.is_copied:
        found.append("is there twice: has another robot its name, or was its certificate copied?")
    found += [dropped_words(robot.metrics).partition(";")[0]] if Flag.OVERLOADED in robot.flags else []
    if robot.is_behind and robot.status.wanted_version is not None:
        found.append(f"runs version {robot.status.version or 'none'}, should run {robot.status.wanted_version}")
    if robot.status.clock_ahead_s is not None and abs(robot.status.clock_ahead_s) >= 1:
        found.append(f"clock wrong by {robot.status.clock_ahead_s:+.0f} s")
    return found + [f"{PARAMETERS[f.name]} drifts" for f in robot.calibration if f.is_drifted]


def remarks(robot: LiveRobot) -> list[str]:
    """What it reports, what is wrong, and whether it tries a version."""
    trial = ["tries a new version"] if robot.status.is_canary else []
    flags = [flag.replace("_", " ") for flag in robot.flags if flag != Flag.OVERLOADED]
    return flags + _troubles(robot) + trial


def since_words(context: PageContext, robot: LiveRobot) -> tuple[str, str]:
    """For how long it is in its state or was not heard, and since which moment; empty where that is not known."""
    if robot.tone == "quiet":
        return age(robot.status.seconds_since), ""
    since_ns = robot.status.state_since_ns
    if since_ns is None:
        return "", ""
    return age(max(0.0, time.time() - since_ns / 1e9)), context.moment(since_ns) or ""


def _rows(services: Services, context: PageContext) -> list[Row]:
    """All robots, those in trouble first."""
    site, rows = context.site, list[Row]()
    days, areas, levels = services.health.site(site).robots, services.maps.store.areas(site), services.maps.levels(site)
    for robot in services.robots.look(site):
        day, cpu_ms = days.get(robot.name) or kpis(Counters()), robot.metrics.get("frame_ms_mean")
        since, exact = since_words(context, robot)
        words = {
            "state": robot.words,
            "since": f"{since} ago" if since else "",
            "where": robot.where(areas, levels),
            "remarks": ", ".join(remarks(robot)),
            "map": str(robot.status.version or "none"),
            "cpu": f"{cpu_ms:.1f} ms" if isinstance(cpu_ms, int | float) else "",
            "failures": str(day.failures.events + day.failures_running),
            "dropped": share(day.frame_drop_share) or "",
        }
        rows.append((robot, day, words | {"exact": exact, "to": context.to(f"robots/{robot.name}")}))
    return rows


def _listed(row: Row, alert: Incident | None = None) -> dict[str, object]:
    """A robot in the list beside the map. alert: of the robot."""
    robot, day, words = row
    failures, suspected = int(words["failures"]), day.silent_estimated.events
    told = [
        words["remarks"],
        f"{alert.assignee} has it" if alert is not None and alert.assignee else "",
        f"{failures} failure{'s' * (failures > 1)} in 24 h" if failures else "",
        f"suspected failures: {suspected}" if suspected else "",
    ]
    since, exact = ("", "") if robot.tone == "good" else (words["since"], words["exact"])
    return {
        "name": robot.name,
        "to": words["to"],
        "tone": robot.tone,
        "state": robot.words,
        "since": since if robot.tone == "quiet" else since.removesuffix(" ago"),
        "exact": exact,
        "about": " · ".join(filter(None, [words["where"], ", ".join(filter(None, told))])),
        "place": robot.place_m,
        "incident": alert,
    }


def robots(services: Services, context: PageContext) -> dict[str, object]:
    """What the template of all robots needs: state and columns are kept in the address."""
    find, state, hidden = (context.query.get(name, "") for name in ("find", "state", "without"))
    without = dict.fromkeys(filter(None, hidden.split(",")))
    if unknown := without.keys() - _COLUMNS.keys():
        raise UsageError(f"there is no column {min(unknown)[:40]!r}; without names some of {', '.join(_COLUMNS)}")
    rows = sorted(_rows(services, context), key=lambda row: (ORDER.get(row[0].tone, 1), not row[2]["remarks"]))
    counts = Counter(robot.words for robot, *_ in rows)
    if state:
        counts[state] += 0

    def to(**changed: str) -> str:
        return context.to("robots", **{"find": find, "state": state, "without": ",".join(without)} | changed)

    shown = [row for row in rows if state in ("", row[0].words)]
    columns = {name: words for name, words in _COLUMNS.items() if name not in without}
    states = [(f"{name} ({n})", name == state, to(state="" if name == state else name)) for name, n in counts.items()]
    return {
        "line": site_line(services.robots.look(context.site)),
        "states": states,
        "columns": [
            (words, name in columns, to(without=",".join(without.keys() ^ {name}))) for name, words in _COLUMNS.items()
        ],
        "names": {name: words for name, words in columns.items() if any(cells[name] for *_, cells in shown)},
        "rows": shown,
        "can_enrol": not cannot_enrol(RobotRegister(services.maps.store)),
    }


def _marks(context: PageContext, live: Sequence[LiveRobot]) -> list[Mark]:
    """Robots that ever sent a position, those in trouble on top."""
    return [mark for robot in reversed(live) for mark in robot.marks(context.to(f"robots/{robot.name}"))]


def _figures(live: Sequence[LiveRobot], health: SiteHealth) -> list[Figure]:
    """Those that are known: what cannot be known yet is left out."""
    online, failures = sum(robot.tone != "quiet" for robot in live), health.day.failures
    found = [Figure("Online", f"{online} of {len(live)}", "")] if live else []
    if shown := share(health.day.localised_share_of_all):
        found.append(Figure("Localised while driving, 24 h", shown, ""))
    if failures.low is not None:
        value, low, high = (figure(rate or 0.0) for rate in (failures.per_robot_day, failures.low, failures.high))
        found.append(Figure("Failures per robot-day, 24 h", value, f"in truth {low} to {high}, with 95 % certainty"))
    return found


def _notices(services: Services, context: PageContext, health: SiteHealth, alerts: Sequence[Incident]) -> list[Notice]:
    """Alerts, a draft that waits, trials, running or just ended, and what got worse this week, each with a page that says more."""
    store, site, found = services.maps.store, context.site, list[Notice]()
    context = context._replace(query={})  # what is so now is not shown in the time that was chosen on another page

    def told(tone: str, words: str, page: str, incident: Incident | None = None) -> None:
        found.append(Notice(tone, words, context.to(page), begun(page), incident))

    for other, count in services.robots.lost().items():
        if other != site:
            to, more = context.to("", site=other), f"Overview of {other}"
            found.append(Notice("bad", f"Robots of {other} that are not localised: {count}.", to, more))
    # those of robots and trials have words of their own
    for one in (one for one in alerts if not page_of(one).startswith(("robots/", "trends"))):
        words = f"{begun(one.words)}.{f' {one.assignee} has it.' if one.assignee else ''}"
        told("bad" if one.state == "open" else "quiet", words, page_of(one), one)
    versions = store.releases(site).versions if services.maps.is_mapped(site) else {}
    newest = next(reversed(versions.values()), None)
    if newest is not None and newest.state == "draft":
        tone, said = verdict_words(store.last_verdicts(site).get(newest.version), is_draft=True)
        told(tone, f"Draft {newest.version} is not published. {said}", "map")
    for trial in health.trials:
        tone, words, said = fleet_parts.trial_words(trial, context.moment)
        verdict, stop, _ = said.partition(". ")  # the page of trends has the rates
        told(tone, f"{words} {verdict}{stop}", "trends")
    if health.areas:
        words = f"This week: {trend_sentence(list(health.areas))}."
        found.append(Notice("quiet", words, f"{context.to('trends')}#worse", "Area by area"))
    return found


def trends(services: Services, context: PageContext) -> dict[str, object]:
    """The figures of a day, or of the range in the address, and what they were before."""
    live, health = services.robots.look(context.site), services.health.site(context.site)
    span_ns = context.time_range()
    day, when, trend, areas = health.day, "last 24 h", f"; {health.trend}", list(health.areas)
    if span_ns != EVER:
        day, when, trend = services.health.span(context.site, *span_ns), "chosen hours", ""
        areas = services.health.area_trends(context.site, *span_ns)
    figures = [
        fleet_parts.localised_figure(f"Localised while driving, {when}", day),
        fleet_parts.rate_figure(f"Failures per robot-day, {when}", day.failures, trend),
        fleet_parts.rate_figure("Silent failures per robot-day, an estimate", day.silent_estimated, ""),
        Figure("Time with a usable position", share(day.availability) or "–", f"of the {when}"),
    ]
    cameras = fleet_parts.cameras((robot.name, robot.calibration) for robot in live)
    begin_ns = span_ns[0] or (span_ns[1] or time.time_ns()) - DAYS_SHOWN * 24 * HOUR_NS
    end_ns = span_ns[1] or max(time.time_ns(), begin_ns + 1)
    for least_h in (1, 6, 24):  # until most bars tell something
        edges, step = bar_edges(begin_ns, end_ns, context.zone, least_h * HOUR_NS)
        rates = services.health.rates(context.site, edges)
        if sum(rate.low is not None for rate in rates) > len(rates) / 2:
            break
    return {
        "tried": fleet_parts.trials_shown(health.trials, context.moment),
        "kpis": figures,
        "areas": areas,
        "worse": trend_sentence(areas) if areas else "",
        "panels": services.shown("trends", context),
        "is_chosen": span_ns != EVER,
        "has_areas": bool(services.maps.store.areas(context.site)),
        "outside": OUTSIDE,
        "since": context.written(span_ns[0] or hours_within(*span_ns, time.time_ns(), WEEK_H)[0] * HOUR_NS),
        "bars_over_time": Bars("Failures per robot-day", _bars(context, edges, rates), (edges[0], edges[-1])),
        "step": step,
        "cameras": cameras,
        "drifting": sum(any(one.is_drifted for one in told.values()) for _, told in cameras),
        "parameters": {name: words for name, words in PARAMETERS.items() if any(name in told for _, told in cameras)},
        "concerns": health.resurvey,
        "outlines": _outlines(services, context.site),
    }


def _bars(context: PageContext, edges: Sequence[int], rates: Sequence[Rate]) -> list[Bar]:
    """Rates by the clock of whoever looks; few of them are named."""
    is_day, every = edges[1] - edges[0] > 20 * HOUR_NS, -(-len(rates) // _NAMES)
    starts = [context.written(edge)[slice(5, 10) if is_day else slice(11, 16)] for edge in edges[:-1]]
    names = [name if n % every == 0 else "" for n, name in enumerate(starts)]
    moments = (context.moment(edge) for edge in edges)
    found = (fleet_parts.rate_bar(*bar) for bar in zip(names, rates, strict=True))
    return [bar._replace(words=f"{moment}: {bar.words}") for moment, bar in zip(moments, found, strict=False)]


def _outlines(services: Services, site: str) -> dict[str, list[tuple[float, float]]]:
    """Corners of each tile of the current version by its name, within it: on its edge a request would take its neighbours, too."""
    version = services.maps.current_version(site)
    if version is None:
        return {}
    manifest = services.maps.store.manifest(site, version)
    corners = ((0.1, 0.1), (0.9, 0.1), (0.9, 0.9), (0.1, 0.9))
    size_m = manifest.tile_size_m
    return {f"{t.x},{t.y}": [((t.x + i) * size_m, (t.y + j) * size_m) for i, j in corners] for t in manifest.tiles}
