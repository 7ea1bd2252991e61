"""All that a running robot says to its map server and hears from it. May block on the network: it has a thread of its own."""

import logging
import time
from collections import deque
from collections.abc import Callable

from fleetmap.errors import FleetmapError, LinkError, MapFormatError, StoreError, UnreachableError
from fleetmap.messages import FailureReport, RobotHealth, WantedVersion, decode_message
from locclient.daemon.outbox import Outbox, QueuedReport
from locclient.maps.map_client import MapClient
from locclient.robot.robot import Change, VersionChange

_ASK_EVERY_S = 60.0
_QUIET_S, _MAX_QUIET_S = 1.0, 30.0
_DELIVER_AT_ONCE = 20
_log = logging.getLogger(__name__)


class ServerSync:
    """One `step` after another: asks for the wanted version and fetches it, delivers failures, acknowledges, reports health.

    The main thread leaves what is to be said in `health` and `changes` and finds fetched versions in `fetched`. A server that is
    away costs nothing but patience; reports wait in the spool. refetch: a held version whose pieces on the disk are damaged.
    """

    def __init__(
        self, link: MapClient, spool: Outbox, *, retry_s: float, clock_s: Callable[[], float] = time.monotonic,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:  # fmt: skip
        """retry_s: when a version that was put off is offered again."""
        self._link, self._spool, self._retry_s = link, spool, retry_s
        self._clock_s, self._wall_ns = clock_s, wall_ns
        self.health: deque[RobotHealth] = deque(maxlen=1)  # only the last one is worth sending
        self.changes: deque[VersionChange] = deque()
        self.fetched: deque[WantedVersion] = deque()
        self.refetch: deque[WantedVersion] = deque(maxlen=1)
        self._offered: set[str] = set()
        self._running = link.active()
        if self._running is not None:
            self._offered.add(self._running.manifest_sha256 or "")
        self._not_before_s: dict[str, float] = {}
        self._ask_at_s, self._quiet_until_s, self._quiet_s = 0.0, 0.0, _QUIET_S
        self._announced: deque[WantedVersion] = deque(maxlen=1)
        self._told: tuple[int | None, str] | None = None
        self._handles = [link.announce_presence(), link.on_wanted(self._announced.append)]

    def step(self) -> None:
        """What is due now; returns early where nobody answers, and then leaves the network alone for a while."""
        self._settle_changes()
        now_s = self._clock_s()
        if now_s < self._quiet_until_s or not self._link.connected():
            return
        try:
            self._publish_health()
            self._deliver()
            self._fetch_again()
            if self._announced or now_s >= self._ask_at_s:
                self._ask(now_s)
        except UnreachableError as error:
            _log.info("the map server is away: %s", error)
            self._quiet_until_s = self._clock_s() + self._quiet_s
            self._quiet_s = min(2 * self._quiet_s, _MAX_QUIET_S)
        except FleetmapError as error:
            _log.warning("the map server refused: %s", error)
            self._ask_at_s = max(self._ask_at_s, now_s + _MAX_QUIET_S)
        else:
            self._quiet_s = _QUIET_S

    def close(self) -> None:
        """Takes back the robot's presence."""
        for handle in self._handles:
            handle.close()

    # --- versions -----------------------------------------------------------------------------------------------------

    def _ask(self, now_s: float) -> None:
        self._announced.clear()
        wanted = self._link.wanted()
        self._ask_at_s = now_s + _ASK_EVERY_S
        sha256 = wanted.manifest_sha256
        if sha256 is None:
            return
        if sha256 in self._offered or now_s < self._not_before_s.get(sha256, 0.0):
            return self._acknowledge_again()
        try:
            self._link.fetch(wanted)
        except (LinkError, MapFormatError, StoreError) as error:
            if isinstance(error, UnreachableError):
                self._ask_at_s = 0.0
                raise
            self._not_before_s[sha256] = now_s + _ASK_EVERY_S
            self._refuse(wanted, str(error))
            if self._running is not None:
                return None
        # Of a first version what came is better than nothing; of any other the last good one is.
        self._offered.add(sha256)
        self.fetched.append(wanted)
        return None

    def _fetch_again(self) -> None:
        """Of a version that the robot holds, what its disk has lost meanwhile."""
        if self.refetch:
            self._link.fetch(self.refetch[0])
            self.fetched.append(self.refetch.popleft())

    def _settle_changes(self) -> None:
        """Makes adopted versions the active ones on the disk, and remembers what to tell."""
        while self.changes:
            change = self.changes.popleft()
            sha256 = change.wanted.manifest_sha256 or ""
            if change.change is Change.ADOPTED:
                self._adopt(change.wanted)
            else:
                if change.change is Change.POSTPONED:
                    self._offered.discard(sha256)
                    self._not_before_s[sha256] = self._clock_s() + self._retry_s
                self._refuse(change.wanted, change.reason)

    def _adopt(self, wanted: WantedVersion) -> None:
        self._running = wanted
        self._told = (wanted.version, "")
        try:
            self._link.activate(self._link.manifest(wanted), wanted)
        except FleetmapError as error:
            # It runs from memory and from what is in the cache; it is only not there whole for the next start.
            self._told = (wanted.version, str(error))
            _log.warning("version %s runs but is not kept: %s", wanted.version, error)
        self._tell()

    def _refuse(self, wanted: WantedVersion, reason: str) -> None:
        _log.warning("version %s is refused: %s", wanted.version, reason)
        self._told = (None if self._running is None else self._running.version, f"version {wanted.version}: {reason}")
        self._tell()

    def _acknowledge_again(self) -> None:
        """A server that restarted has forgotten, and an acknowledgement may have been lost."""
        if self._told is None and self._running is not None:
            self._told = (self._running.version, "")
        self._tell()

    def _tell(self) -> None:
        if self._told is not None:
            try:
                self._link.ack(self._told[0], stamp_ns=self._wall_ns(), refused=self._told[1])
            except LinkError as error:
                _log.info("the acknowledgement was not sent: %s", error)

    # --- reports ------------------------------------------------------------------------------------------------------

    def _publish_health(self) -> None:
        while self.health:
            self._link.publish_health(self.health.popleft())

    def _deliver(self) -> None:
        """Failures, oldest first. One that the server refuses for now does not hold up those behind it.

        One that the disk has damaged is let go: nobody will ever be able to read it, and it would be told for ever.
        """
        for report in self._spool.waiting(_DELIVER_AT_ONCE):
            if not _is_whole(report):
                self._spool.refused(report.id)
                continue
            try:
                ack = self._link.report_failure(report.payload)
            except UnreachableError:
                raise
            except LinkError as error:
                _log.warning("the report of failure %s waits: %s", report.id, error)
                self._quiet_until_s = self._clock_s() + _MAX_QUIET_S
                continue
            if ack.id != report.id:
                _log.warning("the server acknowledged failure %s for %s; it is told again", ack.id, report.id)
            elif ack.refused:
                _log.warning("the server will not keep failure %s: %s", report.id, ack.refused)
                self._spool.refused(report.id)
            else:
                self._spool.done(report.id)


def _is_whole(report: QueuedReport) -> bool:
    """Whether what lies in the spool is still the report that was put there; says so where it is not."""
    try:
        told = decode_message(report.payload, FailureReport).id
    except LinkError as error:
        _log.warning("the report of failure %s is damaged and dropped: %s", report.id, error)
        return False
    if told != report.id:
        _log.warning("the report of failure %s is damaged and dropped: it tells of %s", report.id, told)
    return told == report.id
