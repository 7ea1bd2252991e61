"""Judges a failure's recording in a process of its own, with limits: arguments FAILURE.mcap FOUND SITE ROBOT REPORT."""

import sys
from pathlib import Path

from fleetmap.encoding import to_msgpack
from fleetmap.errors import FleetmapError, RecordingError
from fleetmap.failure_summary import decode_summary
from fleetmap.recordings import open_recording
from fleetmap.recordings.failure_recording import SUMMARY, attachments_of
from fleetmap.recordings.images import image_size

_MAX_PICTURES, _MAX_PICTURE_BYTES, _MAX_PIXELS = 64, 64 << 10, 1_000_000


def judged(path: Path, named: tuple[str, str, str]) -> tuple[bytes, list[tuple[int, bytes]]]:
    """Return summary and pictures (stamp, JPEG) of a failure's recording; named: site, robot and report. FleetmapError if invalid."""
    summary_bytes = attachments_of(path)[SUMMARY]
    summary = decode_summary(summary_bytes)
    if (summary.site, summary.robot, summary.id) != named:
        words = f"the recording is of failure {summary.id!r} of {summary.robot!r}"
        raise RecordingError(f"{words}, not of {named[2]!r} of {named[1]!r}")
    with open_recording(path) as recording:
        if len(recording) > _MAX_PICTURES:
            raise RecordingError(f"{len(recording)} pictures; a failure's recording has at most {_MAX_PICTURES}")
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
    return summary_bytes, pictures


if __name__ == "__main__":
    try:
        Path(sys.argv[2]).write_bytes(to_msgpack(judged(Path(sys.argv[1]), (sys.argv[3], sys.argv[4], sys.argv[5]))))
    except FleetmapError as refused:
        sys.exit(" ".join(str(refused).split()))
