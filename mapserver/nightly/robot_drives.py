"""Drives of robots through requested areas: received in parts, into the inbox of their site, where they are surveys like any other."""

import logging
import re
import threading
from dataclasses import dataclass
from pathlib import Path

from fleetmap.errors import FleetmapError, LinkError, StateError
from fleetmap.failure_summary import MAX_DRIVE_BYTES, ReplayPart
from fleetmap.messages import FailureAck
from mapserver.fleet.rate_limit import RateLimit
from mapserver.floor_plan.survey_requests import DRIVEN, KIND
from mapserver.nightly.inbox import arrivals
from mapserver.nightly.upload import Upload
from mapserver.serving.night_runs import SETTLE_S, NightRuns
from mapserver.store import Actor, MapStore

# A robot hands in two drives for each request; one that always begins anew, or under many names, fills no disk.
DRIVE_BURST, DRIVES_PER_S = 6, 1 / 1200
SITE_BURST, SITE_DRIVES_PER_S = 24, 1 / 600
MOST_OF_A_REQUEST = 24
_MOST_AT_ONCE = 4
_IDLE_NS = 120_000_000_000
_ID = re.compile(r"[0-9a-f]{8,32}")
_DRIVE = re.compile(r"survey-[0-9a-f]{8}-[a-z0-9_-]+-[0-9a-f]{8,32}\.mcap")
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Drive:
    id: str
    total_bytes: int
    upload: Upload
    heard_ns: int


class RobotDrives:
    """Receives parts in order, and starts a night once a drive is in. Methods may be called from any thread."""

    def __init__(self, store: MapStore, nights: NightRuns, *, waits: bool = False) -> None:
        """waits: drives at a site with a version on trial wait for its end, as `[canary] builds` asks for."""
        self._store, self._nights, self._waits, self._lock = store, nights, waits, threading.Lock()
        self._drives: dict[tuple[str, str], _Drive] = {}
        self._rates = RateLimit(DRIVE_BURST, DRIVES_PER_S, store.now_ns)
        self._site_rates = RateLimit(SITE_BURST, SITE_DRIVES_PER_S, store.now_ns)

    def take(self, site: str, robot: str, part: ReplayPart) -> FailureAck:
        """Return the received length of a drive; a permanent refusal is in the answer. LinkError if the robot must retry later."""
        if not _ID.fullmatch(part.id) or part.total_bytes > MAX_DRIVE_BYTES:
            return FailureAck(id=part.id, refused=f"not a drive of at most {MAX_DRIVE_BYTES} bytes")
        request = next((asked for asked in self._store.survey_requests(site) if asked.id == part.survey), None)
        if request is None:
            return FailureAck(id=part.id, refused="its survey is not requested any more")
        key = (site, robot)
        with self._lock:
            drive = self._drives.get(key)
            if drive is None or (drive.id, drive.total_bytes) != (part.id, part.total_bytes):
                # Robot and id of the drives for the request, by the log: those that other servers took, too
                events = self._store.events(site, (request.asked_ns, None))
                driven = [e for e in events if e.kind == KIND + request.id and e.detail.startswith(DRIVEN)]
                known = {(event.actor, event.reason.partition(",")[0]) for event in driven}
                if (robot, part.id) in known:  # the answer to its last part was lost
                    return FailureAck(id=part.id, received_bytes=part.total_bytes)
                if self._path(site, robot, part).exists():
                    return self._ended(site, robot, part)
                if len(known) >= MOST_OF_A_REQUEST:
                    return FailureAck(id=part.id, refused=f"{len(known)} drives were handed in for its survey already")
                if part.offset:
                    return FailureAck(id=part.id)  # begin again
                drive = self._begun(site, robot, part)
            try:
                if part.offset == drive.upload.size_bytes:
                    drive.upload.write(part.data[: part.total_bytes - part.offset])
                drive.heard_ns = self._store.now_ns()
                if drive.upload.size_bytes < drive.total_bytes:
                    return FailureAck(id=part.id, received_bytes=drive.upload.size_bytes)
                drive.upload.end()
            except FleetmapError as error:
                self._drop(key)
                raise LinkError(f"later: {error}") from error
            self._drop(key)  # closes the file, which has its name now
        return self._ended(site, robot, part)

    def build(self) -> None:
        """Start a night of a site whose inbox has a complete drive, unless one runs. The night judges and publishes as always. Drives of
        robots that fell silent are dropped."""
        with self._lock:
            self._drop_idle(self._store.now_ns())
        trials = {trial.site for trial in self._store.canaries(running=True)} if self._waits else set[str]()
        for inbox in sorted(path for path in self._nights.inbox.glob("*") if path.name not in trials):
            if any(_DRIVE.fullmatch(path.name) for path in arrivals(inbox, SETTLE_S, self._store.now_ns()).complete):
                try:
                    self._nights.start(inbox.name)
                except StateError as error:
                    _log.info("robots' drives at %s wait: %s", inbox.name, error)

    def _ended(self, site: str, robot: str, part: ReplayPart) -> FailureAck:
        who = Actor(robot, f"{part.id}, {part.total_bytes / 1e6:.1f} MB")
        self._store.audit(f"{KIND}{part.survey}", f"{DRIVEN}{robot}", actor=who, site=site)
        return FailureAck(id=part.id, received_bytes=part.total_bytes)

    def _path(self, site: str, robot: str, part: ReplayPart) -> Path:
        return self._nights.inbox / site / f"survey-{part.survey}-{robot}-{part.id}.mcap"

    def _begun(self, site: str, robot: str, part: ReplayPart) -> _Drive:
        """Begin a drive, instead of an earlier one of its robot. The caller holds the lock."""
        now_ns, key = self._store.now_ns(), (site, robot)
        self._drop(key)
        self._drop_idle(now_ns)
        if len(self._drives) >= _MOST_AT_ONCE:
            raise LinkError(f"later: {_MOST_AT_ONCE} robots are already handing in drives")
        if not self._rates.admits(key):
            raise LinkError(
                f"later: robot {robot[:80]!r} handed in {DRIVE_BURST} drives; now one in twenty minutes is accepted"
            )
        if not self._site_rates.admits(site):
            raise LinkError(f"later: site {site} got {SITE_BURST} drives; now one in ten minutes is accepted")
        path = self._path(site, robot, part)
        try:
            upload = Upload(path.parent, path.name, part.total_bytes)
        except FleetmapError as error:
            raise LinkError(f"later: {error}") from error
        self._drives[key] = _Drive(part.id, part.total_bytes, upload, now_ns)
        return self._drives[key]

    def _drop_idle(self, now_ns: int) -> None:
        for key in [key for key, each in self._drives.items() if abs(now_ns - each.heard_ns) > _IDLE_NS]:
            self._drop(key)

    def _drop(self, key: tuple[str, str]) -> None:
        if (drive := self._drives.pop(key, None)) is not None:
            drive.upload.discard()
