"""Reads a stranger's recording in a process of its own, with limits: arguments RECORDING CALIBRATION TOPICS. Prints what `read` returns."""

import sys
from pathlib import Path

import msgspec

from fleetmap.encoding import to_json
from fleetmap.recordings import OpenOptions, open_recording
from fleetmap.sensors.source_settings import Topics
from mapserver.nightly.inbox import why_unreadable

_MOST_ISSUES = 5


def read(path: Path, options: OpenOptions) -> tuple[str, str]:
    """Return a recording's hash and its issues as text; an empty hash and the reason if it cannot be read."""
    try:
        with open_recording(path, options) as recording:
            issues = [f"{issue.what}: {issue.detail}".rstrip(": ") for issue in recording.issues[:_MOST_ISSUES]]
            return recording.content_hash(), "; ".join(issues)
    except Exception as error:  # a library's, of an untrusted file
        return "", why_unreadable(path, error)


if __name__ == "__main__":
    _calibration = Path(sys.argv[2]) if sys.argv[2] else None
    _options = OpenOptions(_calibration, msgspec.json.decode(sys.argv[3], type=Topics))
    print(to_json(read(Path(sys.argv[1]), _options)).decode())
