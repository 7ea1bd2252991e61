"""The folder into which recordings are copied, and the folders where each goes from there. Nothing is ever deleted.

    INBOX/NAME             a recording: a folder, or a file with a suffix such as .mcap
    INBOX/done/HASH-NAME   it is in a version
    INBOX/held/HASH-NAME   it is sound, but could not be joined, or its draft was refused; move it back to try again
    INBOX/bad/NAME         it cannot be read, or `doctor` says that it should not be used

Beside what is held or bad lies NAME.reason.txt.
"""

import fcntl
import hashlib
import os
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path

from fleetmap.errors import RecordingError, UsageError, disk_errors
from fleetmap.log_lines import printable
from fleetmap.recordings import FILE_SUFFIXES, OpenOptions, open_recording
from mapserver.store.files import make_folder, sync_folder, write_atomically

DONE, HELD, BAD = "done", "held", "bad"
_HASH_SIGNS = 12
_MAX_NAME_BYTES = 200  # of 255: the hash goes before the name, a number too, and `.reason.txt` behind it
_UNFINISHED = (".part", ".partial", ".filepart", ".crdownload", ".tmp")
_REASON = ".reason.txt"


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Recordings that are whole, by name, and those that are not yet, with the reason."""

    complete: tuple[Path, ...]
    waiting: tuple[tuple[Path, str], ...]


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recording that can be read."""

    path: Path
    sha256: str


def identify(path: Path, options: OpenOptions) -> Recorded | str:
    """A recording with its hash, or why it cannot be read."""
    try:
        with open_recording(path, options) as recording:
            return Recorded(path, recording.content_hash())
    except RecordingError as error:
        return str(error)


def arrivals(inbox: Path, settle_s: float, now_ns: int) -> Arrivals:
    """What is in the inbox now. Hidden names and files with other suffixes than FILE_SUFFIXES are ignored.

    A recording is whole when nothing in it changed for `settle_s`, no file in it bears the name of a half copied one, and
    no process has one open for writing, as far as the system tells. Raises UsageError where there is no such folder.
    """
    if not inbox.is_dir():
        raise UsageError(f"--inbox {inbox} is no folder; create it, or name the one that recordings are copied into")
    complete, waiting = [], []
    for path in sorted(inbox.iterdir()):
        if path.name.startswith(".") or path.name in (DONE, HELD, BAD):
            continue
        if path.suffix in _UNFINISHED or path.is_dir() or path.suffix in FILE_SUFFIXES:
            if reason := _unfinished(path, settle_s, now_ns):
                waiting.append((path, reason))
            else:
                complete.append(path)
    return Arrivals(tuple(complete), tuple(waiting))


def _unfinished(path: Path, settle_s: float, now_ns: int) -> str | None:
    """Why a recording is not whole yet; None if it is."""
    newest_ns = 0
    try:
        for part in (path, *(path.rglob("*") if path.is_dir() else ())):
            if part.suffix in _UNFINISHED:
                return f"{part.name} is half copied"
            # Not mtime: copying tools set it back. Nobody can set this one.
            newest_ns = max(newest_ns, part.stat().st_ctime_ns)
            if part.is_file() and _is_being_written(part):
                return f"{part.name} is open for writing"
    except FileNotFoundError:
        return "it changes right now"
    quiet_s = (now_ns - newest_ns) * 1e-9
    return f"it changed {quiet_s:.0f} s ago, {settle_s:.0f} s are waited" if quiet_s < settle_s else None


def _is_being_written(path: Path) -> bool:
    """Whether a process has it open for writing; False too where the system does not tell (files of others, network disks)."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except PermissionError:
        return False
    try:
        fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_RDLCK)
        fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False


def put_away(path: Path, where: str, sha256: str | None, reason: str | None) -> Path:
    """Moves a recording into a folder of its inbox, the reason beside it; returns where it is now.

    A name that `is_safe_name` refuses is replaced by one of its hash.

    Raises StoreError where the disk refuses; the recording is then where it was.
    """
    folder = path.parent / where
    prefix = "" if sha256 is None or path.name.startswith(sha256[:_HASH_SIGNS]) else f"{sha256[:_HASH_SIGNS]}-"
    with disk_errors(f"{path} cannot be moved to {folder}", "check the rights and space of the inbox"):
        make_folder(folder)
        target = _free(folder, prefix + (path.name if is_safe_name(path.name) else _safe_name(path)))
        if reason is not None:
            write_atomically(folder / f"{target.name}{_REASON}", [f"{printable(reason)}\n".encode()])
        os.replace(path, target)  # noqa: PTH105
        sync_folder(folder)
        sync_folder(path.parent)
    return target


def is_safe_name(name: str) -> bool:
    """Whether a name can be shown, logged and kept in the database, and leaves room for what is put before and behind it."""
    return name.isprintable() and len(os.fsencode(name)) <= _MAX_NAME_BYTES


def _safe_name(path: Path) -> str:
    suffix = path.suffix if path.suffix in FILE_SUFFIXES else ""
    return f"unnamed-{hashlib.sha256(os.fsencode(path.name)).hexdigest()[:_HASH_SIGNS]}{suffix}"


def _free(folder: Path, name: str) -> Path:
    """The first name that no recording has yet."""
    names = chain([name], (f"{number}-{name}" for number in count(2)))
    return next(folder / free for free in names if not (folder / free).exists())


def kept(inbox: Path, sha256s: list[str]) -> list[Path]:
    """The recordings of these hashes that are still in the inbox's folder of done ones, in the same order."""
    found: dict[str, Path] = {}
    with suppress(FileNotFoundError):
        for path in sorted((inbox / DONE).iterdir()):
            found.setdefault(path.name[:_HASH_SIGNS], path)
    return [found[sha256[:_HASH_SIGNS]] for sha256 in sha256s if sha256[:_HASH_SIGNS] in found]
