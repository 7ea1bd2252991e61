"""Delivery of reports of failures: to the server from the outbox, and into a folder of the robot."""

import logging
from pathlib import Path

import msgspec

from fleetmap.encoding import to_json, to_plain
from fleetmap.errors import LinkError, UnreachableError, disk_errors
from fleetmap.messages import FailureReport, decode_message
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.maps.map_client import MapClient

_DELIVERED_PER_STEP = 20
_log = logging.getLogger(__name__)


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
