"""The robots now, put together once for all pages that are open. Pure but for the clock that it is given."""

import threading
from collections.abc import Callable
from dataclasses import dataclass

from fleetmap.messages import Status
from mapserver.fleet.fleet import Fleet, RobotStatus

SILENT_S = 10.0  # robots report every second
_GONE_S = 3.0
_KEPT_S = 0.9

# What a status means to people, and its tone. Robots may send others, which are shown as they are.
STATUSES: dict[str, tuple[str, str]] = {
    Status.TRACKING: ("localised", "good"),
    Status.DEGRADED: ("unsure", "warn"),
    Status.INITIALISING: ("starting", "warn"),
    Status.AMBIGUOUS: ("several places fit", "bad"),
    Status.LOST: ("lost", "bad"),
}
SILENT = ("silent", "quiet")


@dataclass(frozen=True, slots=True)
class LiveRobot:
    """One robot as a page shows it; place: x and y of its last estimate in `map`, None where it never sent one."""

    name: str
    words: str
    tone: str
    place_m: tuple[float, float] | None
    version: int | None
    wanted_version: int | None
    seconds_since: float
    flags: tuple[str, ...]
    refused: str
    is_canary: bool
    clock_ahead_s: float | None

    @property
    def is_behind(self) -> bool:
        """Whether it runs another version than it should."""
        return self.version != self.wanted_version


@dataclass(frozen=True, slots=True)
class LiveSite:
    """All robots of a site, those in trouble first."""

    robots: tuple[LiveRobot, ...]

    def count(self, tone: str) -> int:
        """How many robots are in a tone."""
        return sum(robot.tone == tone for robot in self.robots)


_ORDER = {"bad": 0, "warn": 1, "quiet": 2, "good": 3}


class LiveRobots:
    """Looks at the fleet at most about every second, however many pages ask."""

    def __init__(self, fleet: Fleet, clock_s: Callable[[], float]) -> None:
        self._fleet = fleet
        self._clock_s = clock_s
        self._lock = threading.Lock()
        self._kept: dict[str, tuple[float, LiveSite]] = {}

    def look(self, site: str) -> LiveSite:
        """The site's robots as of now."""
        with self._lock:
            known = self._kept.get(site)
            if known is not None and self._clock_s() - known[0] < _KEPT_S:
                return known[1]
            robots = [live_robot(status) for status in self._fleet.robots(site)]
            robots.sort(key=lambda robot: (_ORDER.get(robot.tone, 1), robot.name))
            found = LiveSite(tuple(robots))
            self._kept[site] = (self._clock_s(), found)
        return found


def live_robot(status: RobotStatus) -> LiveRobot:
    """What a page shows of a robot."""
    estimate, health = status.last_pose or {}, status.last_health or {}
    said = health.get("status") or estimate.get("status")
    words, tone = STATUSES.get(str(said), (str(said).lower(), "warn")) if said else ("not started", "quiet")
    # A robot that takes its token back says goodbye; one that never shows a token is believed by its messages.
    if status.seconds_since > (SILENT_S if status.is_present is not False else _GONE_S):
        words, tone = SILENT
    place = estimate.get("position_map_m")
    is_somewhere = place is not None and None not in place
    return LiveRobot(
        name=status.robot,
        words=words,
        tone=tone,
        place_m=(float(place[0]), float(place[1])) if place is not None and is_somewhere else None,
        version=status.version,
        wanted_version=status.wanted_version,
        seconds_since=status.seconds_since,
        flags=tuple(health.get("flags", ())),
        refused=str((status.last_ack or {}).get("refused", "")),
        is_canary=status.is_canary,
        clock_ahead_s=status.clock_ahead_s,
    )
