"""A failure's recording: an MCAP file of the seconds around a failure, kept by robots and sent to servers.

It is an ordinary recording with reduced images and two additional attachments: a summary, which every program reads, and the localizer's
initial pose with its perceptions since, which only a robot's client reads (locclient.delivery.failure_file).
"""

from contextlib import closing
from pathlib import Path

from fleetmap.errors import RecordingError
from fleetmap.failure_summary import MAX_FILE_BYTES
from fleetmap.recordings.mcap.reader import McapFile

SUMMARY, LOCALIZER = "failure.msgpack", "localizer.msgpack.zst"


def is_failure_recording(path: Path) -> bool:
    """True for a file with one or both attachments of a failure's recording."""
    if path.suffix.lower() != ".mcap" or not path.is_file() or path.stat().st_size > MAX_FILE_BYTES:
        return False
    try:
        return bool({SUMMARY, LOCALIZER} & set(_scanned(path).attachments))
    except (RecordingError, OSError):
        return False


def attachments_of(path: Path) -> dict[str, bytes]:
    """Both attachments of a failure's recording; RecordingError if one is missing or the file is damaged."""
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise RecordingError(f"{path} has {size} bytes; a failure's recording has at most {MAX_FILE_BYTES}")
    scanned = _scanned(path)
    if scanned.issues:
        raise RecordingError(f"{path} is damaged: {scanned.issues[0].what}: {scanned.issues[0].detail}; fetch it again")
    missing = [name for name in (SUMMARY, LOCALIZER) if name not in scanned.attachments]
    if missing:
        fault = f"is not a failure's recording: {missing[0]} is missing"
        raise RecordingError(f"{path} {fault}; `locclient replay` plays others")
    return {name: scanned.attachments[name] for name in (SUMMARY, LOCALIZER)}


def _scanned(path: Path) -> McapFile:
    with closing(McapFile(path)) as file:
        for _ in file.messages():
            pass
    return file
