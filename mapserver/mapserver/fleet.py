"""What the server knows about its robots: which version each should run, which it runs, what it said last."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fleetmap.errors import LinkError
from fleetmap.messages import PoseMessage, RobotAck, RobotHealth, WantedVersion, report_dict
from mapserver.store import MapStore

MAX_ROBOTS = 10_000
_SAVE_EVERY_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """One robot. version: what it runs, None before it said so; seconds_since: since it said anything.

    last_ack, last_health and last_pose are its last messages as plain values, None before the first.
    """

    site: str
    robot: str
    version: int | None
    wanted_version: int | None
    seconds_since: float
    last_ack: dict[str, Any] | None
    last_health: dict[str, Any] | None
    last_pose: dict[str, Any] | None


@dataclass(slots=True)
class _Robot:
    version: int | None = None
    seen_ns: int = 0
    saved_ns: int = 0
    report: dict[str, Any] = field(default_factory=dict)


class Fleet:
    """Takes the robots' messages from any thread; keeps acknowledgements and, at most every second, health on the disk.

    Poses stay in memory. Messages for sites that the store does not have are refused, as are more than MAX_ROBOTS
    robots, so that nobody can fill the disk by inventing names.
    """

    def __init__(self, store: MapStore, *, clock_ns: Callable[[], int] = time.time_ns) -> None:
        self._store = store
        self._clock_ns = clock_ns
        self._lock = threading.Lock()
        self._robots = {
            (info.site, info.robot): _Robot(info.version, info.last_seen_ns, info.last_seen_ns, dict(info.last_report))
            for info in store.robots()
        }

    def wanted_version(self, site: str, robot: str) -> WantedVersion:
        """The version that a robot should run: its site's current one. Raises UsageError for an unknown site."""
        current = self._store.current(site)
        if current is None:
            return WantedVersion(site=site, version=None, manifest_sha256=None)
        return WantedVersion(site=site, version=current.version, manifest_sha256=current.manifest_sha256)

    def take_question(self, site: str, robot: str) -> WantedVersion:
        """As `wanted_version`, asked by the robot itself: from then on it is known, and told of the next version."""
        wanted = self.wanted_version(site, robot)
        with self._lock:
            if (site, robot) in self._robots or len(self._robots) < MAX_ROBOTS:
                self._robots.setdefault((site, robot), _Robot()).seen_ns = self._clock_ns()
        return wanted

    def take_ack(self, site: str, robot: str, ack: RobotAck) -> None:
        """Keeps an acknowledgement; raises LinkError for one that speaks for another robot."""
        _check_sender(site, robot, ack)
        self._take(site, robot, "ack", report_dict(ack), ack.version, save=True)

    def take_health(self, site: str, robot: str, health: RobotHealth) -> None:
        """Keeps a report; raises LinkError for one that speaks for another robot."""
        _check_sender(site, robot, health)
        self._take(site, robot, "health", report_dict(health), health.version)

    def take_pose(self, site: str, robot: str, message: PoseMessage) -> None:
        """Keeps an estimate in memory."""
        self._take(site, robot, "pose", report_dict(message), message.map_version)

    def known_robots(self, site: str) -> list[str]:
        """Names of the site's robots that ever asked or said something."""
        with self._lock:
            return sorted(robot for key_site, robot in self._robots if key_site == site)

    def robots(self, site: str | None = None) -> list[RobotStatus]:
        """All robots (of a site), by site and name."""
        now_ns = self._clock_ns()
        with self._lock:
            chosen = [(key, robot) for key, robot in sorted(self._robots.items()) if site in {None, key[0]}]
        current = {info.site: info.current_version for info in self._store.sites()}
        return [
            RobotStatus(
                site=key[0],
                robot=key[1],
                version=robot.version,
                wanted_version=current.get(key[0]),
                seconds_since=max(0, now_ns - robot.seen_ns) / 1e9,
                last_ack=robot.report.get("ack"),
                last_health=robot.report.get("health"),
                last_pose=robot.report.get("pose"),
            )
            for key, robot in chosen
        ]

    def _take(
        self, site: str, robot: str, what: str, message: dict[str, Any], version: int | None, *, save: bool = False
    ) -> None:
        now_ns = self._clock_ns()
        with self._lock:
            entry = self._robots.get((site, robot))
            if entry is None:
                entry = self._add(site, robot)
            entry.version = version if version is not None else entry.version
            entry.seen_ns = now_ns
            entry.report[what] = message
            save = save or (what == "health" and now_ns - entry.saved_ns >= _SAVE_EVERY_NS)
            if save:
                entry.saved_ns = now_ns
            report = {key: value for key, value in entry.report.items() if key != "pose"}
            version = entry.version
        if save:
            self._store.record_robot_report(site, robot, report, version)

    def _add(self, site: str, robot: str) -> _Robot:
        if site not in {info.site for info in self._store.sites()}:
            raise LinkError(f"robot {robot!r} reports for site {site!r}, which this store does not have")
        if len(self._robots) >= MAX_ROBOTS:
            raise LinkError(f"robot {robot!r} is one more than the {MAX_ROBOTS} that this server keeps")
        return self._robots.setdefault((site, robot), _Robot())


def _check_sender(site: str, robot: str, message: RobotAck | RobotHealth) -> None:
    if (message.site, message.robot) != (site, robot):
        raise LinkError(f"robot {robot!r} of {site!r} speaks for {message.robot!r} of {message.site!r}")
