"""Files that are written whole or not at all, and the folder of them that is addressed by content."""

import os
import secrets
from pathlib import Path

from fleetmap.errors import StoreError
from fleetmap.mapformat import blob_path, sha256_hex, verified


def write_atomically(path: Path, data: bytes) -> None:
    """The file at `path` holds `data` afterwards, or what it held before.

    Temporary file, fsync, rename, fsync of the folder.

    Raises OSError where the disk refuses.
    """
    temporary = path.with_name(f".{path.name[:16]}.{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Makes the names in `folder` survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """`folder` and its parents exist afterwards, also after a power cut."""
    missing = [folder, *folder.parents]
    missing = missing[: next(i for i, parent in enumerate(missing) if parent.is_dir())]
    for parent in reversed(missing):
        parent.mkdir(exist_ok=True)
        sync_folder(parent.parent)


class BlobFolder:
    """Bytes by their SHA-256, in files below the store's folder."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def put(self, data: bytes) -> str:
        """The address of `data`, which is on the disk when this returns. Raises StoreError where the disk refuses."""
        sha256 = sha256_hex(data)
        path = self.path(sha256)
        try:
            # A file of that name may be damaged; comparing it costs less than writing it.
            if not (path.is_file() and path.read_bytes() == data):
                make_folder(path.parent)
                write_atomically(path, data)
        except OSError as error:
            raise StoreError(
                f"{path} cannot be written ({error.strerror}); check the disk's space and rights"
            ) from error
        return sha256

    def get(self, sha256: str) -> bytes:
        """The bytes of an address; raises StoreError for missing ones, MapFormatError for damaged ones."""
        path = self.path(sha256)
        try:
            data = path.read_bytes()
        except OSError as error:
            raise StoreError(
                f"{path} cannot be read ({error.strerror}); the store is incomplete, restore it"
            ) from error
        return verified(data, sha256)

    def path(self, sha256: str) -> Path:
        """The file of an address."""
        return self._root / blob_path(sha256)
