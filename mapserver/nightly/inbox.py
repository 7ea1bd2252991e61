"""The folder for incoming recordings, and the folders to which each is moved. Only `remove_old` deletes.

    INBOX/NAME             a recording: a folder, or a file with a suffix such as .mcap
    INBOX/done/HASH-NAME   it is in a version
    INBOX/held/HASH-NAME   it is valid, but could not be joined, or its draft was refused; move it back to try again
    INBOX/bad/NAME         it cannot be read, or `doctor` fails it

Beside a held or bad recording lies NAME.reason.txt. The inbox is untrusted: only regular files and folders are opened. Links, FIFOs,
sockets and devices are bad, as is any entry with a read error. One entry never stops the processing of the others.
"""

import fcntl
import hashlib
import os
import resource
import shutil
import signal
import stat
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import NamedTuple

from fleetmap import errors
from fleetmap.errors import FleetmapError, RecordingError, StateError, StoreError, UsageError, disk_errors
from fleetmap.files import sync_path, write_atomically
from fleetmap.log_lines import printable
from fleetmap.mapformat.names import is_name
from fleetmap.recordings import file_suffixes
from mapserver.store import FleetRetention, MapStore
from mapserver.store.files import check_no_link, make_folder

DONE, HELD, BAD = "done", "held", "bad"
HASH_SIGNS = 12
_MAX_NAME_BYTES = 220  # of 255: room for `.reason.txt` after it
_UPLOAD_NAME_BYTES = 200  # room for the hash and a number before it
_UNFINISHED = (".part", ".partial", ".filepart", ".crdownload", ".tmp")
_REASON = ".reason.txt"
_REASON_BYTES = 2000
_MOST_LISTED = 1000
_KINDS = {stat.S_IFLNK: "a symbolic link", stat.S_IFIFO: "a FIFO", stat.S_IFSOCK: "a socket"}
# Limit of one recording: an hour of two cameras at 30 Hz has 216,000 files
_MOST_FILES, _DEEPEST = 2_000_000, 32
_DAY_S = 86_400
_FOR_READING = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK


class Arrivals(NamedTuple):
    """Complete recordings, by name; with the reason, incomplete ones, and entries that cannot be recordings.

    others: names of files that are not recordings. They stay in place.
    """

    complete: tuple[Path, ...]
    waiting: tuple[tuple[Path, str], ...]
    bad: tuple[tuple[Path, str], ...] = ()
    others: tuple[str, ...] = ()


def arrivals(inbox: Path, settle_s: float, now_ns: int, *, is_brief: bool = False) -> Arrivals:
    """Return the present contents of the inbox. Hidden names are ignored.

    A recording is complete if nothing in it changed for `settle_s`, no file in it has the name of a partial copy, and
    no process has one open for writing, as far as the system shows. Raises UsageError if the folder is missing.

    is_brief: count every folder as complete. An hour in one has 200,000 files.
    """
    if not inbox.is_dir():
        raise UsageError(f"--inbox {inbox} is not a folder; create it, or name the folder of incoming recordings")
    with disk_errors(f"--inbox {inbox} cannot be listed", "give this account read and write access", UsageError):
        paths = sorted(inbox.iterdir())
    complete, waiting, bad, others = [], [], [], []
    for path in paths:
        if path.name.startswith(".") or path.name in (DONE, HELD, BAD):
            continue
        try:
            if stat.S_ISREG(path.lstat().st_mode) and path.suffix not in (*_UNFINISHED, *file_suffixes(), ".zip"):
                others.append(path.name)
            elif is_brief and path.is_dir() and not path.is_symlink():
                complete.append(path)
            elif reason := _unfinished(path, settle_s, now_ns):
                waiting.append((path, reason))
            else:
                complete.append(path)
        except FileNotFoundError:
            waiting.append((path, "it changes right now"))
        except (OSError, RecordingError) as error:
            bad.append((path, why_unreadable(path, error)))
    return Arrivals(tuple(complete), tuple(waiting), tuple(bad), tuple(others))


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


