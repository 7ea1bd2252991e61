"""What a night asks of the recordings in an inbox: their hashes, read with limits, and those that it kept.

As a program with the arguments RECORDING CALIBRATION TOPICS it prints what `read` returns.
"""

import os
import sys
from contextlib import suppress
from math import ceil
from pathlib import Path
from typing import NamedTuple

import msgspec

from fleetmap.encoding import to_json
from fleetmap.errors import FleetmapError, RecordingError, StoreError, disk_errors
from fleetmap.recordings import OpenOptions, open_recording
from fleetmap.sensors.source_settings import Topics
from mapserver.fleet.bounded_process import ProcessLimits, run_bounded
from mapserver.nightly.inbox import DONE, HASH_SIGNS, HELD, names, parts, why_unreadable

# Time limit to read one: this, and 1 s for each 4 MiB on the disk; sparse files do not raise it
_READ_S, _SLOWEST_BYTES_PER_S = 600, 4 << 20
_LEAST_MEMORY_BYTES, _OPEN_FILES = 4 << 30, 1024
_MOST_ISSUES = 5


class InboxRecording(NamedTuple):
    """A readable recording; found: gaps reported by its reader, as text."""

    path: Path
    sha256: str
    found: str = ""

    def why(self, reason: str) -> str:
        """Return a reason together with the reader's findings, which are often its cause."""
        return f"{reason}; when it was read: {self.found}" if self.found else reason


def identify(path: Path, options: OpenOptions) -> InboxRecording | str | None:
    """Return a recording with its hash, or the reason why it is unreadable; None if it changed meanwhile.

    Its memory and time are limited. StoreError if this machine cannot start a process.
    """
    try:
        before, seconds = _state(path)
        sha256, words = _read(path, options, seconds)
        found = InboxRecording(path, sha256, words) if sha256 else words
        return found if _state(path)[0] == before else None
    except FileNotFoundError:
        return None
    except (OSError, RecordingError) as error:
        return why_unreadable(path, error)


def _read(path: Path, options: OpenOptions, seconds: float) -> tuple[str, str]:
    """Return the result of `read`, in a process of its own. StoreError if this machine cannot start one."""
    limits = ProcessLimits(_most_memory_bytes(), ceil(seconds), seconds, open_files=_OPEN_FILES)
    given = [str(path), str(options.calibration_file or ""), to_json(options.topics).decode()]
    try:
        with disk_errors("no process can be started", "see memory and disk of this machine"):
            ended = run_bounded([sys.executable, "-m", __name__, *given], limits, f"the reading of {path}")
    except StoreError:
        raise
    except FleetmapError as error:
        return "", str(error)
    if ended.returncode:
        return "", f"{path} cannot be read: {ended.stderr.strip().rpartition(chr(10))[2][:500]}"
    return msgspec.json.decode(ended.stdout, type=tuple[str, str])


def read(path: Path, options: OpenOptions) -> tuple[str, str]:
    """Return a recording's hash and its issues as text; an empty hash and the reason if it cannot be read."""
    try:
        with open_recording(path, options) as recording:
            issues = [f"{issue.what}: {issue.detail}".rstrip(": ") for issue in recording.issues[:_MOST_ISSUES]]
            return recording.content_hash(), "; ".join(issues)
    except Exception as error:  # a library's, of an untrusted file
        return "", why_unreadable(path, error)


def _state(path: Path) -> tuple[object, float]:
    """Return the files of an entry, to detect changes, and the time limit to read it in seconds."""
    found = list(parts(path))
    state = {(part, status.st_ino, status.st_size, status.st_ctime_ns) for part, status in found}
    return state, _READ_S + sum(512 * status.st_blocks for _, status in found) / _SLOWEST_BYTES_PER_S


def _most_memory_bytes() -> int:
    return max(_LEAST_MEMORY_BYTES, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2)


def kept(inbox: Path, sha256s: list[str]) -> list[Path]:
    """Return the recordings of these hashes still in the inbox, in the same order: done, or held and later published by an operator."""
    found: dict[str, Path] = {}
    for where in (DONE, HELD):
        for name in names(inbox / where):
            with suppress(OSError, RecordingError):  # it holds something other than files and folders
                for _ in parts(inbox / where / name):
                    pass
                found.setdefault(name[:HASH_SIGNS], inbox / where / name)
    return [found[sha256[:HASH_SIGNS]] for sha256 in sha256s if sha256[:HASH_SIGNS] in found]


if __name__ == "__main__":
    _calibration = Path(sys.argv[2]) if sys.argv[2] else None
    _options = OpenOptions(_calibration, msgspec.json.decode(sys.argv[3], type=Topics))
    print(to_json(read(Path(sys.argv[1]), _options)).decode())
