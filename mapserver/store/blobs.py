"""Bytes in a folder or, by a plug-in, under a URL; and content-addressed bytes in either."""

import hashlib
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import ClassVar

from fleetmap.errors import MapFormatError, StoreError, disk_errors
from fleetmap.files import sync_path, write_atomically
from fleetmap.mapformat.names import sha256_hex, verified
from mapserver.store.files import check_no_link, is_plain_file, make_folder, read_chunks

Listed = tuple[str, int, int]
"""Path, bytes, time of the last change in ns since 1970."""


class Objects(ABC):
    """Bytes by relative path. Raises StoreError if disk or object store refuse, or for a missing path.

    is_folder: True if others may read them as files below the store's folder. place: the folder or URL.
    """

    is_folder: ClassVar[bool]
    place: str

    @abstractmethod
    def put(self, path: str, chunks: Iterable[bytes], *, is_new: bool = False) -> None:
        """Write all of it or nothing; it is durable when this returns. is_new: StoreError if the path is there."""

    @abstractmethod
    def chunks(self, path: str) -> Iterator[bytes]: ...

    @abstractmethod
    def size(self, path: str) -> int | None:
        """Return the number of bytes, None if missing; StoreError behind a symbolic link."""

    @abstractmethod
    def listed(self, prefix: str) -> Iterator[Listed]: ...

    @abstractmethod
    def remove(self, path: str) -> None: ...

    def settle(self, path: str) -> None:
        """Make durable what another process wrote, which may have died before its name was on the disk."""
        return

    def links(self, prefix: str) -> list[str]:
        """Return symbolic links, which are not followed."""
        return []