def parts(path: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Yield an entry and all of its contents, links not followed. Raises RecordingError for other than files and folders, OSError."""
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


def _unfinished(path: Path, settle_s: float, now_ns: int) -> str | None:
    """Return why a recording is incomplete; None if it is complete. Raises as `parts`."""
    newest_ns, reason = 0, None
    for part, status in parts(path):
        # Not mtime, which copying tools set back: ctime cannot be set.
        newest_ns = max(newest_ns, status.st_ctime_ns)
        if reason is None and part.suffix in _UNFINISHED:
            reason = f"{part.name} is half copied"
        if reason is None and stat.S_ISREG(status.st_mode) and _is_being_written(part):
            reason = f"{part.name} is open for writing"
    quiet_s = abs(now_ns - newest_ns) * 1e-9  # a change in the future precedes a clock that was set back
    if reason is not None:
        return reason if quiet_s < _DAY_S else f"{reason} and has not changed for {quiet_s / _DAY_S:.0f} days"
    return f"it changed {quiet_s:.0f} s ago, {settle_s:.0f} s are waited" if quiet_s < settle_s else None


def _is_being_written(path: Path) -> bool:
    """True if a process has it open for writing; False also if the system does not show it (other users' files, network disks)."""
    try:
        descriptor = os.open(path, _FOR_READING)
    except PermissionError:
        return False
    try:
        fcntl.fcntl(descriptor, fcntl.F_SETSIG, signal.SIGURG)  # not SIGIO, which ends a process, if it is opened now
        fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_RDLCK)
        fcntl.fcntl(descriptor, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    except OSError as error:
        return isinstance(error, BlockingIOError)
    finally:
        os.close(descriptor)
    return False


def put_away(path: Path, where: str, sha256: str | None, reason: str | None) -> Path:
    """Move a recording into a folder of its inbox, with the reason beside it; return its new path.

    A name that `is_safe_name` refuses, then also with a number before it, is replaced by one of its hash.

    Raises StoreError if the disk refuses; the recording then stays in place.
    """
    folder = path.parent / where
    prefix = "" if sha256 is None or path.name.startswith(sha256[:HASH_SIGNS]) else f"{sha256[:HASH_SIGNS]}-"
    name = f"{prefix}{path.name}"
    if not is_safe_name(f"99-{name}"):
        digest = hashlib.sha256(os.fsencode(path.name)).hexdigest()[:HASH_SIGNS]
        name = f"{prefix}unnamed-{digest}{path.suffix if path.suffix in file_suffixes() else ''}"
    check_no_link(path.parent, folder)
    with disk_errors(f"{path} cannot be moved to {folder}", "check the rights and space of the inbox"):
        make_folder(folder)
        names = chain([name], (f"{number}-{name}" for number in count(2)))
        target = next(folder / free for free in names if not os.path.lexists(folder / free))
        reason_file = Path(f"{target}{_REASON}")
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


@dataclass(frozen=True, slots=True)
class InboxEntry:
    """An entry of an inbox. size_bytes: of a file; reason: why it waits, is held or is bad; empty if the next night takes it.

    since_ns: when the reason was written, without one the entry's last change, nanoseconds since 1970; 0 if it is gone.
    """

    name: str
    size_bytes: int | None
    reason: str
    since_ns: int


@dataclass(frozen=True, slots=True)
class Inbox:
    """Recordings in the inbox of a site, at most 1000 of each kind; done: number of those in a version."""

    site: str
    waiting: list[InboxEntry]
    held: list[InboxEntry]
    bad: list[InboxEntry]
    done: int


def sites_of(folder: Path) -> list[str]:
    """Return the sites that have an inbox in this folder."""
    with suppress(OSError):
        return sorted(path.name for path in folder.iterdir() if is_name(path.name) and path.is_dir())
    return []


def contents(inbox: Path, settle_s: float, now_ns: int) -> Inbox:
    """Return what lies in an inbox, empty if it is missing, without a look into folders; names that cannot be shown are left out.

    Raises UsageError if it cannot be listed.
    """
    if not inbox.is_dir():
        return Inbox(inbox.name, [], [], [], 0)
    here = arrivals(inbox, settle_s, now_ns, is_brief=True)
    known = f"no recording; a recording is a folder, or a file that ends in {', '.join(file_suffixes())}"
    reasons = {path.name: "" for path in here.complete} | dict.fromkeys(here.others, known)
    reasons |= {path.name: reason for path, reason in (*here.waiting, *here.bad)}
    waiting = [_entry(inbox / name, reasons[name]) for name in sorted(reasons) if is_safe_name(name)]
    kept: dict[str, list[InboxEntry]] = {HELD: [], BAD: []}
    for where, entries in kept.items():
        for name in names(inbox / where)[:_MOST_LISTED]:
            path, reason, since_ns = inbox / where / name, "", 0
            with suppress(OSError), os.fdopen(os.open(f"{path}{_REASON}", _FOR_READING), "rb") as file:
                reason = (file.read(_REASON_BYTES) or b"").decode("utf-8", "replace").strip()
                since_ns = os.fstat(file.fileno()).st_mtime_ns
            entries.append(_entry(path, reason.replace(f"{inbox}/", ""), since_ns))
    return Inbox(inbox.name, waiting[:_MOST_LISTED], kept[HELD], kept[BAD], len(names(inbox / DONE)))


def names(folder: Path) -> list[str]:
    """Return the names of recordings that were put away; none of a folder that is a link."""
    with suppress(FileNotFoundError, StoreError):
        check_no_link(folder.parent, folder)
        return sorted(name for name in os.listdir(folder) if not name.endswith(_REASON) and is_safe_name(name))  # noqa: PTH208
    return []


def _entry(path: Path, reason: str, since_ns: int = 0) -> InboxEntry:
    size_bytes = None
    with suppress(OSError):
        status = path.lstat()
        size_bytes = status.st_size if stat.S_ISREG(status.st_mode) else None
        since_ns = since_ns or status.st_ctime_ns
    return InboxEntry(path.name, size_bytes, printable(reason), since_ns)


def put_back(inbox: Path, where: str, name: str) -> None:
    """Move a held or bad recording back into its inbox, for the next night, and remove its reason.

    Raises UsageError for an unknown one, StateError if the inbox has one of this name, StoreError if the disk refuses.
    """
    path, target = inbox / where / name, inbox / name
    check_no_link(inbox, path.parent)
    if not is_safe_name(name) or not os.path.lexists(path) or name.endswith(_REASON):
        raise UsageError(f"{where} has no recording {printable(name)[:80]!r}; it may be back in the inbox already")
    if os.path.lexists(target):
        raise StateError(f"the inbox has another {name}; wait for the next night, or rename one of them")
    with disk_errors(f"{path} cannot be moved to {inbox}", "check the rights of the inbox"):
        os.replace(path, target)  # noqa: PTH105
        Path(f"{path}{_REASON}").unlink(missing_ok=True)
        sync_path(inbox)


def check_upload_name(inbox: Path, name: str) -> Path:
    """Return where an uploaded recording belongs. Raises InvalidValueError for an invalid name, StateError for one that exists."""
    path = inbox / name
    is_short, suffixes = is_safe_name(name) and len(os.fsencode(name)) <= _UPLOAD_NAME_BYTES, file_suffixes()
    if not is_short or path.suffix not in suffixes:
        known = f"{', '.join(suffixes[:-1])} or {suffixes[-1]}"
        words = f"{printable(name)[:80]!r} is an invalid name of a recording; use at most {_UPLOAD_NAME_BYTES} bytes that end in {known}"
        raise errors.InvalidValueError(f"{words} (`mapserver convert FOLDER OUT.mcap` makes one of a folder)")
    if os.path.lexists(path):
        raise StateError(f"the inbox has a recording {name} already; rename one of them")
    return path


def is_safe_name(name: str) -> bool:
    """True if a name can be displayed, logged and stored, is not hidden, and leaves room for prefix and suffix."""
    is_plain = name.isprintable() and "/" not in name and not name.startswith(".")
    return is_plain and 0 < len(os.fsencode(name)) <= _MAX_NAME_BYTES


def remove_old(inbox: Path, days: float, now_ns: int, *, dry_run: bool = False) -> int:
    """Remove recordings that were put away longer ago, with their reasons, and return their number. StoreError if the disk refuses.

    Those that wait for a night stay. Their age counts from the last change of their entry, which no tool sets back.
    """
    found = 0
    for folder in (inbox / where for where in (DONE, HELD, BAD)):
        with disk_errors(f"old recordings of {folder} cannot be removed", "check the rights of the inbox"):
            for path in sorted(folder.iterdir()) if folder.is_dir() and not folder.is_symlink() else []:
                with suppress(FileNotFoundError):  # removed by somebody else meanwhile
                    if path.name.endswith(_REASON) or path.lstat().st_ctime_ns >= now_ns - days * _DAY_S * 1e9:
                        continue
                    if not dry_run:
                        path.unlink() if not path.is_dir() or path.is_symlink() else shutil.rmtree(path)
                        Path(f"{path}{_REASON}").unlink(missing_ok=True)
                    found += 1
    return found


def apply_retention(
    maps: MapStore, retention: FleetRetention, inboxes: Iterable[Path], *, dry_run: bool = False
) -> dict[str, int]:
    """Remove what is older than its period; return by name how much that is. StoreError on a disk error.

    dry_run: remove nothing.
    """
    removed = maps.fleet.expired(retention)
    if not dry_run:
        maps.fleet.prune(retention)
    removed["pictures of surveys"] = maps.remove_survey_pictures(retention.survey_picture_days, dry_run=dry_run)
    days, now_ns = retention.recording_days, maps.now_ns()
    removed["recordings of surveys"] = sum(remove_old(inbox, days, now_ns, dry_run=dry_run) for inbox in inboxes)
    return removed
