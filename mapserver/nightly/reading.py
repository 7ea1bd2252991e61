"""Reads a stranger's recording in a process of its own, with limits: arguments RECORDING CALIBRATION TOPICS. Prints what `read` returns."""

import os
import resource
import sys
from pathlib import Path

import msgspec

from fleetmap.encoding import to_json
from fleetmap.errors import FleetmapError
from fleetmap.recordings import OpenOptions, open_recording
from fleetmap.sensors.source_settings import Topics

_MOST_ISSUES = 5


def read(path: Path, options: OpenOptions) -> tuple[str, str]:
    """Return a recording's hash and its issues as text; an empty hash and the reason if it cannot be read."""
    try:
        with open_recording(path, options) as recording:
            issues = [f"{issue.what}: {issue.detail}".rstrip(": ") for issue in recording.issues[:_MOST_ISSUES]]
            return recording.content_hash(), "; ".join(issues)
    except Exception as error:  # a library's, of an untrusted file
        return "", why_unreadable(path, error)


def why_unreadable(path: Path, error: Exception) -> str:
    """Return the reason, with the next step."""
    if isinstance(error, FleetmapError):
        return str(error)
    if isinstance(error, MemoryError):
        most_bytes = resource.getrlimit(resource.RLIMIT_AS)[0]
        return f"{path} takes more than {most_bytes >> 20} MiB of memory to read; is it damaged? Copy it again"
    if isinstance(error, OSError):
        named = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else path
        return f"{named} cannot be read ({error.strerror or error}); give this account read access, or copy it again"
    return f"{path} cannot be read ({type(error).__name__}: {str(error)[:200]}); try `mapserver doctor {path}`"


if __name__ == "__main__":
    _calibration = Path(sys.argv[2]) if sys.argv[2] else None
    _options = OpenOptions(_calibration, msgspec.json.decode(sys.argv[3], type=Topics))
    print(to_json(read(Path(sys.argv[1]), _options)).decode())
