"""Delivery to the server: failure reports from the outbox, then their recordings part by part; also reports into a folder."""

import logging
from collections import deque
from pathlib import Path

import msgspec

from fleetmap.encoding import to_json, to_plain
from fleetmap.errors import FleetmapError, LinkError, UnreachableError, disk_errors
from fleetmap.failure_summary import MAX_FILE_BYTES, ReplayPart
from fleetmap.messages import PART_BYTES, FailureReport, decode_message, encode_message
from locclient.delivery.failure_file import failure_file
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.maps.map_client import MapClient
from locclient.robot.failure_report import RobotProfile
from locclient.robot.failure_ring import FailureCut

_MAX_PENDING = 4  # each holds some seconds in memory
_DELIVERED_PER_STEP = 20
_log = logging.getLogger(__name__)


class ReplayQueue:
    """Failures whose recording is not yet complete; `work` moves complete ones to the outbox. For one thread."""

    def __init__(self, outbox: Outbox, profile: RobotProfile) -> None:
        self.outbox, self._profile = outbox, profile
        self._pending: deque[tuple[FailureReport, FailureCut]] = deque(maxlen=_MAX_PENDING)

    def add(self, report: FailureReport, cut: FailureCut | None) -> None:
        if cut is None:
            return
        if len(self._pending) == _MAX_PENDING:
            _log.warning("failures follow each other too fast: %s goes without its recording", self._pending[0][0].id)
        self._pending.append((report, cut))

    def work(self) -> None:
        """Write complete recordings. One that cannot be written or is too large is lost; its report is not."""
        for report, cut in [entry for entry in self._pending if entry[1].frames is not None]:
            self._pending.remove((report, cut))
            try:
                data = failure_file(cut, report, self._profile)
                if len(data) > MAX_FILE_BYTES:
                    _log.warning("the recording of failure %s has %d bytes and is not sent", report.id, len(data))
                    continue
                self.outbox.put(QueuedReport(report.id, data))
            except (FleetmapError, OSError) as error:
                _log.warning("the recording of failure %s is lost: %s", report.id, error)


def deliver_replay_part(client: MapClient, outbox: Outbox) -> bool:
    """Send one part of the oldest recording; False if none waits or the server accepts none now."""
    replay = next(iter(outbox.waiting()), None)
    if replay is None:
        return False
    offset = outbox.received_bytes.get(replay.id, 0)
    data = replay.payload[offset : offset + PART_BYTES]
    part = ReplayPart(id=replay.id, total_bytes=len(replay.payload), offset=offset, data=data)
    try:
        ack = client.deliver("replays", encode_message(part))
    except LinkError as error:  # an older server does not accept recordings: reports and maps continue
        _log.info("the recording of failure %s waits: %s", replay.id, error)
        return False
    outbox.received_bytes[replay.id] = ack.received_bytes
    if ack.refused or ack.id != replay.id:
        _log.warning("the server will not keep the recording of failure %s: %s", replay.id, ack.refused or ack.id)
        outbox.refused(replay.id)
    elif ack.received_bytes >= len(replay.payload):
        _log.info("the recording of failure %s is delivered: %d bytes", replay.id, len(replay.payload))
        outbox.done(replay.id)
    else:
        return ack.received_bytes != offset  # else the server accepted nothing
    del outbox.received_bytes[replay.id]
    return True


def deliver(client: MapClient, outbox: Outbox) -> bool:
    """Send waiting reports, oldest first; False if the server refuses some of them for now.

    A report refused for now does not delay later ones; a damaged one is dropped. Raises UnreachableError if the server does not answer.
    """
    is_open = True
    for report in outbox.waiting(_DELIVERED_PER_STEP):
        try:
            if (about := decode_message(report.payload, FailureReport).id) != report.id:
                raise LinkError(f"it is about {about}")
        except LinkError as error:
            _log.warning("the report of failure %s is damaged and dropped: %s", report.id, error)
            outbox.refused(report.id)
            continue
        try:
            ack = client.deliver("failures", report.payload)
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
            _log.info("the report of failure %s is delivered", report.id)
            outbox.done(report.id)
    return is_open


def write_failure(folder: Path, report: FailureReport) -> Path:
    """Write `STAMP-KIND-CAUSE.json` with its pictures beside it and return its path; StoreError on a disk error."""
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
