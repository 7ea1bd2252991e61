"""Folders, plain files and locks of a store, for its owner alone. Every call goes through `os`, where tests make it fail."""

import fcntl
import os
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from fleetmap.errors import StoreError, disk_errors
from fleetmap.files import OWN_FILE, sync_path

_CHUNK_BYTES = 1 << 20
_LOCK_WITHIN_S = 60.0
_OWN_FOLDER = 0o700  # as OWN_FILE
_RESERVE_BYTES = 4 << 20  # what a transaction that removes some hundred versions writes


def read_chunks(path: Path) -> Iterator[bytes]:
    """The bytes of a file, a piece at a time. Raises OSError as `os.read`."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        while chunk := os.read(descriptor, _CHUNK_BYTES):
            yield chunk
    finally:
        os.close(descriptor)


def read_file(path: Path) -> bytes:
    """All bytes of a file. Raises OSError as `os.read`."""
    return b"".join(read_chunks(path))


def make_folder(folder: Path) -> None:
    """`folder` and its parents exist afterwards, also after a power cut.

    The nearest parent that was there is synced too: who made it may have died before doing so.
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
    """Raises StoreError where `path`, or a folder between it and `root`, is a symbolic link: a store follows none out of its folder."""
    for part in (path, *path.parents):
        if part == root:
            return
        with disk_errors(f"{part} cannot be looked at", "check the disk"):
            is_link = part.is_symlink()
        if is_link:
            raise StoreError(
                f"{part} is a symbolic link, which a store does not follow; put what it names in its place"
            )


def is_plain_file(path: Path) -> bool:
    """Whether it is a file, and no link, device or pipe."""
    try:
        return stat.S_ISREG(os.stat(path, follow_symlinks=False).st_mode)  # noqa: PTH116
    except FileNotFoundError:
        return False


def make_own_file(path: Path) -> None:
    """An empty file for its owner alone, unless there is one."""
    os.close(_open_own(path, os.O_RDWR))


def keep_reserve(root: Path) -> None:
    """Space that `release_reserve` gives back on a full disk, so that garbage can be collected there. A full disk has none to keep."""
    with suppress(OSError):
        descriptor = _open_own(root / "reserve", os.O_RDWR | os.O_NOFOLLOW)
        try:
            os.posix_fallocate(descriptor, 0, _RESERVE_BYTES)
        finally:
            os.close(descriptor)


def release_reserve(root: Path) -> bool:
    """Gives the reserved space back; False where there was none."""
    try:
        os.unlink(root / "reserve")  # noqa: PTH108
    except OSError:
        return False
    return True


@contextmanager
def locked(path: Path, *, shared: bool) -> Iterator[None]:
    """Holds the lock file at `path` during the block: by many if shared, else alone. A dead process holds nothing.

    Raises StoreError when the lock is not free within a minute, OSError where the file cannot be made.
    """
    descriptor = _open_own(path, os.O_RDWR | os.O_NOFOLLOW)
    try:
        _take_lock(descriptor, fcntl.LOCK_SH if shared else fcntl.LOCK_EX, path)
        yield
    finally:
        os.close(descriptor)


def _open_own(path: Path, flags: int) -> int:
    return os.open(path, flags | os.O_CREAT | os.O_CLOEXEC, OWN_FILE)


def _take_lock(descriptor: int, kind: int, path: Path) -> None:
    give_up_s = time.monotonic() + _LOCK_WITHIN_S
    while True:
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() > give_up_s:
                raise StoreError(f"{path} is held by another process for {_LOCK_WITHIN_S:.0f} s; try later") from error
            time.sleep(0.05)
        else:
            return
