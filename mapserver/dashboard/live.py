"""Current state of the robots, computed once for all open pages. Pure but for the clock that it is given."""

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from fleetmap.messages import Status
from mapserver.dashboard.data import Kept
from mapserver.dashboard.map_layers import Mark
from mapserver.fleet.fleet import Fleet, RobotStatus
from mapserver.fleet_statistics.robot_calibration import CalibrationFigure, calibration_figures
from mapserver.floor_plan.areas import Areas

SILENT_S = 10.0  # robots report every second
_LEFT_S = 3.0
_CACHED_S = 0.9

# Words and tone of a status.
STATUSES: dict[str, tuple[str, str]] = {
    Status.TRACKING: ("localised", "good"),
    Status.DEGRADED: ("uncertain", "warn"),
    Status.INITIALISING: ("starting", "warn"),
    Status.AMBIGUOUS: ("several places fit", "bad"),
    Status.LOST: ("lost", "bad"),
}
SILENT = ("offline", "quiet")
_SHAPES = {"warn": "triangle", "bad": "square"}


def words_of(status: str) -> tuple[str, str]:
    """Words and tone of a status; of one that is none of ours the robot's own word."""
    return STATUSES.get(status, (status.lower(), "warn"))


class LiveRobot(NamedTuple):
    """One robot as a page shows it; place: x and y of its last estimate in `map`, None where it never sent one; heading: from x to y.

    metrics: figures of its last health report. calibration: what the map shows of its cameras, empty for a robot that does not report it.
    """

    status: RobotStatus
    words: str
    tone: str
    place_m: tuple[float, float] | None
    heading_rad: float | None
    flags: tuple[str, ...]
    metrics: Mapping[str, Any]
    calibration: tuple[CalibrationFigure, ...] = ()

    @property
    def name(self) -> str:
        return self.status.robot

    @property
    def floor(self) -> str:
        """The site of the floor on which it is, empty for its own."""
        return str(self.metrics.get("floor") or "")

    @property
    def refused(self) -> str:
        """Why it does not run the wanted version, empty if it does."""
        return str((self.status.last_ack or {}).get("refused", ""))

    @property
    def is_behind(self) -> bool:
        """Whether it runs another version than it should."""
        return self.status.version != self.status.wanted_version

    def where(self, areas: Areas, levels: Mapping[str, str]) -> str:
        """Where it was last, as people know it; empty where it never said. levels: names of the building's floors by their sites."""
        if self.floor:
            return f"on the floor {levels.get(self.floor, self.floor)}"
        if self.place_m is None:
            return ""
        return areas.at(*self.place_m) or "at {:.1f}, {:.1f} m".format(*self.place_m)

    def marks(self, address: str | None = None) -> list[Mark]:
        """It on a map, if it ever sent a position."""
        if self.place_m is None:
            return []
        x, y = (round(value, 2) for value in self.place_m)
        shape, words = _SHAPES.get(self.tone, "circle"), f"{self.name}: {self.words}"
        return [Mark(x, y, self.tone, shape, words, address, self.name, self.heading_rad)]


ORDER = {"bad": 0, "warn": 1, "quiet": 2, "good": 3}


class LiveRobots:
    """Reads the fleet at most about once a second, for any number of pages."""

    def __init__(self, fleet: Fleet, clock_s: Callable[[], float]) -> None:
        self.fleet, self._all = fleet, Kept[list[LiveRobot]](1, _CACHED_S, clock_s)

    def look(self, site: str) -> list[LiveRobot]:
        """The site's robots as of now, those in trouble first."""
        return [robot for robot in self._look() if robot.status.site == site]

    def robot(self, site: str, name: str) -> LiveRobot | None:
        """The robot of a name, None where it was never heard."""
        return next((robot for robot in self.look(site) if robot.name == name), None)

    def lost(self) -> dict[str, int]:
        """How many robots of each site are not localised; the site with most of them first, none without."""
        return dict(Counter(robot.status.site for robot in self._look() if robot.tone == "bad").most_common())

    def _look(self) -> list[LiveRobot]:
        def read() -> list[LiveRobot]:
            robots = map(live_robot, self.fleet.robots())
            return sorted(robots, key=lambda one: (ORDER.get(one.tone, 1), counted(one.name)))

        return self._all.get("", read)


def counted(name: str) -> list[str | int]:
    """A key by which tug-9 is before tug-10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def live_robot(status: RobotStatus) -> LiveRobot:
    """A robot as a page shows it."""
    estimate, health = status.last_pose or {}, status.last_health or {}
    sent = health.get("status") or estimate.get("status")
    words, tone = words_of(str(sent)) if sent else ("not started", "quiet")
    # A robot that withdraws its liveliness token has left; one without a token is judged by its messages.
    if status.seconds_since > (SILENT_S if status.is_present is not False else _LEFT_S):
        words, tone = SILENT
    metrics = health.get("metrics") or {}
    place = None if metrics.get("floor") else estimate.get("position_map_m")  # on another floor it tells none
    return LiveRobot(
        status,
        words,
        tone,
        (float(place[0]), float(place[1])) if place is not None and None not in place else None,
        _heading(estimate.get("quat_wxyz")),
        tuple(health.get("flags", ())),
        metrics,
        calibration_figures(health),
    )


def _heading(quat_wxyz: Sequence[float | None] | None) -> float | None:
    """The angle from x towards y at which a rotation's x axis lies."""
    if quat_wxyz is None or None in quat_wxyz:
        return None
    w, x, y, z = (float(value) for value in quat_wxyz if value is not None)
    return round(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)), 3)
