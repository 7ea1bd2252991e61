"""A recording that is uploaded: a hidden file beside the inbox's recordings, which gets its name once all of it is on the disk."""

import fcntl
import os
import secrets
import threading
from contextlib import suppress
from pathlib import Path

from fleetmap.errors import InvalidValueError, StateError, disk_errors
from fleetmap.files import OWN_FILE, sync_path
from mapserver.nightly.inbox import check_upload_name
from mapserver.store.files import make_folder

MOST_BYTES = 64 << 30  # an hour of two cameras
_PART = ".upload.part"
# A build needs space too, about a gigabyte for each ten minutes of two cameras: a tenth of the disk, but no more than that.
_KEPT_SHARE, _KEPT_BYTES = 10, 4 << 30


def remove_unfinished(folder: Path) -> None:
    """Remove what a killed server left of uploads into the inboxes in this folder; those of a living one are locked."""
    for path in folder.glob(f"*/.*{_PART}"):
        with suppress(OSError), os.fdopen(os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


class Upload:
    """Writes one recording. Thread-safe; `end` or `discard` is called in any case. Errors: StateError, InvalidValueError, StoreError."""

    def __init__(self, inbox: Path, name: str, stated_bytes: int | None) -> None:
        """inbox: of the site, made if it is missing. stated_bytes: as the client says, None if it does not."""
        self._lock, self._stated_bytes, self.size_bytes = threading.Lock(), stated_bytes, 0
        self._path = check_upload_name(inbox, name)
        self._words = f"{self._path} cannot be written", "check the rights and space of the inbox"
        # Another server may receive the same recording, from a robot that has changed to it.
        self._part = inbox / f".{name}.{secrets.token_hex(4)}{_PART}"
        self._descriptor: int | None = None
        with disk_errors(*self._words):
            make_folder(inbox)
            self._check_space(stated_bytes or 0)
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
            self._descriptor = os.open(self._part, flags, OWN_FILE)
            with suppress(OSError):  # a network disk without locks
                fcntl.flock(self._descriptor, fcntl.LOCK_EX)

    def write(self, data: bytes) -> None:
        """Append bytes; StateError where the disk would get too full. After an error it is discarded."""
        with self._lock, disk_errors(*self._words):
            if self._descriptor is None:
                return
            self._check_space(len(data))
            view = memoryview(data)
            while view:
                view = view[os.write(self._descriptor, view) :]
            self.size_bytes += len(data)

    def end(self) -> None:
        """Give it its name. InvalidValueError if it is empty or not as long as stated, StateError if there is one of this name now."""
        if self.size_bytes == 0 or self.size_bytes != (self._stated_bytes or self.size_bytes):
            stated = "" if self._stated_bytes is None else f", {self._stated_bytes} were announced"
            raise InvalidValueError(f"{self._path.name} came with {self.size_bytes} bytes{stated}; upload it again")
        with self._lock, disk_errors(*self._words):
            assert self._descriptor is not None
            os.fsync(self._descriptor)
            check_upload_name(self._path.parent, self._path.name)
            os.replace(self._part, self._path)  # noqa: PTH105
            sync_path(self._path.parent)

    def discard(self) -> None:
        """Remove what has not become a recording."""
        with self._lock, suppress(OSError):
            if self._descriptor is not None:
                os.close(self._descriptor)
                self._descriptor = None
            os.unlink(self._part)  # noqa: PTH108

    def _check_space(self, more_bytes: int) -> None:
        disk = os.statvfs(self._path.parent)
        kept = min(disk.f_blocks * disk.f_frsize // _KEPT_SHARE, _KEPT_BYTES)
        left = disk.f_bavail * disk.f_frsize - kept
        if left < more_bytes:
            words = f"the disk has room for {max(0, left) / 1e9:.1f} GB of recordings, beside {kept / 1e9:.1f} GB that builds need"
            raise StateError(
                f"{self._path.name} is too large: {words}; remove old recordings from `done`, or give it a larger disk"
            )
