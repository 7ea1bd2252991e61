"""Intake of failures' recordings: parts from robots are joined, checked as untrusted files, and stored with their failure."""

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from fleetmap.errors import FleetmapError, LinkError, RecordingError
from fleetmap.failure_summary import MAX_FILE_BYTES, ReplayPart, decode_summary
from fleetmap.messages import FailureAck, decode_message
from mapserver.fleet.rate_limit import RateLimit
from mapserver.store import FailureReplay, MapStore

# A repeatedly failing robot sends ten recordings at once, then one in ten minutes.
REPLAY_BURST, REPLAYS_PER_S = 10, 1 / 600
MAX_UPLOADS = 4  # simultaneous ones, all in memory
_IDLE_NS = 60_000_000_000
_MAX_PICTURES, _MAX_PICTURE_BYTES, _MAX_PIXELS = 64, 64 << 10, 1_000_000
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Upload:
    id: str
    total_bytes: int
    heard_ns: int
    data: bytearray = field(default_factory=bytearray)


class ReplayIntake:
    """Receives parts in order. Methods may be called from any thread."""

    def __init__(self, store: MapStore, keep_bytes: int, clock_ns: Callable[[], int]) -> None:
        """keep_bytes: limit for all recordings; the oldest are deleted."""
        self._store, self._keep_bytes, self._clock_ns = store, keep_bytes, clock_ns
        self._lock = threading.Lock()
        self._uploads: dict[tuple[str, str], _Upload] = {}
        self._rates = RateLimit(REPLAY_BURST, REPLAYS_PER_S, clock_ns)

    def take(self, site: str, robot: str, payload: bytes) -> FailureAck:
        """Return the received length of the recording; a permanent refusal is in the answer.

        Raises LinkError for an invalid part, and if the robot must retry later.
        """
        part = decode_message(payload, ReplayPart)
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
            del self._uploads[site, robot]
        return self._kept(site, robot, upload)

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
    """Return the recording with its summary and number of pictures; named: site, robot and report. FleetmapError for invalid data."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "failure.mcap"
        path.write_bytes(data)
        try:
            return _read(path, data, named)
        except FleetmapError as error:
            raise RecordingError(str(error).replace(str(path), "the recording")) from error


def _read(path: Path, data: bytes, named: tuple[str, str, str]) -> FailureReplay:
    # Recordings' readers import OpenCV: otherwise every command that reads a configuration would load it.
    from fleetmap.recordings import open_recording
    from fleetmap.recordings.failure_recording import SUMMARY, attachments_of
    from fleetmap.recordings.images import image_size

    summary_bytes = attachments_of(path)[SUMMARY]
    summary = decode_summary(summary_bytes)
    if (summary.site, summary.robot, summary.id) != named:
        raise RecordingError(
            f"the recording is of failure {summary.id!r} of {summary.robot!r}, not of {named[2]!r} of {named[1]!r}"
        )
    with open_recording(path) as recording:
        if len(recording) > _MAX_PICTURES:
            raise RecordingError(
                f"the recording has {len(recording)} pictures; a failure's has at most {_MAX_PICTURES}"
            )
        stored = [recording.stored_frame(number) for number in range(len(recording))]
    if any(frame.depth is not None for frame in stored):
        raise RecordingError("the recording has depth images; a failure's has none")
    pictures = [(frame.stamp_ns, frame.left.data) for frame in stored]
    for stamp_ns, jpeg in [*pictures, *((frame.stamp_ns, frame.right.data) for frame in stored if frame.right)]:
        size = image_size(jpeg)
        if not (jpeg.startswith(b"\xff\xd8") and jpeg.endswith(b"\xff\xd9")) or len(jpeg) > _MAX_PICTURE_BYTES:
            raise RecordingError(f"the picture at {stamp_ns} is not a JPEG of at most {_MAX_PICTURE_BYTES} bytes")
        if size is None or size[0] * size[1] > _MAX_PIXELS:
            raise RecordingError(f"the picture at {stamp_ns} is of size {size}; the limit is {_MAX_PIXELS} pixels")
    return FailureReplay(summary_bytes, data, pictures)
