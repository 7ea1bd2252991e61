"""Synchronization with the map server: versions, acknowledgements, failures, health. May block; runs in its own thread."""

import logging
import time
from collections import deque
from collections.abc import Callable, Sequence
from datetime import UTC, datetime

from fleetmap.errors import FleetmapError, LinkError, MapFormatError, StoreError, UnreachableError, UntrustedError
from fleetmap.log_lines import LogLimit
from fleetmap.messages import InitialPoseMessage, RobotHealth, WantedVersion
from fleetmap.sensors.samples import PositionPrior
from fleetmap.threads import Jobs
from locclient.delivery.outbox import Outbox
from locclient.delivery.report_delivery import deliver, deliver_replay_part
from locclient.delivery.survey_drives import SurveyDrives
from locclient.hooks import RobotLink
from locclient.identity import RobotIdentity
from locclient.localization.priors.given import told_prior
from locclient.maps.building_maps import BuildingMaps
from locclient.maps.map_client import MapClient
from locclient.robot.version_trial import Change, VersionChange

_ASK_EVERY_S = 60.0
_RENEW_EVERY_S = 3600.0
_BACKOFF_S, _MAX_BACKOFF_S = 1.0, 30.0
_AWAY_S = 10.0  # without a connection before the log says so: shorter gaps of a radio network are usual
_REPLAY_PART_EVERY_S = 1.0  # a quarter of a megabyte: two megabits a second
_IS = "version %s is %s: %s"
_log = logging.getLogger(__name__)


