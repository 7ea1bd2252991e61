"""Atomic writes of files, safe against kills and power cuts. Every call goes through `os`, where tests inject failures."""

import os
import secrets
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from fleetmap.errors import disk_errors

OWN_FILE = 0o600  # maps, positions and images are private on a shared machine
TEMPORARY_SUFFIX = ".tmp"
_LEFT_AFTER_S = 86_400.0  # no write takes a day: an older temporary file belongs to a killed process


def write_atomically(path: Path, chunks: Iterable[bytes], mode: int = OWN_FILE) -> None:
    """Write the chunks to the file at `path`, or leave the file as it was.

    Temporary file, fsync, rename, fsync of the folder. An error of the iterable leaves nothing behind either; files that a killed process
    left of the same file are removed after a day.

    Raises OSError if the disk refuses.
    """
    prefix = f".{path.name[:16]}."
    with suppress(OSError):
        for entry in os.scandir(path.parent):
            is_temporary = entry.name.startswith(prefix) and entry.name.endswith(TEMPORARY_SUFFIX)
            if is_temporary and time.time() - entry.stat(follow_symlinks=False).st_mtime > _LEFT_AFTER_S:
                os.unlink(entry.path)  # noqa: PTH108
    temporary = path.with_name(f"{prefix}{secrets.token_hex(8)}{TEMPORARY_SUFFIX}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_EXCL | os.O_CREAT | os.O_CLOEXEC, mode)
    try:
        try:
            for chunk in chunks:
                view = memoryview(chunk)
                while view:
                    view = view[os.write(descriptor, view) :]
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        os.replace(temporary, path)  # noqa: PTH105
    except BaseException:
        with suppress(OSError):
            os.unlink(temporary)  # noqa: PTH108
        raise
    sync_path(path.parent)


def sync_path(path: Path) -> None:
    """Sync the bytes of a file, or the names in a folder, to the disk, so that they survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def appearing_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file that appears at its path when the block succeeds. Raises StoreError if the disk refuses."""
    part = path.with_name(path.name + ".part")
    with disk_errors(f"{part} cannot be written", "choose another place"):
        file = part.open("wb")
    try:
        with file:
            yield file
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
