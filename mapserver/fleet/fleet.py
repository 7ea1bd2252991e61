"""State of the robots: wanted version, running version, last messages."""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from fleetmap import messages
from fleetmap.encoding import to_plain
from fleetmap.errors import LinkError, StoreError
from fleetmap.files import write_atomically
from fleetmap.mapformat.manifest import Name
from mapserver.fleet.ingest import Ingest, IngestSettings, Stream
from mapserver.fleet.rate_limit import RateLimit
from mapserver.fleet.replay_intake import ReplayIntake
from mapserver.fleet_statistics.canary_decision import number_of
from mapserver.fleet_statistics.health_stream import ClockSkew
from mapserver.store import CanaryRow, MapStore, RobotInfo
from mapserver.store.files import check_no_link, make_folder

MAX_ROBOTS = 10_000
MAX_FAILURE_BYTES = 4 * messages.MAX_THUMBNAIL_BYTES + (128 << 10)  # four pictures, and twenty fixes with text
# A robot that fails more than once a minute is broken; 60 may be stored from an hour without a network.
FAILURE_BURST, FAILURES_PER_S = 60, 1 / 60
_FORGET_AFTER_NS = 600_000_000_000
_GAP_NS = 60_000_000_000  # a longer silence starts a new sequence
_COPIED_NS = 3_600_000_000_000  # time for which a detected copy is reported
# A robot reports once a second; of two programs under one name every other report follows the last one within half a second, or before it.
_SOONEST_NS, _TWO_REPORT = 700_000_000, 20
_USUAL = IngestSettings()
_log = logging.getLogger(__name__)
_MAX_KEPT = 100


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """One robot. version: running version, None before the first report; seconds_since: since its last message.

    is_canary: True if it runs a version before the others. is_present: its liveliness token, None before the first check. is_copied: True
    if two programs were connected with its certificate, or reported under its name, at once within the last hour. state_since_ns: start
    of its present state (localised, DEGRADED or not localised) by the server's clock; None before its first report. clock_ahead_s: offset
    of its wall clock against the server's, None before its first report. last_ack, last_health and last_pose: its last messages as plain
    values, None if absent.
    """

    site: str
    robot: str
    version: int | None
    wanted_version: int | None
    is_canary: bool
    is_present: bool | None
    is_copied: bool
    clock_ahead_s: float | None
    seconds_since: float
    state_since_ns: int | None
    last_ack: dict[str, Any] | None
    last_health: dict[str, Any] | None
    last_pose: dict[str, Any] | None


class _Robot(msgspec.Struct):
    version: int | None = None
    seen_ns: int = 0
    report: dict[str, Any] = {}
    last_estimate: messages.PoseMessage | None = None
    skew: ClockSkew = msgspec.field(default_factory=ClockSkew)
    stream: Stream = msgspec.field(default_factory=Stream)
    is_present: bool | None = None
    is_stored: bool = False
    copied_ns: int | None = None
    wall_ns: int = -(2**62)
    haste: int = 0  # 2 more for each report that came too soon by its own clock, 1 less for each other one

    def note_report(self, wall_ns: int, now_ns: int) -> bool:
        """Take the time of a health report; True if two programs report under this name, and did not in the last hour."""
        is_soon = wall_ns - self.wall_ns < _SOONEST_NS
        self.wall_ns, self.haste = wall_ns, min(_TWO_REPORT, max(0, self.haste + (2 if is_soon else -1)))
        if self.haste < _TWO_REPORT:
            return False
        is_new = self.copied_ns is None or abs(now_ns - self.copied_ns) >= _COPIED_NS
        self.copied_ns = now_ns
        return is_new


class _Assignment(NamedTuple):
    """A site's current version, and its canary version."""

    current: messages.WantedVersion
    canary: CanaryRow | None = None
    tried: messages.WantedVersion | None = None

    def is_canary(self, robot: str) -> bool:
        canary = self.canary
        return canary is not None and number_of(canary.site, canary.version, robot) < canary.threshold

    def wanted(self, robot: str) -> messages.WantedVersion:
        return self.tried if self.tried is not None and self.is_canary(robot) else self.current