class ServerSync:
    """In each `step`: fetches the wanted version, delivers failures, acknowledges, reports health.

    Other threads append to `health`, `changes` and `refetch` (a held version with damaged pieces on the disk), and take fetched
    versions from `fetched`. While the server is unreachable, reports wait in the outbox.
    """

    def __init__(
        self,
        client: MapClient,
        outbox: Outbox,
        *,
        retry_s: float,
        clock_s: Callable[[], float] = time.monotonic,
        wall_ns: Callable[[], int] = time.time_ns,
        identity: RobotIdentity | None = None,
        put_prior: Callable[[PositionPrior], None] = lambda _: None,
    ) -> None:
        """retry_s: delay before a postponed version is offered again. put_prior: called with operators' poses, on a thread of the bus."""
        self.replays: Outbox | None = None  # recordings of failures, which may be large
        self.drives: SurveyDrives | None = None  # through areas that operators want to be surveyed
        self.building: BuildingMaps | None = None
        self.recordings_at_s = 0.0
        # The certificate first: after a renewal whose response was lost, the server admits no other request.
        jobs = self._publish_health, self._deliver, self._fetch_again, self._ask, self._send_recordings
        self._jobs = Jobs(self._keep_certificate, *jobs, passed=UnreachableError, clock_s=clock_s)
        self.is_alone = False  # there is no server: a link brings versions
        self.links: Sequence[RobotLink] = ()
        self._refusals = LogLimit(_log)  # repeated refusals would fill the log
        self._identity, self._renew_at_s = identity, 0.0
        self.client, self._outbox, self._retry_s, self._put_prior = client, outbox, retry_s, put_prior
        self._clock_s, self._wall_ns = clock_s, wall_ns
        self.health: deque[RobotHealth] = deque(maxlen=1)  # only the last one is sent
        self.changes: deque[VersionChange] = deque()
        self.fetched: deque[WantedVersion] = deque()
        self.refetch: deque[WantedVersion] = deque(maxlen=1)
        self._offered: set[str] = set()
        self._running = client.active()
        if self._running is not None:
            self._offered.add(self._running.manifest_sha256 or "")
        self._not_before_s: dict[str, float] = {}
        self._ask_at_s, self._silent_until_s, self._backoff_s = 0.0, 0.0, _BACKOFF_S
        self._connected_s, self._is_away_told = clock_s(), False
        self._announced: deque[WantedVersion] = deque(maxlen=1)
        self._last_ack: tuple[int | None, str] | None = None
        self._handles = [
            client.announce_presence(),
            client.hear("wanted", WantedVersion, self._announced.append),
            client.hear("initial_pose", InitialPoseMessage, self._take_pose),
        ]

    def step(self) -> None:
        """Do all due work, each part even if another fails. Stop if the server does not answer, then wait with exponential backoff."""
        self._handle_changes()
        now_s = self._clock_s()
        if self.is_alone or not self._is_connected(now_s) or now_s < self._silent_until_s:
            return
        try:
            self._jobs.work()
        except UnreachableError as error:
            _log.info("the map server is away: %s", error)
            self._silent_until_s = self._clock_s() + self._backoff_s
            self._backoff_s = min(2 * self._backoff_s, _MAX_BACKOFF_S)
        else:
            self._backoff_s = _BACKOFF_S

    def _take_pose(self, told: InitialPoseMessage) -> None:
        site, robot = self.client.site, self.client.robot
        if (told.site, told.robot) != (site, robot):
            raise LinkError(f"a pose for robot {told.robot!r} of {told.site!r} was sent to {robot} of {site}")
        self._put_prior(told_prior(told))

    def _keep_certificate(self) -> None:
        """Renew the certificate of an enrolled robot once it is a month old; look once an hour."""
        if self._identity is not None and self._clock_s() >= self._renew_at_s:
            self._renew_at_s = self._clock_s() + _RENEW_EVERY_S
            if self._identity.is_renewal_due(datetime.now(UTC)):
                self._identity.renew(self.client.bus)
                _log.info("the certificate is renewed until %s", self._identity.certificate().ends)

    def _is_connected(self, now_s: float) -> bool:
        """True if a peer is reachable. The log says once that none is, and when one is again."""
        if self.client.bus.connected():
            if self._is_away_told:
                self._ask_at_s = 0.0  # it may have been restored from a backup
                self._refusals.warning("connected again", "connected to the map server again")
            self._connected_s, self._is_away_told = now_s, False
            return True
        if not self._is_away_told and now_s - self._connected_s >= _AWAY_S:
            self._is_away_told = True
            running = "no map until then" if self._running is None else f"version {self._running.version} goes on"
            words = "no connection to the map server for %.0f s: is it running, and is %s its zenoh endpoint? %s"
            self._refusals.warning("no connection", words, now_s - self._connected_s, self.client.bus.endpoint, running)
        return False

    def close(self) -> None:
        for handle in self._handles:
            handle.close()

    # --- versions -----------------------------------------------------------------------------------------------------

    def _ask(self) -> None:
        now_s = self._clock_s()
        if not self._announced and now_s < self._ask_at_s:
            return
        self._announced.clear()
        wanted = self.client.wanted()
        self._ask_at_s = now_s + _ASK_EVERY_S
        self._follow(wanted, now_s)
        self._send_again()

    def _follow(self, wanted: WantedVersion, now_s: float) -> None:
        """Fetch what the server wants, and all that belongs to it."""
        if self.drives is not None:
            self.drives.requests = self.client.surveys
        if self.building is not None:
            self.building.refresh()
        sha256 = wanted.manifest_sha256
        if sha256 is None:
            words = (
                "site %s has no published version at this server: publish one with `mapserver publish --site %s --store DIR` "
                "there, or correct [run] site"
            )
            self._refusals.warning("no version", words, wanted.site, wanted.site)
        elif chooser := next((link.chooses for link in self.links if link.chooses), ""):
            self._acknowledge("" if wanted == self._running else f"{chooser} chooses")
        elif sha256 in self._offered or now_s < self._not_before_s.get(sha256, 0.0):
            # Again, for a restarted server or a lost message.
            self._acknowledge("" if self._last_ack is None and self._running is not None else None)
        elif self._fetches(wanted, sha256):
            _log.info("version %s is fetched", wanted.version)
            self._offered.add(sha256)
            self.fetched.append(wanted)

    def _fetches(self, wanted: WantedVersion, sha256: str) -> bool:
        """Fetch a version and return True if it may be offered: an incomplete first one is better than none; otherwise the last good one
        stays."""
        try:
            self.client.fetch(wanted)
        except UnreachableError:
            self._ask_at_s = 0.0
            raise
        except (LinkError, MapFormatError, StoreError) as error:
            self._not_before_s[sha256] = self._clock_s() + _ASK_EVERY_S
            is_untrusted = isinstance(error, UntrustedError)
            _log.warning(_IS, wanted.version, Change.REFUSED, error)
            # The server knows the kind of an attack by the beginning of the words
            self._acknowledge(str(error) if is_untrusted else f"version {wanted.version}: {error}")
            return self._running is None and not is_untrusted
        return True

    def _fetch_again(self) -> None:
        """Fetch damaged or missing pieces of a version that the robot holds."""
        if self.refetch:
            self.client.fetch(self.refetch[0])
            self.fetched.append(self.refetch.popleft())

    def _handle_changes(self) -> None:
        """Activate adopted versions on the disk, and acknowledge all changes."""
        while self.changes:
            change = self.changes.popleft()
            sha256 = change.wanted.manifest_sha256 or ""
            if change.change is Change.ADOPTED:
                self._adopt(change.wanted)
            else:
                if change.change is Change.POSTPONED:
                    self._offered.discard(sha256)
                    self._not_before_s[sha256] = self._clock_s() + self._retry_s
                _log.warning(_IS, change.wanted.version, change.change, change.reason)
                self._acknowledge(f"version {change.wanted.version}: {change.reason}")
            for link in self.links:
                link.changed_version(change)

    def _adopt(self, wanted: WantedVersion) -> None:
        _log.info("version %s is adopted", wanted.version)
        self._running, fault = wanted, ""
        try:
            self.client.activate(self.client.manifest(wanted), wanted)
        except FleetmapError as error:
            # It runs from memory and from the cache, but is incomplete at the next start.
            fault = str(error)
            _log.warning("version %s runs but is not kept: %s", wanted.version, fault)
        self._acknowledge(fault)

    def _acknowledge(self, refused: str | None) -> None:
        """Report the running version, and why it is not the wanted one; None: as the last time."""
        if refused is not None:
            self._last_ack = (None if self._running is None else self._running.version, refused)
        if self._last_ack is not None:
            try:
                self.client.ack(self._last_ack[0], stamp_ns=self._wall_ns(), refused=self._last_ack[1])
            except LinkError as error:
                _log.info("the acknowledgement was not sent: %s", error)

    # --- reports ------------------------------------------------------------------------------------------------------

    def _deliver(self) -> None:
        if not deliver(self.client, self._outbox):
            self._silent_until_s = self._clock_s() + _MAX_BACKOFF_S

    def _send_again(self) -> None:
        """After the server's store was restored: what it had acknowledged before may be lost."""
        for outbox in (self._outbox, self.replays):
            try:
                count = 0 if outbox is None else outbox.send_again(self.client.restored_ns)
            except StoreError as error:  # an unusable spool delays no map
                _log.warning("what the map server may have lost waits: %s", error)
                continue
            if count:
                _log.warning(
                    "the map server was restored from a backup: %d reports or recordings are sent again", count
                )

    def _send_recordings(self) -> None:
        """Send a part of a recording, at most one per second, while no report waits and no version is fetched; failures first."""
        now_s = self._clock_s()
        if now_s < self.recordings_at_s or self._outbox.waiting():
            return
        goes_on = self.replays is not None and deliver_replay_part(self.client, self.replays)
        if not goes_on and self.drives is not None:
            goes_on = self.drives.deliver_part(self.client)
        self.recordings_at_s = now_s + (_REPLAY_PART_EVERY_S if goes_on else _MAX_BACKOFF_S)

    def _publish_health(self) -> None:
        while self.health:
            self.client.publish("health", self.health.popleft())
