"""Which recording it is that came in."""

from dataclasses import dataclass
from pathlib import Path

from fleetmap.errors import RecordingError
from fleetmap.recordings import OpenOptions, open_recording


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recording that can be read."""

    path: Path
    sha256: str


def identify(path: Path, calibration: Path | None) -> Recorded | str:
    """Its hash, or why it cannot be read."""
    try:
        with open_recording(path, OpenOptions(calibration_file=calibration)) as recording:
            return Recorded(path, recording.content_hash())
    except RecordingError as error:
        return str(error)
