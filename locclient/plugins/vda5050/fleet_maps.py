"""Versions downloaded for a fleet manager. All of them stay on the disk until it deletes them."""

import logging
import tempfile
from pathlib import Path

from fleetmap.errors import LinkError, MapFormatError, StateError, StoreError, disk_errors
from fleetmap.mapformat.version_file import ExportReader, open_export
from fleetmap.messages import WantedVersion
from locclient.hooks import LinkedRobot
from locclient.maps.map_source import addresses_of
from locclient.maps.tile_cache import ActiveVersion
from locclient.plugins.vda5050.version_download import Origins, TooLargeError, download

_TOGETHER = 2  # space for a file, and for its extracted blobs
_log = logging.getLogger(__name__)


class NoRoomError(StoreError):
    """A version that does not fit into the cache."""


class DuplicateMapError(StateError):
    """A version that the robot already has."""


class FleetMaps:
    """For the thread that owns the robot's cache. Without a map server it takes what the fleet manager names with its hash."""

    def __init__(self, robot: LinkedRobot, origins: Origins) -> None:
        """Raises UsageError for invalid origins. A disk error now makes later downloads fail."""
        origins.check()
        self._cache, self._site, self._folder, self._origins = robot.cache, robot.site, robot.folder, origins
        self._needs_hash, self._check_admitted = robot.check_admitted is None, robot.check_admitted or (lambda _: None)
        cache, site, folder = self._cache, self._site, self._folder
        active = cache.active(site)
        try:
            with disk_errors(f"{folder} cannot be used", "choose another cache"):
                folder.mkdir(parents=True, exist_ok=True)
                for leftover in folder.glob("*.fmex"):
                    leftover.unlink()
            if active is not None and active not in cache.kept(site):
                cache.keep(site, active.version, active.blobs)
        except StoreError as error:
            _log.warning("maps of the fleet manager cannot be downloaded: %s", error)

    def versions(self) -> list[tuple[int, bool]]:
        """Return the versions on the disk, oldest first, each with True if enabled."""
        active = self._cache.active(self._site)
        return [(record.version, record == active) for record in self._cache.kept(self._site)]

    def download(self, version: int, link: str, sha256: str | None) -> None:
        """Fetch a version's file, check it by the signed list, and keep the version. Other versions are not affected.

        sha256: of the file, None or empty if unknown.

        Raises DuplicateMapError, NoRoomError, LinkError, UntrustedError, MapFormatError, StoreError.
        """
        if version in dict(self.versions()):
            raise DuplicateMapError(f"version {version} is on the robot already; delete it before another download")
        if self._needs_hash and not sha256:
            raise LinkError("without a map server no signed list admits a file; send its SHA-256 as mapHash")
        room_bytes = self._cache.room_bytes() // _TOGETHER
        fault = disk_errors(f"{self._folder} cannot be written", "make space for the cache")
        with fault, tempfile.NamedTemporaryFile(dir=self._folder, suffix=".fmex") as file:
            try:
                got = download(link, self._origins, file, max_bytes=max(room_bytes, 1))
            except TooLargeError as error:
                raise NoRoomError(
                    f"{error}: half of the room in the cache; delete a map, or raise [run] cache_bytes"
                ) from error
            file.flush()
            if sha256 and got != sha256.lower():
                raise LinkError(
                    f"the file behind {link[:200]} has SHA-256 {got}, the fleet manager named {sha256[:64]}"
                )
            with open_export(Path(file.name)) as reader:
                self._take(reader, version)

    def _take(self, reader: ExportReader, version: int) -> None:
        head = reader.head
        if (head.site, head.version) != (self._site, version):
            raise MapFormatError(
                f"the file holds version {head.version} of {head.site}, wanted was {version} of {self._site}"
            )
        self._check_admitted(WantedVersion(site=head.site, version=version, manifest_sha256=head.blobs[0].sha256))
        manifest = reader.manifest()
        reader.check_tiles(manifest)
        new = [blob for blob in head.blobs if blob.kind != "archive" and blob.sha256 not in self._cache]
        if sum(blob.bytes for blob in new) > self._cache.room_bytes():
            raise NoRoomError(
                f"version {version} does not fit into the cache; delete a map, or raise [run] cache_bytes"
            )
        for number, blob in enumerate(head.blobs):
            if blob in new:
                self._cache.put(blob.sha256, reader.data(number))
        self._cache.keep(self._site, version, addresses_of(manifest, head.blobs[0].sha256))

    def wanted(self, version: int) -> WantedVersion:
        """Return a version for use now; StateError if it is not on the disk, UntrustedError if it was withdrawn."""
        wanted = self._get(version).wanted(self._site)
        self._check_admitted(wanted)
        return wanted

    def delete(self, version: int, in_use: set[int]) -> None:
        """Remove a version; StateError if it is enabled, in use or absent."""
        record = self._get(version)
        if version in in_use or record == self._cache.active(self._site):
            raise StateError(f"version {version} is in use; enable another one first")
        self._cache.release(self._site, version)

    def _get(self, version: int) -> ActiveVersion:
        records = {record.version: record for record in self._cache.kept(self._site)}
        if version not in records:
            known = ", ".join(map(str, records)) or "none"
            raise StateError(f"version {version} is not on the robot, which has {known}")
        return records[version]
