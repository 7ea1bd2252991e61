"""Delivery to the server: reports of failures from the outbox, behind them their recordings part by part; reports into a folder, too."""

import logging
from collections import deque
from pathlib import Path

import msgspec

from fleetmap.encoding import to_json, to_plain
from fleetmap.errors import FleetmapError, LinkError, UnreachableError, disk_errors
from fleetmap.failure_summary import MAX_FILE_BYTES, ReplayPart
from fleetmap.messages import PART_BYTES, FailureReport, decode_message
from locclient.delivery.failure_file import failure_file
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.maps.map_client import MapClient
from locclient.robot.failure_report import RobotProfile
from locclient.robot.failure_ring import FailureCut

_MAX_PENDING = 4  # each holds some seconds in memory
_log = logging.getLogger(__name__)


class ReplayQueue:
    """Failures whose last seconds are still to come; `work` brings those that are complete to the outbox. For one thread."""

    def __init__(self, outbox: Outbox, profile: RobotProfile, pictures: str) -> None:
        """pictures: one of failure_file.PICTURES."""
        self.outbox, self._profile, self._pictures = outbox, profile, pictures
        self._pending: deque[tuple[FailureReport, FailureCut]] = deque(maxlen=_MAX_PENDING)

    def add(self, report: FailureReport, cut: FailureCut | None) -> None:
        if cut is None:
            return
        if len(self._pending) == _MAX_PENDING:
            _log.warning("failures follow each other too fast: %s goes without its recording", self._pending[0][0].id)
        self._pending.append((report, cut))

    def work(self) -> None:
        """Writes recordings that are complete; one that cannot be written or is too large is lost, and its report is not."""
        for report, cut in [entry for entry in self._pending if entry[1].frames is not None]:
            self._pending.remove((report, cut))
            try:
                data = failure_file(cut, report, self._profile, self._pictures)
                if len(data) > MAX_FILE_BYTES:
                    _log.warning("the recording of failure %s has %d bytes and is not sent", report.id, len(data))
                    continue
                self.outbox.put(QueuedReport(report.id, data))
            except (FleetmapError, OSError) as error:
                _log.warning("the recording of failure %s is lost: %s", report.id, error)


def deliver_replay_part(client: MapClient, outbox: Outbox, received_bytes: dict[str, int]) -> bool:
    """Sends one part of the oldest recording; False where none waits, or the server takes none now.

    received_bytes: by the report's id, what the server had; kept by the caller between calls.
    """
    waiting = outbox.waiting(1)
    if not waiting:
        return False
    replay = waiting[0]
    offset = received_bytes.get(replay.id, 0)
    data = replay.payload[offset : offset + PART_BYTES]
    try:
        ack = client.send_replay_part(
            ReplayPart(id=replay.id, total_bytes=len(replay.payload), offset=offset, data=data)
        )
    except LinkError as error:  # an older server knows no recordings: reports and maps go on
        _log.info("the recording of failure %s waits: %s", replay.id, error)
        return False
    if ack.refused or ack.id != replay.id:
        _log.warning("the server will not keep the recording of failure %s: %s", replay.id, ack.refused or ack.id)
        outbox.refused(replay.id)
    elif ack.received_bytes >= len(replay.payload):
        outbox.done(replay.id)
    elif ack.received_bytes == offset:
        return False  # nothing was taken
    else:
        received_bytes[replay.id] = ack.received_bytes
        return True
    received_bytes.pop(replay.id, None)
    return True


_DELIVERED_PER_STEP = 20


def deliver(client: MapClient, outbox: Outbox) -> bool:
    """Sends waiting reports, oldest first; False where the server refuses some of them for now.

    One that is refused for now does not hold up those behind it; a damaged one is dropped. Raises UnreachableError where nobody answers.
    """
    is_open = True
    for report in outbox.waiting(_DELIVERED_PER_STEP):
        if not _is_whole(report):
            outbox.refused(report.id)
            continue
        try:
            ack = client.report_failure(report.payload)
        except UnreachableError:
            raise
        except LinkError as error:
            _log.warning("the report of failure %s waits: %s", report.id, error)
            is_open = False
            continue
        if ack.id != report.id:
            _log.warning("the server acknowledged failure %s for %s; it is sent again", ack.id, report.id)
        elif ack.refused:
            _log.warning("the server will not keep failure %s: %s", report.id, ack.refused)
            outbox.refused(report.id)
        else:
            outbox.done(report.id)
    return is_open


def _is_whole(report: QueuedReport) -> bool:
    """Whether a report is still the one that was put into the outbox; logs where it is not."""
    try:
        decoded_id = decode_message(report.payload, FailureReport).id
    except LinkError as error:
        _log.warning("the report of failure %s is damaged and dropped: %s", report.id, error)
        return False
    if decoded_id != report.id:
        _log.warning("the report of failure %s is damaged and dropped: it tells of %s", report.id, decoded_id)
    return decoded_id == report.id


def write_failure(folder: Path, report: FailureReport) -> Path:
    """The path of `STAMP-KIND-CAUSE.json`, written with its pictures beside it; raises StoreError where the disk refuses."""
    name = f"{report.stamp_ns}-{report.kind}-{report.cause}"
    fields = to_plain(msgspec.structs.replace(report, thumbnails=()))
    fields["thumbnails"] = []
    with disk_errors(f"{folder} cannot be written", "choose another folder with [run] failures"):
        folder.mkdir(parents=True, exist_ok=True)
        for number, picture in enumerate(report.thumbnails):
            path = folder / f"{name}-{number}-{picture.kind}.jpg"
            path.write_bytes(picture.jpeg)
            fields["thumbnails"].append(path.name)
        target = folder / f"{name}.json"
        target.write_bytes(to_json(fields, indent=2) + b"\n")
    return target
