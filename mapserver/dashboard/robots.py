"""The page of all robots: which need somebody, and what is different about them? State and columns are kept in the address."""

from collections import Counter
from typing import NamedTuple

from fleetmap.errors import UsageError
from mapserver.dashboard.administration import cannot_enrol
from mapserver.dashboard.console import PageContext, Services
from mapserver.dashboard.fleet_health import SiteHealth
from mapserver.dashboard.live import ORDER, LiveRobot
from mapserver.dashboard.overview import remarks, since_words, site_line
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
}


class _Row(NamedTuple):
    """A robot. cells: words by column; exact: the moment of `since`."""

    name: str
    tone: str
    cells: dict[str, str]
    exact: str


class _Choice(NamedTuple):
    """Something to choose or to take back, and the address that does it."""

    words: str
    is_chosen: bool
    to: str


def page(services: Services, context: PageContext) -> dict[str, object]:
    """What the template needs."""
    live, health = services.robots.look(context.site), services.health.site(context.site)
    areas = services.maps.store.areas(context.site)
    find, state, hidden = (context.query.get(name, "") for name in ("find", "state", "without"))
    without = dict.fromkeys(filter(None, hidden.split(",")))
    for name in without:
        if name not in _COLUMNS:
            raise UsageError(f"there is no column {name[:40]!r}; without names some of {', '.join(_COLUMNS)}")
    rows = [_row(context, robot, health, areas) for robot in live.robots]
    rows.sort(key=lambda row: (ORDER.get(row.tone, 1), not row.cells["remarks"]))
    counts = Counter(row.cells["state"] for row in rows)
    if state:
        counts[state] += 0

    def to(**changed: str) -> str:
        return context.to("robots", **{"find": find, "state": state, "without": ",".join(without)} | changed)

    shown = [row for row in rows if state in ("", row.cells["state"])]
    return {
        "line": site_line(live),
        "states": [
            _Choice(f"{words} ({count})", words == state, to(state="" if words == state else words))
            for words, count in counts.items()
        ],
        "columns": [
            _Choice(words, name not in without, to(without=",".join(without.keys() ^ {name})))
            for name, words in _COLUMNS.items()
        ],
        "names": {
            name: words
            for name, words in _COLUMNS.items()
            if name not in without and any(row.cells[name] for row in shown)
        },
        "rows": shown,
        "can_enrol": not cannot_enrol(RobotRegister(services.maps.store)),
    }


def _row(context: PageContext, robot: LiveRobot, health: SiteHealth, areas: Areas) -> _Row:
    own, cpu_ms = health.robots.get(robot.name), robot.metrics.get("frame_ms_mean")
    since, exact = since_words(context, robot)
    cells = {
        "state": robot.words,
        "since": f"{since} ago" if since else "",
        "where": robot.where(areas),
        "remarks": ", ".join(remarks(robot)),
        "map": "none" if robot.status.version is None else str(robot.status.version),
        "cpu": f"{cpu_ms:.1f} ms" if isinstance(cpu_ms, int | float) else "",
        "failures": "0" if own is None else str(own.failures.events + own.failures_running),
    }
    return _Row(robot.name, robot.tone, cells, exact)