class FolderObjects(Objects):
    """Files below a folder. Every call goes through `os`, where tests inject errors."""

    is_folder = True

    def __init__(self, root: Path) -> None:
        self._root, self.place = root, str(root)

    def put(self, path: str, chunks: Iterable[bytes], *, is_new: bool = False) -> None:
        file = self._root / path
        with disk_errors(f"{file} cannot be written", "check the disk's space and rights"):
            check_no_link(self._root, file.parent)
            make_folder(file.parent)
            make_folder(file.parent.parent)
            if is_new:
                os.close(os.open(file, os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
            write_atomically(file, chunks)

    def chunks(self, path: str) -> Iterator[bytes]:
        file = self._root / path
        with disk_errors(f"{file} cannot be read", "the store is incomplete, restore it"):
            check_no_link(self._root, file)
            if not is_plain_file(file):
                raise FileNotFoundError(2, "not a plain file", str(file))
            yield from read_chunks(file)

    def size(self, path: str) -> int | None:
        check_no_link(self._root, self._root / path)
        file = self._root / path
        return file.stat().st_size if file.is_file() else None

    def listed(self, prefix: str) -> Iterator[Listed]:
        for entry in self._entries(prefix):
            with suppress(FileNotFoundError):  # removed meanwhile
                if entry.is_file(follow_symlinks=False):
                    status = entry.stat(follow_symlinks=False)
                    yield os.path.relpath(entry.path, self._root), status.st_size, status.st_mtime_ns

    def remove(self, path: str) -> None:
        file = self._root / path
        with disk_errors(f"{file} cannot be removed", "check the folder's rights"):
            check_no_link(self._root, file.parent)
            os.unlink(file)  # noqa: PTH108

    def settle(self, path: str) -> None:
        file = self._root / path
        with disk_errors(f"{file} cannot be written", "check the disk's space and rights"):
            sync_path(file.parent)
            make_folder(file.parent)
            make_folder(file.parent.parent)

    def links(self, prefix: str) -> list[str]:
        top = self._root / prefix
        return [str(top)] if top.is_symlink() else sorted(e.path for e in self._entries(prefix) if e.is_symlink())

    def _entries(self, prefix: str) -> "Iterator[os.DirEntry[str]]":
        folders = [self._root / prefix]
        while folders:
            folder = folders.pop()
            for entry in os.scandir(folder) if folder.is_dir() and not folder.is_symlink() else ():
                yield entry
                if entry.is_dir(follow_symlinks=False):
                    folders.append(Path(entry.path))


class Blobs:
    """Bytes by their SHA-256. Raises StoreError if disk or object store refuse, or for missing ones."""

    def __init__(self, objects: Objects, prefix: str = "blobs") -> None:
        self._objects, self._prefix, self.is_folder = objects, prefix, objects.is_folder

    def put(self, data: bytes) -> str:
        """Store `data` and return its address; it is durable when this returns."""
        sha256 = sha256_hex(data)
        self._keep(sha256, len(data), [data])
        return sha256

    def put_chunks(self, chunks: Iterable[bytes], sha256: str, size_bytes: int) -> None:
        """As `put`, for bytes in pieces that must be `size_bytes` with this address. Raises MapFormatError for other bytes."""
        self._keep(sha256, size_bytes, _checked(chunks, sha256, size_bytes))

    def get(self, sha256: str, most_bytes: int | None = None) -> bytes:
        """Return the bytes of an address; MapFormatError for damaged ones, or more than most_bytes."""
        if most_bytes is not None and (self.size(sha256) or 0) > most_bytes:
            raise MapFormatError(f"{self.where(sha256)} has more than {most_bytes} bytes; it is damaged")
        return verified(b"".join(self.chunks(sha256)), sha256)

    def chunks(self, sha256: str) -> Iterator[bytes]:
        """Yield the bytes of an address in pieces, unverified."""
        return self._objects.chunks(self._path(sha256))

    def is_whole(self, sha256: str) -> bool:
        """True if the bytes of an address exist and match it; reads them in pieces."""
        try:
            return self.size(sha256) is not None and self.matches(sha256)
        except StoreError:  # a link, or a disk that cannot read it; an object store that does not answer is no damage
            if self.is_folder:
                return False
            raise

    def matches(self, sha256: str) -> bool:
        """As `is_whole`; StoreError for bytes that are missing or cannot be read."""
        digest = hashlib.sha256()
        for chunk in self.chunks(sha256):
            digest.update(chunk)
        return digest.hexdigest() == sha256

    def where(self, sha256: str) -> str:
        """Return the place of an address, for messages."""
        return f"{self._objects.place}/{self._path(sha256)}"

    def size(self, sha256: str) -> int | None:
        """Return the size in bytes of an address, None if missing; StoreError behind a symbolic link."""
        return self._objects.size(self._path(sha256))

    def sizes(self) -> dict[str, int]:
        """Return the sizes in bytes of all addresses."""
        return {path[-64:]: size for path, size, _ in self._objects.listed(self._prefix) if self._is_address(path)}

    def changed_ns(self) -> dict[str, int]:
        """Return when all addresses were written."""
        return {path[-64:]: ns for path, _, ns in self._objects.listed(self._prefix) if self._is_address(path)}

    def leftovers(self) -> dict[str, int]:
        """Return names and sizes in bytes of what is not a blob, such as remains of a killed process; an object store has none."""
        if not self.is_folder:
            return {}
        found = self._objects.listed(self._prefix)
        return {path: size for path, size, _ in found if path.count("/") == 2 and not self._is_address(path)}

    def total_bytes(self) -> int:
        return sum(self.sizes().values()) + sum(self.leftovers().values())

    def remove(self, name: str) -> None:
        """Remove the bytes of an address, or a leftover."""
        self._objects.remove(name if "/" in name else self._path(name))

    def links(self) -> list[str]:
        """Return symbolic links, which are not followed."""
        return self._objects.links(self._prefix)

    def _path(self, sha256: str) -> str:
        return f"{self._prefix}/{sha256[:2]}/{sha256}"

    def _is_address(self, path: str) -> bool:
        return path == self._path(path[-64:])

    def _keep(self, sha256: str, size_bytes: int, chunks: Iterable[bytes]) -> None:
        # What is there may be damaged; reading it costs less than writing it.
        if self.size(sha256) == size_bytes and self.is_whole(sha256):
            self._objects.settle(self._path(sha256))
        else:
            self._objects.put(self._path(sha256), chunks)


def _checked(chunks: Iterable[bytes], sha256: str, size_bytes: int) -> Iterator[bytes]:
    digest, size = hashlib.sha256(), 0
    for chunk in chunks:
        size += len(chunk)
        if size > size_bytes:  # whatever else it has would only fill the disk
            break
        digest.update(chunk)
        yield chunk
    if size != size_bytes or digest.hexdigest() != sha256:
        raise MapFormatError(f"{size} bytes that should be {size_bytes} with SHA-256 {sha256}; they were damaged")
