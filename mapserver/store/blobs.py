"""The folder of content-addressed files."""

import errno
import hashlib
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from fleetmap.errors import MapFormatError, StoreError, disk_errors
from fleetmap.files import TEMPORARY_SUFFIX, sync_path, write_atomically
from fleetmap.mapformat import blob_path, sha256_hex, verified
from mapserver.store.files import check_no_link, is_plain_file, make_folder, read_chunks

_FOLDER = "blobs"


class BlobFolder:
    """Bytes by their SHA-256, in files below the store's folder. Symbolic links there are not followed."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def put(self, data: bytes) -> str:
        """Store `data` and return its address; it is on the disk when this returns. Raises StoreError on a disk error."""
        sha256 = sha256_hex(data)
        self._keep(sha256, len(data), [data])
        return sha256

    def put_chunks(self, chunks: Iterable[bytes], sha256: str, size_bytes: int) -> None:
        """As `put`, for bytes in pieces that must be `size_bytes` with this address.

        Raises MapFormatError for other bytes, StoreError on a disk error.
        """
        self._keep(sha256, size_bytes, _checked(chunks, sha256, size_bytes))

    def get(self, sha256: str) -> bytes:
        """Return the bytes of an address; raises StoreError for missing ones, MapFormatError for damaged ones."""
        return verified(b"".join(self.chunks(sha256)), sha256)

    def chunks(self, sha256: str) -> Iterator[bytes]:
        """Yield the bytes of an address in pieces, unverified; raises StoreError for missing ones."""
        path = self.path(sha256)
        with disk_errors(f"{path} cannot be read", "the store is incomplete, restore it"):
            self._check_plain(path)
            yield from read_chunks(path)

    def is_whole(self, sha256: str) -> bool:
        """True if the bytes of an address exist and match it; reads them in pieces."""
        digest = hashlib.sha256()
        try:
            self._check_plain(self.path(sha256))
            for chunk in read_chunks(self.path(sha256)):
                digest.update(chunk)
        except (OSError, StoreError):
            return False
        return digest.hexdigest() == sha256

    def path(self, sha256: str) -> Path:
        return self._root / blob_path(sha256)

    def addresses(self) -> set[str]:
        return {path.name for path in self._files() if _is_address(path)}

    def unreferenced(self) -> list[Path]:
        """Return files that are not blobs, such as remains of a killed process."""
        return sorted(path for path in self._files() if not _is_address(path))

    def total_bytes(self) -> int:
        """Return the size of all files; one that is removed meanwhile counts nothing."""
        found = 0
        for path in self._files():
            with suppress(FileNotFoundError):
                found += path.stat().st_size
        return found

    def remove_file(self, path: Path) -> int:
        """Remove a file and return its size; raises StoreError on a disk error."""
        with disk_errors(f"{path} cannot be removed", "check the folder's rights"):
            check_no_link(self._root, path.parent)
            size = path.stat().st_size
            os.unlink(path)  # noqa: PTH108
        return size

    def _keep(self, sha256: str, size_bytes: int, chunks: Iterable[bytes]) -> None:
        path = self.path(sha256)
        with disk_errors(f"{path} cannot be written", "check the disk's space and rights"):
            check_no_link(self._root, path.parent)
            # A file of that name may be damaged; reading it costs less than writing it.
            if is_plain_file(path) and path.stat().st_size == size_bytes and self.is_whole(sha256):
                # Its writer may have died before its name was on the disk.
                sync_path(path.parent)
                chunks = ()
            make_folder(path.parent)
            make_folder(path.parent.parent)
            if chunks:
                write_atomically(path, chunks)

    def links(self) -> list[Path]:
        folder = self._root / _FOLDER
        candidates = [folder] if folder.is_symlink() else [*folder.glob("*"), *self._inner(os.DirEntry.is_symlink)]
        return sorted(path for path in candidates if path.is_symlink())

    def _files(self) -> Iterator[Path]:
        return self._inner(lambda entry: entry.is_file(follow_symlinks=False))

    def _inner(self, wanted: "Callable[[os.DirEntry[str]], bool]") -> Iterator[Path]:
        """Yield the entries of the folder's subfolders, without links."""
        top = self._root / _FOLDER
        if top.is_symlink() or not top.is_dir():
            return
        for folder in os.scandir(top):
            if folder.is_dir(follow_symlinks=False):
                yield from (Path(entry.path) for entry in os.scandir(folder.path) if wanted(entry))

    def _check_plain(self, path: Path) -> None:
        check_no_link(self._root, path)
        if not is_plain_file(path):
            raise FileNotFoundError(errno.ENOENT, "not a plain file", str(path))


def _is_address(path: Path) -> bool:
    return len(path.name) == 64 and not path.name.endswith(TEMPORARY_SUFFIX) and path.name[:2] == path.parent.name


def _checked(chunks: Iterable[bytes], sha256: str, size_bytes: int) -> Iterator[bytes]:
    digest, size = hashlib.sha256(), 0
    for chunk in chunks:
        digest.update(chunk)
        size += len(chunk)
        yield chunk
    if size != size_bytes or digest.hexdigest() != sha256:
        raise MapFormatError(f"{size} bytes that should be {size_bytes} with SHA-256 {sha256}; they were damaged")
