"""The folder into which recordings are copied, and the folders where each goes from there. Nothing is ever deleted.

    INBOX/NAME             a recording: a folder, or a file with a suffix such as .mcap
    INBOX/done/HASH-NAME   it is in a version
    INBOX/held/HASH-NAME   it is sound, but could not be joined, or its draft was refused; move it back to try again
    INBOX/bad/NAME         it cannot be read, or `doctor` says that it should not be used

Beside what is held or bad lies NAME.reason.txt. Strangers fill the inbox: only regular files and folders are opened. Links, FIFOs, sockets
and devices are bad, and so is whatever fails while it is read. One entry never ends the night of the others.
"""

import fcntl
import hashlib
import os
import resource
import signal
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from types import FrameType

from fleetmap.errors import FleetmapError, RecordingError, UsageError, disk_errors
from fleetmap.files import sync_path, write_atomically
from fleetmap.log_lines import printable
from fleetmap.recordings import FILE_SUFFIXES, OpenOptions, open_recording
from mapserver.store.files import make_folder

DONE, HELD, BAD = "done", "held", "bad"
_HASH_SIGNS = 12
_MAX_NAME_BYTES = 200  # of 255: the hash goes before the name, a number too, and `.reason.txt` behind it
_UNFINISHED = (".part", ".partial", ".filepart", ".crdownload", ".tmp")
_REASON = ".reason.txt"
_MOST_ISSUES = 5
_KINDS = {stat.S_IFLNK: "a symbolic link", stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket"}
# Of one recording: an hour of two cameras at 30 Hz are 216,000 files
_MOST_FILES, _DEEPEST = 2_000_000, 32
# Time to read one: so long, and 1 s for each 4 MiB that the disk holds of it, which sparse files do not raise
_READ_S, _SLOWEST_BYTES_PER_S = 600, 4 << 20
_LEAST_MEMORY_BYTES = 4 << 30
_DAY_S = 86_400


@dataclass(frozen=True, slots=True)
class Arrivals:
    """Recordings that are whole, by name; with the reason, those that are not yet, and entries that cannot be one.

    others: names of files that are no recordings. They stay where they are.
    """

    complete: tuple[Path, ...]
    waiting: tuple[tuple[Path, str], ...]
    bad: tuple[tuple[Path, str], ...] = ()
    others: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recording that can be read; found: what its reader missed in it, in words."""

    path: Path
    sha256: str
    found: str = ""

    def why(self, reason: str) -> str:
        """A reason with what the reader found, which is often what is behind it."""
        return f"{reason}; when it was read: {self.found}" if self.found else reason


def arrivals(inbox: Path, settle_s: float, now_ns: int) -> Arrivals:
    """What is in the inbox now. Hidden names are ignored.

    A recording is whole when nothing in it changed for `settle_s`, no file in it bears the name of a half copied one, and
    no process has one open for writing, as far as the system tells. Raises UsageError where there is no such folder.
    """
    if not inbox.is_dir():
        raise UsageError(f"--inbox {inbox} is no folder; create it, or name the one that recordings are copied into")
    with disk_errors(f"--inbox {inbox} cannot be listed", "let this account read and write it", UsageError):
        paths = sorted(inbox.iterdir())
    complete, waiting, bad, others = [], [], [], []
    for path in paths:
        if path.name.startswith(".") or path.name in (DONE, HELD, BAD):
            continue
        try:
            if stat.S_ISREG(path.lstat().st_mode) and path.suffix not in (*_UNFINISHED, *FILE_SUFFIXES, ".zip"):
                others.append(path.name)
            elif reason := _unfinished(path, settle_s, now_ns):
                waiting.append((path, reason))
            else:
                complete.append(path)
        except FileNotFoundError:
            waiting.append((path, "it changes right now"))
        except (OSError, RecordingError) as error:
            bad.append((path, _reason(path, error)))
    return Arrivals(tuple(complete), tuple(waiting), tuple(bad), tuple(others))


def identify(path: Path, options: OpenOptions) -> Recorded | str | None:
    """A recording with its hash, or why it cannot be read; None if it was changed meanwhile. Limits the memory and time that this takes."""
    found: Recorded | str
    before: object = None
    try:
        before, seconds = _state(path)
        with _limited(seconds), open_recording(path, options) as recording:
            issues = "; ".join(f"{issue.what} {issue.detail}".rstrip() for issue in recording.issues[:_MOST_ISSUES])
            found = Recorded(path, recording.content_hash(), issues)
    except _TooSlowError:
        found = f"{path} was not read within {seconds:.0f} s; is it whole? Copy it again"
    except Exception as error:  # whatever a library makes of a stranger's file, the night goes on
        found = _reason(path, error)
    try:
        return found if before is None or _state(path)[0] == before else None
    except FileNotFoundError:
        return None
    except (OSError, RecordingError) as error:
        return _reason(path, error)


def is_openable(path: Path) -> bool:
    """Whether there is nothing but files and folders in it."""
    try:
        return all(True for _ in _parts(path))
    except (OSError, RecordingError):
        return False


def _parts(path: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """An entry and everything in it, links not followed. Raises RecordingError for what is neither file nor folder, OSError."""
    left, number = [(path, 0)], 0
    while left:
        part, depth = left.pop()
        status = part.lstat()
        is_folder = stat.S_ISDIR(status.st_mode)
        if not is_folder and not stat.S_ISREG(status.st_mode):
            kind = _KINDS.get(stat.S_IFMT(status.st_mode), "a device")
            raise RecordingError(f"{part} is {kind}; copy the file itself, only files and folders are read")
        number += 1
        if depth > _DEEPEST or number > _MOST_FILES:
            limit = f"{_DEEPEST} levels of folders" if depth > _DEEPEST else f"{_MOST_FILES} files"
            raise RecordingError(f"{path} has more than {limit}; copy each recording into the inbox by itself")
        yield part, status
        if is_folder:
            with os.scandir(part) as entries:
                left += [(part / entry.name, depth + 1) for entry in entries]


def _state(path: Path) -> tuple[object, float]:
    """Which files an entry has, so that a change is seen, and the seconds that reading it may take."""
    parts = list(_parts(path))
    stored_bytes = sum(512 * status.st_blocks for _, status in parts)
    state = {(part, status.st_ino, status.st_size, status.st_ctime_ns) for part, status in parts}
    return state, _READ_S + stored_bytes / _SLOWEST_BYTES_PER_S


def _reason(path: Path, error: Exception) -> str:
    if isinstance(error, FleetmapError):
        return str(error)
    if isinstance(error, MemoryError):
        return (
            f"{path} takes more than {_most_memory_bytes() >> 20} MiB of memory to read; is it damaged? Copy it again"
        )
    if isinstance(error, OSError):
        named = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else path
        return f"{named} cannot be read ({error.strerror or error}); let this account read it, or copy it again"
    return f"{path} cannot be read ({type(error).__name__}: {str(error)[:200]}); try `mapserver doctor {path}`"


class _TooSlowError(BaseException):
    """Time is up. Code that catches every Exception must not catch it."""


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Limits the block's memory (MemoryError), and in the main thread its time (_TooSlowError)."""

    def interrupt(_: int, __: FrameType | None) -> None:
        raise _TooSlowError

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    held_bytes = int(Path("/proc/self/statm").read_bytes().split()[0]) * resource.getpagesize()
    limits = [limit for limit in (held_bytes + _most_memory_bytes(), soft) if limit != resource.RLIM_INFINITY]
    is_main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGALRM, interrupt) if is_main else None
    resource.setrlimit(resource.RLIMIT_AS, (min(limits), hard))
    try:
        if is_main:
            signal.setitimer(signal.ITIMER_REAL, seconds)
        yield
    finally:
        if is_main:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def _most_memory_bytes() -> int:
    machine_bytes = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return max(_LEAST_MEMORY_BYTES, machine_bytes // 2)


def _unfinished(path: Path, settle_s: float, now_ns: int) -> str | None:
    """Why a recording is not whole yet; None if it is. Raises as `_parts`."""
    newest_ns, reason = 0, None
    for part, status in _parts(path):
        # Not mtime: copying tools set it back. Nobody can set this one.
        newest_ns = max(newest_ns, status.st_ctime_ns)
        if reason is None and part.suffix in _UNFINISHED:
            reason = f"{part.name} is half copied"
        if reason is None and stat.S_ISREG(status.st_mode) and _is_being_written(part):
            reason = f"{part.name} is open for writing"
    quiet_s = abs(now_ns - newest_ns) * 1e-9  # a change in the future was made before the clock was set back
    if reason is not None:
        return reason if quiet_s < _DAY_S else f"{reason} and has not changed for {quiet_s / _DAY_S:.0f} days"
    return f"it changed {quiet_s:.0f} s ago, {settle_s:.0f} s are waited" if quiet_s < settle_s else None


def _is_being_written(path: Path) -> bool:
    """Whether a process has it open for writing; False too where the system does not tell (files of others, network disks)."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
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
        reason_file = folder / f"{target.name}{_REASON}"
        if reason is not None:
            write_atomically(reason_file, [f"{printable(reason)}\n".encode()])
        try:
            os.replace(path, target)  # noqa: PTH105
        except OSError:
            reason_file.unlink(missing_ok=True)
            raise
        sync_path(folder)
        sync_path(path.parent)
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
    return next(folder / free for free in names if not os.path.lexists(folder / free))


def kept(inbox: Path, sha256s: list[str]) -> list[Path]:
    """The recordings of these hashes that are still in the inbox, in the same order: done, or held and then published by a person."""
    found: dict[str, Path] = {}
    for where in (DONE, HELD):
        with suppress(FileNotFoundError):
            for path in sorted((inbox / where).iterdir()):
                if not path.name.endswith(_REASON) and is_openable(path):
                    found.setdefault(path.name[:_HASH_SIGNS], path)
    return [found[sha256[:_HASH_SIGNS]] for sha256 in sha256s if sha256[:_HASH_SIGNS] in found]
