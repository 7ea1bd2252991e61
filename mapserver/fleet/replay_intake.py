"""Intake of failures' recordings: parts from robots are joined, checked as untrusted files, and stored with their failure."""

import logging
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from fleetmap.errors import FleetmapError, LinkError, RecordingError
from fleetmap.failure_summary import MAX_FILE_BYTES, ReplayPart
from fleetmap.messages import FailureAck
from mapserver.fleet.bounded_process import ProcessLimits, run_bounded
from mapserver.fleet.rate_limit import RateLimit
from mapserver.store import FailureReplay, MapStore

# A repeatedly failing robot sends ten recordings at once, then one in ten minutes.
REPLAY_BURST, REPLAYS_PER_S = 10, 1 / 600
MAX_UPLOADS = 4  # simultaneous ones, all in memory
_IDLE_NS = 60_000_000_000
# A full recording takes a second and 200 MB. Two at a time, and their robots ask again meanwhile: others' parts do not wait.
_LIMITS, _AT_ONCE, _ANSWER_WITHIN_S = ProcessLimits(memory_bytes=1 << 30, cpu_s=20), 2, 2.0
_log = logging.getLogger(__name__)


class _Upload(msgspec.Struct):
    id: str
    total_bytes: int
    heard_ns: int
    data: bytearray = msgspec.field(default_factory=bytearray)
    judged: Future[FailureAck] | None = None


class ReplayIntake:
    """Receives parts in order. Methods may be called from any thread."""

    def __init__(self, store: MapStore, keep_bytes: int, clock_ns: Callable[[], int]) -> None:
        """keep_bytes: limit for all recordings; the oldest are deleted."""
        self._store, self._keep_bytes, self._clock_ns = store, keep_bytes, clock_ns
        self._lock, self._judges = threading.Lock(), ThreadPoolExecutor(_AT_ONCE, "judges of recordings")
        self._uploads: dict[tuple[str, str], _Upload] = {}
        self._rates = RateLimit(REPLAY_BURST, REPLAYS_PER_S, clock_ns)

    def take(self, site: str, robot: str, part: ReplayPart) -> FailureAck:
        """Return the received length of the recording; a permanent refusal is in the answer.

        Raises LinkError if the robot must retry later.
        """
        if part.total_bytes > MAX_FILE_BYTES:
            reason = f"a failure's recording of {part.total_bytes} bytes; the limit is {MAX_FILE_BYTES}"
            return FailureAck(id=part.id, refused=reason)
        with self._lock:
            upload = self._upload(site, robot, part)
            if isinstance(upload, FailureAck):
                return upload
            if part.offset == len(upload.data):
                upload.data += part.data[: part.total_bytes - part.offset]
            upload.heard_ns = self._clock_ns()
            if len(upload.data) < upload.total_bytes:
                return FailureAck(id=part.id, received_bytes=len(upload.data))
            within_s = 0.0 if upload.judged else _ANSWER_WITHIN_S
            if upload.judged is None:
                upload.judged = self._judges.submit(self._kept, site, robot, upload)
        if not wait([upload.judged], within_s).done:
            raise LinkError("later: the recording is being judged")
        with self._lock:
            self._uploads.pop((site, robot), None)
        return upload.judged.result()

    def _upload(self, site: str, robot: str, part: ReplayPart) -> _Upload | FailureAck:
        """Return the upload of the part, or the answer to a part without one. The caller holds the lock."""
        now_ns, key = self._clock_ns(), (site, robot)
        upload = self._uploads.get(key)
        if upload is not None and (upload.id, upload.total_bytes) == (part.id, part.total_bytes):
            return upload
        failure = self._store.fleet.failure_number(site, robot, part.id)
        if failure is None:
            return FailureAck(id=part.id, refused="unknown failure; send its report first")
        if self._store.fleet.replay_summary(failure) is not None:
            return FailureAck(id=part.id, received_bytes=part.total_bytes)
        if part.offset:
            return FailureAck(id=part.id)  # the upload was dropped: restart it
        self._uploads = {
            k: each for k, each in self._uploads.items() if k != key and abs(now_ns - each.heard_ns) < _IDLE_NS
        }
        if len(self._uploads) >= MAX_UPLOADS:
            raise LinkError(f"later: {MAX_UPLOADS} robots are already sending recordings")
        if not self._rates.admits(key):
            raise LinkError(
                f"later: robot {robot[:80]!r} sent {REPLAY_BURST} recordings; now one in ten minutes is accepted"
            )
        self._uploads[key] = _Upload(part.id, part.total_bytes, now_ns)
        return self._uploads[key]

    def _kept(self, site: str, robot: str, upload: _Upload) -> FailureAck:
        failure = self._store.fleet.failure_number(site, robot, upload.id)
        try:
            replay = _judged(bytes(upload.data), (site, robot, upload.id))
        except FleetmapError as error:
            _log.warning("the recording of a failure of robot %r is permanently refused: %s", robot[:80], error)
            return FailureAck(id=upload.id, refused=str(error)[:2000])
        if failure is not None:
            self._store.fleet.add_replay(failure, replay, self._keep_bytes)
        return FailureAck(id=upload.id, received_bytes=upload.total_bytes)


def _judged(data: bytes, named: tuple[str, str, str]) -> FailureReplay:
    """Return the recording with its summary and pictures, judged in a process with limits; named: site, robot and report.

    FleetmapError for invalid data, and for what takes more than the limits.
    """
    with TemporaryDirectory() as folder:
        path, found = Path(folder) / "failure.mcap", Path(folder) / "found"
        path.write_bytes(data)
        command = [sys.executable, "-m", "mapserver.fleet.replay_judge", str(path), str(found), *named]
        ended = run_bounded(command, _LIMITS, "the judgement of the recording")
        if ended.returncode:
            raise RecordingError(ended.stderr.strip().rpartition("\n")[2].replace(str(path), "the recording"))
        summary, pictures = msgspec.msgpack.decode(found.read_bytes(), type=tuple[bytes, list[tuple[int, bytes]]])
    return FailureReplay(summary, data, pictures)
