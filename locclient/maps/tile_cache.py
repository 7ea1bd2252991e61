"""The robot's disk cache of map bytes, addressed by their SHA-256 and bounded in size."""

import logging
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import msgspec

from fleetmap.encoding import to_json
from fleetmap.errors import MapFormatError, StoreError, disk_errors
from fleetmap.files import sync_path, write_atomically
from fleetmap.mapformat.names import blob_path, check_name, check_sha256, verified
from fleetmap.messages import WantedVersion

DEFAULT_MAX_BYTES = 2_000_000_000
_log = logging.getLogger(__name__)


class ActiveVersion(msgspec.Struct, frozen=True):
    """A version of a site that is complete in the cache; blobs: all its addresses, the manifest's first."""

    version: Annotated[int, msgspec.Meta(ge=1)]
    blobs: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]

    def wanted(self, site: str) -> WantedVersion:
        return WantedVersion(site=site, version=self.version, manifest_sha256=self.blobs[0])


class TileCache:
    """Files below one folder. Above `max_bytes` the least recently used are evicted, never those of an active, kept or reserved version.

    Bytes are verified on every read. A disk error affects the cache, not the robot's map: it is logged, and counted in `faults`.
    For one thread at a time. One process should use a folder; a second one does no harm but may evict files that the first one needs.
    """

    def __init__(self, folder: Path, *, max_bytes: int = DEFAULT_MAX_BYTES) -> None:
        """Create the folder; StoreError if that fails."""
        self.folder = folder
        self._max_bytes = max_bytes
        self.faults, self.last_fault = 0, ""
        self._reserved: dict[str, frozenset[str]] = {}
        with disk_errors(f"the cache {folder} cannot be used", "choose another folder"):
            folder.mkdir(parents=True, exist_ok=True)
            for leftover in (*folder.glob("*/*/.*.tmp"), *folder.glob("sites/*/kept/.*.tmp")):
                with suppress(OSError):
                    leftover.unlink()  # by a process that died while writing
            sizes = []
            for path in folder.glob("blobs/??/*"):
                with suppress(OSError):
                    if len(path.name) == 64:
                        status = path.stat()
                        sizes.append((status.st_mtime_ns, path.name, status.st_size))
            self._sizes = {name: size for _, name, size in sorted(sizes)}
            found = ((path.parent.name, self._read_record(path)) for path in folder.glob("sites/*/active"))
            self._active = {site: record for site, record in found if record is not None}
            kept = ((path.parent.parent.name, self._read_record(path)) for path in folder.glob("sites/*/kept/[0-9]*"))
            self._kept = {(site, record.version): record for site, record in kept if record is not None}

    def __contains__(self, sha256: str) -> bool:
        return sha256 in self._sizes

    @property
    def total_bytes(self) -> int:
        return sum(self._sizes.values())

    def get(self, sha256: str) -> bytes | None:
        """Return the bytes of an address; None if absent, unreadable or damaged. The last two are faults; damaged files are removed."""
        path = self._path(sha256)
        try:
            data = verified(path.read_bytes(), sha256)
        except (OSError, MapFormatError) as error:
            self._sizes.pop(sha256, None)
            if isinstance(error, MapFormatError):
                self._note(f"cached {sha256} cannot be used and was removed: {error}")
                self._try_unlink(path)
            elif not isinstance(error, FileNotFoundError):  # the bytes may be good
                self._note(f"{path} cannot be read ({error.strerror}); check the disk and whose file it is")
            return None
        with suppress(OSError):  # a read-only disk, or another account's file: readable, and never evicted
            os.utime(path)
        # Dictionaries keep their order: last used is last.
        self._sizes[sha256] = self._sizes.pop(sha256, len(data))
        return data

    def put(self, sha256: str, data: bytes) -> None:
        """Store `data` atomically, and evict other files for it.

        Raises MapFormatError for bytes of another address. A disk error is a fault.
        """
        verified(data, sha256)
        if not self._write(self._path(sha256), data):
            return
        self._sizes.pop(sha256, None)
        self._sizes[sha256] = len(data)
        self._evict(keep=sha256)

    def reserve(self, site: str, blobs: Sequence[str]) -> None:
        """Protect these addresses from eviction until the site's next version is reserved or active."""
        self._reserved[site] = frozenset(blobs)

    def activate(self, site: str, version: int, blobs: Sequence[str]) -> None:
        """Activate a version atomically. blobs: all its addresses, the manifest's first.

        Raises StoreError if one of them is missing or on a disk error; the active version then stays.
        """
        missing = [sha256 for sha256 in blobs if sha256 not in self._sizes]
        if missing:
            raise StoreError(
                f"version {version} of {site} is not whole: {len(missing)} of {len(blobs)} pieces are missing, "
                f"{missing[0]} first; {self.last_fault or 'fetch them again'}"
            )
        record = ActiveVersion(version, tuple(blobs))
        if record != self._active.get(site) and not self._write(self._site_path(site) / "active", to_json(record)):
            raise StoreError(f"version {version} of {site} cannot be made active: {self.last_fault}")
        self._active[site] = record
        self._reserved.pop(site, None)
        self._evict(keep="")

    def active(self, site: str) -> ActiveVersion | None:
        return self._active.get(site)

    def keep(self, site: str, version: int, blobs: Sequence[str]) -> None:
        """Keep a complete version until `release`, even in a full cache; errors as of `activate`."""
        missing = [sha256 for sha256 in blobs if sha256 not in self._sizes]
        record = ActiveVersion(version, tuple(blobs))
        if missing or not self._write(self._site_path(site) / "kept" / str(version), to_json(record)):
            raise StoreError(
                f"version {version} of {site} is not kept: {self.last_fault or f'{missing[0]} is missing'}"
            )
        self._kept[site, version] = record

    def release(self, site: str, version: int) -> None:
        """Undo `keep`, and remove files that no other version needs; StoreError on a disk error."""
        with disk_errors(f"version {version} of {site} cannot be removed from the cache", "check its rights"):
            kept = self._site_path(site) / "kept"
            (kept / str(version)).unlink(missing_ok=True)
            sync_path(kept)
        gone = self._kept.pop((site, version), None)
        for sha256 in () if gone is None else set(gone.blobs) - self._used():
            self._remove(sha256)

    def kept(self, site: str) -> list[ActiveVersion]:
        """Return the site's kept versions, oldest first."""
        return [record for (of, _), record in sorted(self._kept.items()) if of == site]

    def keep_file(self, site: str, kind: str, data: bytes | None) -> None:
        """Store a site's file beside its versions, until the next one of that kind; None removes it."""
        path = self._site_path(site) / "beside" / check_name(kind, "kind")
        if data is None:
            self._try_unlink(path)
        else:
            self._write(path, data)

    def kept_file(self, site: str, kind: str) -> bytes | None:
        """Return the last file given to `keep_file`; None without one."""
        path = self._site_path(site) / "beside" / check_name(kind, "kind")
        try:
            return path.read_bytes()
        except OSError as error:
            if not isinstance(error, FileNotFoundError):
                self._note(f"{path} cannot be read ({error.strerror}); it has to be fetched again")
        return None

    def room_bytes(self) -> int:
        """Return the free bytes beside the protected files."""
        return self._max_bytes - sum(self._sizes.get(sha256, 0) for sha256 in self._used())

    def _note(self, fault: str) -> None:
        _log.warning("tile cache: %s", fault)
        self.faults, self.last_fault = self.faults + 1, fault

    def _read_record(self, path: Path) -> ActiveVersion | None:
        try:
            record = msgspec.json.decode(path.read_bytes(), type=ActiveVersion)
            return msgspec.structs.replace(record, blobs=tuple(check_sha256(sha256) for sha256 in record.blobs))
        except OSError as error:
            self._note(f"{path} cannot be read ({error.strerror}); check the disk and whose file it is")
        except (msgspec.MsgspecError, UnicodeDecodeError, MapFormatError) as error:
            self._note(f"{path} is damaged ({error}); the version has to be fetched again")
        return None

    def _used(self) -> set[str]:
        """Return the protected addresses."""
        records = (*self._active.values(), *self._kept.values())
        return set().union(*self._reserved.values(), *(record.blobs for record in records))

    def _evict(self, keep: str) -> None:
        total = self.total_bytes
        if total <= self._max_bytes:
            return
        used = self._used() | {keep}
        for sha256 in list(self._sizes):
            if total <= self._max_bytes:
                return
            if sha256 not in used:
                total -= self._sizes[sha256]
                self._remove(sha256)

    def _write(self, path: Path, data: bytes) -> bool:
        """Write `data` to `path` durably and return True; on an error keep the old content, note a fault and return False."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, [data], mode=0o666)
        except OSError as error:
            self._note(f"{path} cannot be written ({error.strerror}); make space for the cache")
            return False
        return True

    def _site_path(self, site: str) -> Path:
        return self.folder / "sites" / check_name(site, "site")

    def _remove(self, sha256: str) -> None:
        self._sizes.pop(sha256, None)
        self._try_unlink(self._path(sha256))

    def _try_unlink(self, path: Path) -> None:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            self._note(f"{path} cannot be removed ({error.strerror}); check the rights of the cache")

    def _path(self, sha256: str) -> Path:
        return self.folder / blob_path(sha256)
