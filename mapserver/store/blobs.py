"""Content-addressed bytes: in files of the store's folder, or in an object store."""

import errno
import hashlib
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import ClassVar

from fleetmap.errors import MapFormatError, StoreError, disk_errors
from fleetmap.files import TEMPORARY_SUFFIX, sync_path, write_atomically
from fleetmap.mapformat import blob_path, sha256_hex, verified
from mapserver.store.files import check_no_link, is_plain_file, make_folder, read_chunks

_FOLDER = "blobs"


class Blobs(ABC):
    """Bytes by their SHA-256. is_folder: True if robots may read them as files beside the store's database."""

    is_folder: ClassVar[bool]

    def put(self, data: bytes) -> str:
        """Store `data` and return its address; it is durable when this returns. Raises StoreError if disk or object store refuse."""
        sha256 = sha256_hex(data)
        self._keep(sha256, len(data), [data])
        return sha256

    def put_chunks(self, chunks: Iterable[bytes], sha256: str, size_bytes: int) -> None:
        """As `put`, for bytes in pieces that must be `size_bytes` with this address. Raises MapFormatError for other bytes."""
        self._keep(sha256, size_bytes, _checked(chunks, sha256, size_bytes))

    def get(self, sha256: str) -> bytes:
        """Return the bytes of an address; raises StoreError for missing ones, MapFormatError for damaged ones."""
        return verified(b"".join(self.chunks(sha256)), sha256)

    def total_bytes(self) -> int:
        return sum(self.sizes().values()) + sum(self.leftovers().values())

    @abstractmethod
    def is_whole(self, sha256: str) -> bool:
        """True if the bytes of an address exist and match it; reads them in pieces."""

    @abstractmethod
    def where(self, sha256: str) -> str:
        """Return the place of an address, for messages."""

    @abstractmethod
    def chunks(self, sha256: str) -> Iterator[bytes]:
        """Yield the bytes of an address in pieces, unverified; raises StoreError for missing ones."""

    @abstractmethod
    def size(self, sha256: str) -> int | None:
        """Return the size in bytes of an address, None if missing; raises StoreError behind a symbolic link."""

    @abstractmethod
    def sizes(self) -> dict[str, int]:
        """Return the sizes in bytes of all addresses."""

    @abstractmethod
    def remove(self, sha256: str) -> None:
        """Remove the bytes of an address; raises StoreError if disk or object store refuse."""

    @abstractmethod
    def leftovers(self) -> dict[str, int]:
        """Return names and sizes in bytes of what is not a blob, such as remains of a killed process."""

    @abstractmethod
    def remove_leftover(self, name: str) -> None: ...

    @abstractmethod
    def links(self) -> list[str]:
        """Return symbolic links, which are not followed."""

    def _matches(self, sha256: str) -> bool:
        digest = hashlib.sha256()
        for chunk in self.chunks(sha256):
            digest.update(chunk)
        return digest.hexdigest() == sha256

    @abstractmethod
    def _keep(self, sha256: str, size_bytes: int, chunks: Iterable[bytes]) -> None: ...


class BlobFolder(Blobs):
    """Files below the store's folder. Symbolic links there are not followed."""

    is_folder = True

    def __init__(self, root: Path) -> None:
        self._root = root

    def where(self, sha256: str) -> str:
        return str(self._path(sha256))

    def chunks(self, sha256: str) -> Iterator[bytes]:
        path = self._path(sha256)
        with disk_errors(f"{path} cannot be read", "the store is incomplete, restore it"):
            check_no_link(self._root, path)
            if not is_plain_file(path):
                raise FileNotFoundError(errno.ENOENT, "not a plain file", str(path))
            yield from read_chunks(path)

    def size(self, sha256: str) -> int | None:
        path = self._path(sha256)
        check_no_link(self._root, path)
        return path.stat().st_size if path.is_file() else None

    def is_whole(self, sha256: str) -> bool:
        try:
            return self._matches(sha256)
        except StoreError:  # a link, or a disk that cannot read it
            return False

    def sizes(self) -> dict[str, int]:
        return {path.name: size for path, size in self._files() if _is_address(path)}

    def remove(self, sha256: str) -> None:
        self._remove(self._path(sha256))

    def leftovers(self) -> dict[str, int]:
        return dict(sorted((str(path), size) for path, size in self._files() if not _is_address(path)))

    def remove_leftover(self, name: str) -> None:
        self._remove(Path(name))

    def links(self) -> list[str]:
        folder = self._root / _FOLDER
        candidates = [folder] if folder.is_symlink() else [*folder.glob("*"), *self._inner(os.DirEntry.is_symlink)]
        return sorted(str(path) for path in candidates if path.is_symlink())

    def _path(self, sha256: str) -> Path:
        return self._root / blob_path(sha256)

    def _remove(self, path: Path) -> None:
        with disk_errors(f"{path} cannot be removed", "check the folder's rights"):
            check_no_link(self._root, path.parent)
            os.unlink(path)  # noqa: PTH108

    def _keep(self, sha256: str, size_bytes: int, chunks: Iterable[bytes]) -> None:
        path = self._path(sha256)
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

    def _files(self) -> Iterator[tuple[Path, int]]:
        """Yield files with their sizes; one that is removed meanwhile is left out."""
        for path in self._inner(lambda entry: entry.is_file(follow_symlinks=False)):
            with suppress(FileNotFoundError):
                yield path, path.stat().st_size

    def _inner(self, wanted: "Callable[[os.DirEntry[str]], bool]") -> Iterator[Path]:
        """Yield the entries of the folder's subfolders, without links."""
        top = self._root / _FOLDER
        if top.is_symlink() or not top.is_dir():
            return
        for folder in os.scandir(top):
            if folder.is_dir(follow_symlinks=False):
                yield from (Path(entry.path) for entry in os.scandir(folder.path) if wanted(entry))


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
