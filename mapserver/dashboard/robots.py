"""The page of all robots: which need somebody, and what is different about them? State and columns are kept in the address."""

from collections import Counter
from collections.abc import Mapping

from fleetmap.errors import UsageError
from mapserver.dashboard.administration import cannot_enrol
from mapserver.dashboard.console import PageContext, Services
from mapserver.dashboard.fleet_health import SiteHealth
from mapserver.dashboard.fleet_parts import Choice
from mapserver.dashboard.live import ORDER, LiveRobot
from mapserver.dashboard.overview import remarks, since_words, site_line
from mapserver.dashboard.rendering import share
from mapserver.floor_plan.areas import Areas
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


def page(services: Services, context: PageContext) -> dict[str, object]:
    """What the template needs."""
    live, health = services.robots.look(context.site), services.health.site(context.site)
    areas = services.maps.store.areas(context.site)
    find, state, hidden = (context.query.get(name, "") for name in ("find", "state", "without"))
    without = dict.fromkeys(filter(None, hidden.split(",")))
    if unknown := without.keys() - _COLUMNS.keys():
        raise UsageError(f"there is no column {min(unknown)[:40]!r}; without names some of {', '.join(_COLUMNS)}")
    levels = services.maps.levels(context.site)
    rows = [_row(context, robot, health, areas, levels) for robot in live.robots]
    rows.sort(key=lambda row: (ORDER.get(row[0].tone, 1), not row[1]["remarks"]))
    counts = Counter(robot.words for robot, *_ in rows)
    if state:
        counts[state] += 0

    def to(**changed: str) -> str:
        return context.to("robots", **{"find": find, "state": state, "without": ",".join(without)} | changed)

    shown = [row for row in rows if state in ("", row[0].words)]
    columns = {name: words for name, words in _COLUMNS.items() if name not in without}
    states: list[Choice] = [
        (f"{words} ({n})", words == state, to(state="" if words == state else words)) for words, n in counts.items()
    ]
    return {
        "line": site_line(live),
        "states": states,
        "columns": [
            (words, name in columns, to(without=",".join(without.keys() ^ {name}))) for name, words in _COLUMNS.items()
        ],
        "names": {name: words for name, words in columns.items() if any(cells[name] for _, cells, _ in shown)},
        "rows": shown,
        "can_enrol": not cannot_enrol(RobotRegister(services.maps.store)),
    }


def _row(
    context: PageContext, robot: LiveRobot, health: SiteHealth, areas: Areas, levels: Mapping[str, str]
) -> tuple[LiveRobot, dict[str, str], str]:
    """A robot, its words by column, and the moment of `since`."""
    own, cpu_ms = health.robots.get(robot.name), robot.metrics.get("frame_ms_mean")
    since, exact = since_words(context, robot)
    cells = {
        "state": robot.words,
        "since": f"{since} ago" if since else "",
        "where": robot.where(areas, levels),
        "remarks": ", ".join(remarks(robot)),
        "map": "none" if robot.status.version is None else str(robot.status.version),
        "cpu": f"{cpu_ms:.1f} ms" if isinstance(cpu_ms, int | float) else "",
        "failures": "0" if own is None else str(own.failures.events + own.failures_running),
        "dropped": (own and share(own.frame_drop_share)) or "",
    }
    return robot, cells, exact
