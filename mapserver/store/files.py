"""Folders, plain files and locks of a store, private to its owner. Every call goes through `os`, where tests inject errors."""

import fcntl
import os
import stat
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from fleetmap.errors import BusyError, StoreError, disk_errors
from fleetmap.files import OWN_FILE, sync_path

_CHUNK_BYTES = 1 << 20
_LOCK_WITHIN_S = 60.0
_OWN_FOLDER = 0o700  # as OWN_FILE
_RESERVE_BYTES = 4 << 20  # enough for a transaction that removes some hundred versions


def read_chunks(path: Path) -> Iterator[bytes]:
    """Yield the bytes of a file in pieces. Raises OSError as `os.read`."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        while chunk := os.read(descriptor, _CHUNK_BYTES):
            yield chunk
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Create `folder` and its parents durably, so that they exist after a power cut.

    The nearest existing parent is synced too: its creator may have died before doing so.
    """
    missing = [folder, *folder.parents]
    missing = missing[: next(i for i, parent in enumerate(missing) if parent.is_dir())]
    for parent in reversed(missing):
        with suppress(FileExistsError):
            os.mkdir(parent, _OWN_FOLDER)  # noqa: PTH102
        sync_path(parent.parent)
    if not missing:
        sync_path(folder.parent)


def check_no_link(root: Path, path: Path) -> None:
    """Raise StoreError if `path`, or a folder between it and `root`, is a symbolic link: a store does not follow links."""
    for part in (path, *path.parents):
        if part == root:
            return
        with disk_errors(f"{part} cannot be looked at", "check the disk"):
            is_link = part.is_symlink()
        if is_link:
            raise StoreError(f"{part} is a symbolic link, which a store does not follow; replace it by its target")


def is_plain_file(path: Path) -> bool:
    """True for a file that is not a link, device or pipe."""
    try:
        return stat.S_ISREG(os.stat(path, follow_symlinks=False).st_mode)  # noqa: PTH116
    except FileNotFoundError:
        return False


def file_mark(path: Path) -> tuple[int, int, int] | None:
    """Return what changes with a file; None if it is missing."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_mtime_ns, status.st_ino, status.st_size


def make_own_file(path: Path) -> None:
    """Create an empty private file, unless it exists."""
    os.close(_open_own(path))


def keep_reserve(root: Path) -> None:
    """Reserve space for `release_reserve`, so that garbage can be collected on a full disk. On a full disk nothing is reserved."""
    with suppress(OSError):
        descriptor = _open_own(root / "reserve")
        try:
            os.posix_fallocate(descriptor, 0, _RESERVE_BYTES)
        finally:
            os.close(descriptor)


def release_reserve(root: Path) -> bool:
    """Free the reserved space; False if there was none."""
    with suppress(OSError):
        os.unlink(root / "reserve")  # noqa: PTH108
        return True
    return False


@contextmanager
def locked(path: Path, *, shared: bool = False, waits: bool = True) -> Iterator[None]:
    """Hold the lock file at `path` during the block: shared or exclusive. The lock of a dead process is released.

    Errors as of `take_lock`, OSError if the file cannot be created.
    """
    descriptor = _open_own(path)
    try:
        kind = fcntl.LOCK_NB | (fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
        take_lock(lambda: fcntl.flock(descriptor, kind), str(path), waits=waits)
        yield
    finally:
        os.close(descriptor)


def take_lock(take: Callable[[], None], name: str, *, waits: bool) -> None:
    """Call `take` until it raises no BlockingIOError. Raises StoreError after a minute, BusyError at once without `waits`."""
    give_up_s = time.monotonic() + _LOCK_WITHIN_S
    while True:
        try:
            return take()
        except BlockingIOError as error:
            if not waits:
                raise BusyError(f"{name} is held by another process; it ends by itself; try later") from error
            if time.monotonic() > give_up_s:
                raise StoreError(f"{name} is held by another process for {_LOCK_WITHIN_S:.0f} s; try later") from error
        time.sleep(0.05)


def _open_own(path: Path) -> int:
    return os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CREAT | os.O_CLOEXEC, OWN_FILE)
