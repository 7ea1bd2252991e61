"""Messages about a failure's recording from robot to server: its parts in transfer, and the summary in it.

Neither needs a reader of recordings: programs that only forward them do not load OpenCV.
"""

from itertools import pairwise
from typing import Annotated

import msgspec

from fleetmap.encoding import bounded
from fleetmap.errors import RecordingError
from fleetmap.mapformat.manifest import Name

MAX_FILE_BYTES = 8 << 20
MAX_DRIVE_BYTES = 48 << 20
"""Largest size of the recording of a failure, and of a drive through a requested area."""
_MAX_SUMMARY_BYTES, _MAX_MOMENTS = 512 << 10, 2000

Text = Annotated[str, msgspec.Meta(max_length=64)]
Stamp = Annotated[int, msgspec.Meta(ge=-(1 << 62), le=1 << 62)]


class ReplayPart(msgspec.Struct, frozen=True, kw_only=True):
    """Part of a recording in transfer, from offset on; total_bytes: of the whole recording.

    id: of the failure's report, or a drive's own; survey: the request that the drive is for, None for a failure's.
    """

    id: Text
    total_bytes: Annotated[int, msgspec.Meta(ge=1, le=1 << 40)]
    offset: Annotated[int, msgspec.Meta(ge=0, le=1 << 40)]
    data: bytes
    survey: Text | None = None


class Moment(msgspec.Struct, frozen=True, array_like=True):
    """The robot's estimate for one frame; position, heading (of the body's x axis, from x towards y) and radius None without a pose."""

    stamp_ns: Stamp
    status: Text
    cause: Text
    position_map_m: tuple[float, float, float] | None = None
    heading_rad: float | None = None
    radius_95_m: float | None = None


class FailureSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Robot and time of a failure, with the robot's estimates during it.

    id: of the report. began_ns: its stamp_ns. version, manifest_sha256: the robot's map at the beginning, None without one.
    client: version of fleetmap. pictures: `full` or `blurred`.
    """

    site: Name
    robot: Name
    id: Text
    began_ns: Stamp
    version: int | None
    manifest_sha256: Text | None
    client: Text
    pictures: Text
    moments: Annotated[tuple[Moment, ...], msgspec.Meta(min_length=1, max_length=_MAX_MOMENTS)]


def decode_summary(data: bytes) -> FailureSummary:
    """Decode a summary; RecordingError for invalid bytes."""
    if len(data) > _MAX_SUMMARY_BYTES:
        raise RecordingError(f"a failure's summary of {len(data)} bytes; the limit is {_MAX_SUMMARY_BYTES}")
    try:
        summary = bounded(msgspec.msgpack.decode(data, type=FailureSummary))
    except (ValueError, RecursionError) as error:
        fault = f"the failure's summary cannot be read ({error})"
        raise RecordingError(f"{fault}; was it made by another fleetmap?") from error
    if any(later <= earlier for earlier, later in pairwise([moment.stamp_ns for moment in summary.moments])):
        fault = "the moments of the failure's summary are not in the order of time"
        raise RecordingError(f"{fault}; was it made by a robot?")
    return summary