def _assignment(store: MapStore, site: str) -> _Assignment:
    info, running = store.current(site), store.canaries(site, running=True)
    number, address = (None, None) if info is None else (info.version, info.manifest_sha256)
    current = messages.WantedVersion(site=site, version=number, manifest_sha256=address)
    if not running:
        return _Assignment(current)
    number, address = running[0].version, store.version(site, running[0].version).manifest_sha256
    return _Assignment(current, running[0], messages.WantedVersion(site=site, version=number, manifest_sha256=address))


class Fleet:
    """Receives the robots' messages from any thread.

    Acknowledgements and failures are on the disk when the method returns, health with the next `flush`; the last pose is only
    in memory. `storage_fault`: why reports cannot be stored at present, empty otherwise. Messages for sites unknown to the store are
    refused, as are more than MAX_ROBOTS robots, so that invented names cannot fill the disk.
    """

    def __init__(
        self, store: MapStore, *, settings: IngestSettings = _USUAL, clock_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._store = store
        self._clock_ns = clock_ns
        self._lock = threading.Lock()
        self._ingest = Ingest(store, settings)
        self.prune = self._ingest.prune
        self.replays = ReplayIntake(store, settings.replay_bytes, clock_ns)
        self._failures = RateLimit(FAILURE_BURST, FAILURES_PER_S, clock_ns)
        self._robots = {(info.site, info.robot): _stored(info) for info in store.robots()}
        self.storage_fault = ""

    def wanted_version(self, site: str, robot: str) -> messages.WantedVersion:
        """Return the version that a robot should run: its site's current one, or the canary version.

        Raises UsageError for an unknown site.
        """
        return _assignment(self._store, site).wanted(robot)

    def wanted_versions(self, site: str) -> dict[str, messages.WantedVersion]:
        """Return the same for all robots of a site that ever sent a message or query."""
        assignment = _assignment(self._store, site)
        with self._lock:
            names = sorted(robot for of, robot in self._robots if of == site)
        return {robot: assignment.wanted(robot) for robot in names}

    def take_question(self, site: str, robot: str) -> messages.WantedVersion:
        """As `wanted_version`, queried by the robot itself: it is then registered, and notified of the next version."""
        wanted = self.wanted_version(site, robot)
        with self._lock:
            if (site, robot) in self._robots or len(self._robots) < MAX_ROBOTS:
                self._robots.setdefault((site, robot), _Robot()).seen_ns = self._clock_ns()
        return wanted

    def take_ack(self, site: str, robot: str, ack: messages.RobotAck) -> None:
        """Store an acknowledgement; raises LinkError for one in another robot's name."""
        _check_sender(site, robot, ack)
        with self._lock:
            entry = self._entry(site, robot, self._clock_ns(), ack.version)
            entry.report["ack"] = to_plain(ack)
            report, version = dict(entry.report), entry.version
        with self._storing():
            self._store.record_robot_report(site, robot, report, version)

    def take_health(self, site: str, robot: str, health: messages.RobotHealth) -> None:
        """Count a report and buffer it until the next `flush`; raises LinkError for one in another robot's name."""
        _check_sender(site, robot, health)
        now_ns = self._clock_ns()
        with self._lock:
            known = self._robots.get((site, robot))
            is_gap = known is None or now_ns - known.seen_ns > _GAP_NS
            entry = self._entry(site, robot, now_ns, health.version)
            last = entry.report.get("health") or {}
            since_ns = entry.report.get("state_since_ns")
            is_gap = is_gap or since_ns is None or since_ns > now_ns  # the clock was set back
            if is_gap or _state(last.get("status")) != _state(health.status):
                entry.report["state_since_ns"] = now_ns
            if health.wall_ns is not None:
                entry.skew.take(health.wall_ns, now_ns)
                entry.report["clock_ahead_s"] = entry.skew.ahead_s
                if entry.note_report(health.wall_ns, now_ns):
                    _log.warning(
                        "two programs report as robot %s of site %s: give each robot its own name", robot, site
                    )
            entry.report["health"] = to_plain(health)
            last = (entry.version, now_ns, dict(entry.report))
            self._ingest.take_health(entry.stream, health, entry.last_estimate, last)

    def take_pose(self, site: str, robot: str, message: messages.PoseMessage) -> None:
        with self._lock:
            entry = self._entry(site, robot, self._clock_ns(), message.map_version)
            entry.last_estimate = message
            entry.stream.health.take_pose(message)

    def take_failure(self, site: str, robot: str, report: messages.FailureReport) -> messages.FailureAck:
        """Store a failure, once however often it arrives; it is on the disk when this returns.

        A permanent refusal is in the answer; StoreError if a later attempt may succeed.
        """
        now_ns = self._clock_ns()
        try:
            _check_sender(site, robot, report)
            for picture in report.thumbnails:
                if not (picture.jpeg.startswith(b"\xff\xd8") and picture.jpeg.endswith(b"\xff\xd9")):
                    raise LinkError(f"failure {report.id!r} has a picture that is not a JPEG")
            with self._lock:
                ahead_s = self._entry(site, robot, now_ns, None).skew.ahead_s
        except LinkError as error:
            return messages.FailureAck(id=report.id, refused=str(error)[:2000])
        with self._storing():
            self._ingest.take_failure(report, now_ns, ahead_s)
        return messages.FailureAck(id=report.id)

    def take_failure_bytes(self, site: str, robot: str, payload: bytes) -> messages.FailureAck:
        """As `take_failure`, of an encoded report; names as of `check_name`. A permanently refused one is kept in the store's folder.

        Raises LinkError for bytes without a readable report id, and above the robot's rate limit: it
        retries later; StoreError if a later attempt may succeed.
        """
        if not self._failures.admits((site, robot)):
            raise LinkError(
                f"later: robot {robot[:80]!r} sent {FAILURE_BURST} failures; now one a minute is accepted; the robot keeps the others"
            )
        try:
            if len(payload) > MAX_FAILURE_BYTES:
                raise LinkError(f"a failure report of {len(payload)} bytes; the limit is {MAX_FAILURE_BYTES}")
            ack = self.take_failure(site, robot, messages.decode_message(payload, messages.FailureReport))
        except LinkError as error:
            ack = rejection(payload, str(error))
        if ack.refused:
            folder, payload = self._store.folder / "refused", payload[:MAX_FAILURE_BYTES]
            set_aside(folder, f"{self._clock_ns():020d}", (site, robot), payload, ack.refused)
        return ack

    def take_presence(self, present: Iterable[tuple[str, str]]) -> None:
        """Record which robots (site, name) have a liveliness token now; robots never seen stay unknown."""
        there = set(present)
        stored = self._store.robot_names()
        others = self._store.robots() if self._store.is_shared else []
        now_ns = self._clock_ns()
        with self._lock:
            for info in others:
                known = self._robots.get((info.site, info.robot))
                if known is None or info.last_seen_ns > known.seen_ns:  # by another server
                    fresh = self._robots[info.site, info.robot] = _stored(info)
                    if known is not None:
                        fresh.copied_ns, fresh.stream = known.copied_ns, known.stream
                    there.add((info.site, info.robot))
            for key, robot in list(self._robots.items()):
                robot.is_present = key in there
                # Removed by a command, or a name that only sent queries.
                gone = robot.is_stored or (not robot.is_present and now_ns - robot.seen_ns > _FORGET_AFTER_NS)
                if key not in stored and gone:
                    del self._robots[key]
                robot.is_stored = key in stored

    def take_copied(self, copied: Iterable[tuple[str, str]]) -> None:
        """Record robots (site, name) whose certificate is on two connections now."""
        with self._lock:
            for key in copied:
                if key in self._robots:
                    self._robots[key].copied_ns = self._clock_ns()

    def flush(self) -> None:
        """Write the counts to the disk; on a disk error raises StoreError and keeps them for the next call."""
        if self._ingest.has_counted():
            with self._storing():
                self._ingest.flush()

    def robots(self, site: str | None = None) -> list[RobotStatus]:
        """Return all robots (of a site), by site and name."""
        now_ns = self._clock_ns()
        with self._lock:
            for robot in self._robots.values():
                robot.seen_ns = min(robot.seen_ns, now_ns)  # the clock was set back: silence counts from now
            chosen = [(key, robot) for key, robot in sorted(self._robots.items()) if site in {None, key[0]}]
        assignments = {site: _assignment(self._store, site) for site in {key[0] for key, _ in chosen}}
        return [
            RobotStatus(
                site=site,
                robot=name,
                version=robot.version,
                wanted_version=assignments[site].wanted(name).version,
                is_canary=assignments[site].is_canary(name),
                is_present=robot.is_present,
                is_copied=robot.copied_ns is not None and abs(now_ns - robot.copied_ns) < _COPIED_NS,
                clock_ahead_s=robot.skew.ahead_s,
                seconds_since=max(0, now_ns - robot.seen_ns) / 1e9,
                state_since_ns=robot.report.get("state_since_ns"),
                last_ack=robot.report.get("ack"),
                last_health=robot.report.get("health"),
                last_pose=None if robot.last_estimate is None else to_plain(robot.last_estimate),
            )
            for (site, name), robot in chosen
        ]

    @contextmanager
    def _storing(self) -> Iterator[None]:
        """Set `storage_fault` to the reason why reports cannot be stored; empty after a successful write."""
        try:
            yield
        except StoreError as error:
            self.storage_fault = str(error)
            raise
        self.storage_fault = ""

    def _entry(self, site: str, robot: str, now_ns: int, version: int | None) -> _Robot:
        """Return the robot, seen now; `version` is its reported version. The caller holds the lock."""
        entry = self._robots.get((site, robot))
        if entry is None:
            if site not in {info.site for info in self._store.sites()}:
                raise LinkError(f"robot {robot!r} reports for site {site!r}, which is not in this store")
            if len(self._robots) >= MAX_ROBOTS:
                raise LinkError(f"robot {robot!r} exceeds the limit of {MAX_ROBOTS} robots of this server")
            entry = self._robots.setdefault((site, robot), _Robot())
        entry.version = version if version is not None else entry.version
        entry.seen_ns = now_ns
        return entry


def _stored(info: RobotInfo) -> _Robot:
    skew = ClockSkew(info.last_report.get("clock_ahead_s"))
    return _Robot(info.version, info.last_seen_ns, dict(info.last_report), skew=skew, is_stored=True)


def _state(status: object) -> object:
    """Return the state group: LOST, AMBIGUOUS and INITIALISING count as one, without a known position."""
    return status if status in {messages.Status.TRACKING, messages.Status.DEGRADED, None} else messages.Status.LOST


def _check_sender(
    site: str, robot: str, message: messages.RobotAck | messages.RobotHealth | messages.FailureReport
) -> None:
    if (message.site, message.robot) != (site, robot):
        raise LinkError(f"robot {robot!r} of {site!r} reports in the name of {message.robot!r} of {message.site!r}")


class _IdOnly(msgspec.Struct, frozen=True):
    id: Name


def rejection(payload: bytes, reason: str) -> messages.FailureAck:
    """Return the answer that stops a robot from resending an unreadable report; raises LinkError if its id is unreadable too."""
    try:
        known = msgspec.msgpack.decode(payload, type=_IdOnly)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise LinkError(reason) from error
    return messages.FailureAck(id=known.id, refused=reason[:2000])


def set_aside(folder: Path, moment: str, robot: tuple[str, str], payload: bytes, reason: str) -> None:
    """Keep a rejected report with its reason; only the latest ones are kept. A full disk loses only these. robot: site and name."""
    site, name = robot
    _log.warning("a failure of robot %r of site %r is permanently refused: %s", name[:80], site[:80], reason)
    try:
        check_no_link(folder.parent, folder)
        make_folder(folder)
        path = folder / f"{moment}-{site}-{name}.msgpack"
        write_atomically(path, [payload])
        write_atomically(path.with_suffix(".reason.txt"), [f"{reason}\n".encode("utf-8", "replace")])
        for old in sorted(folder.glob("*.msgpack"))[:-_MAX_KEPT]:
            old.unlink()
            old.with_suffix(".reason.txt").unlink(missing_ok=True)
    except (OSError, StoreError) as error:
        _log.warning("the refused report could not be kept in %s: %s", folder, error)
