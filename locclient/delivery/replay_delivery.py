"""Delivery of failures' recordings: written once the seconds after the failure have come, and sent part by part behind all reports."""

import logging
from collections import deque

from fleetmap.errors import FleetmapError, LinkError
from fleetmap.failure_summary import MAX_FILE_BYTES, ReplayPart
from fleetmap.messages import PART_BYTES, FailureReport
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
