"""Sources of published maps, with two that need no network: the tile cache alone, and a store's folder."""

import os
import shlex
import sqlite3
from abc import ABC, abstractmethod
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from fleetmap import errors
from fleetmap.bow.vocabulary import decode_vocabulary, shipped_vocabulary
from fleetmap.errors import FleetmapError, LinkError, MapFormatError, StoreError, UnreachableError, UsageError
from fleetmap.mapformat.manifest import Manifest, TileEntry, decode_manifest
from fleetmap.mapformat.names import blob_path, check_name, check_sha256, current_path, verified
from fleetmap.mapformat.tile import Tile, decode_tile
from fleetmap.messages import WantedVersion
from locclient.maps.loaded_map import Cell, LoadedMap
from locclient.maps.tile_cache import TileCache


class ReadyVersion(NamedTuple):
    """The version to run now. note: reason why it is not the wanted one, or incomplete; else empty."""

    wanted: WantedVersion
    note: str = ""


class MapSource(ABC):
    """Source that a robot reads its map from. The tile cache alone has the bytes of versions, and nothing else of a site."""

    def __init__(self, site: str) -> None:
        """Raises UsageError for an invalid site name."""
        self.site = check_name(site, "site")

    def newest(self, *, asks: bool = True) -> WantedVersion:
        """Return the site's current version, complete where the robot can read it; asks: False for the one on its disk. Errors as of
        `manifest`."""
        return self.ready().wanted

    def site_file(self, kind: str, max_bytes: int) -> bytes | None:
        """Return the file of this kind that the site keeps beside its versions; None without one."""
        raise NotImplementedError

    def ready(self) -> ReadyVersion:
        """Return the version to run now."""
        raise NotImplementedError

    @abstractmethod
    def blob(self, sha256: str, max_bytes: int = 0) -> bytes:
        """Return the verified bytes of an address. max_bytes: limit of a download."""

    def manifest(self, wanted: WantedVersion) -> Manifest:
        """Return the wanted version's manifest; errors as of `blob`, LinkError without a version, MapFormatError for another one's."""
        return checked_manifest(self.blob(address_of(wanted)[1]), wanted)

    def vocabulary(self, manifest: Manifest) -> bytes:
        """Return the version's vocabulary: the shipped one or a blob; errors as of `blob`."""
        entry = manifest.vocabulary
        return shipped_vocabulary(entry.sha256) or self.blob(entry.sha256, entry.bytes)

    def load(self, wanted: WantedVersion, manifest: Manifest, cells: Iterable[Cell] | None = None) -> LoadedMap:
        """Return the version with all usable tiles, or those of `cells`; errors of its vocabulary as of `blob`."""
        tiles, refused = self.tiles(manifest, cells)
        return LoadedMap(wanted, manifest, decode_vocabulary(self.vocabulary(manifest)), tiles, refused=refused)

    def tiles(
        self, manifest: Manifest, cells: Iterable[Cell] | None = None
    ) -> tuple[dict[Cell, Tile], dict[Cell, str]]:
        """Return tiles of the version, all or those of `cells` that it has, and for each unusable one the reason.

        After a request without an answer only tiles at hand are read, so that a robot without a network does not wait for each of them.
        """
        tiles, refused = dict[Cell, Tile](), dict[Cell, str]()
        away: UnreachableError | None = None
        asked = None if cells is None else set(cells)
        for entry in manifest.tiles:
            cell = (entry.x, entry.y)
            if asked is None or cell in asked:
                try:
                    if away is not None and not self._is_at_hand(entry.sha256):
                        raise away
                    tiles[cell] = checked_tile(entry, manifest.tile_size_m, self.blob(entry.sha256, entry.bytes))
                except FleetmapError as error:
                    away = error if isinstance(error, UnreachableError) else away
                    refused[cell] = str(error)
        return tiles, refused

    def _is_at_hand(self, sha256: str) -> bool:
        return True


class CachedMap(MapSource):
    """Reads from the cache alone, without waiting; for another thread than the MapClient's, with its own TileCache."""

    def __init__(self, cache: TileCache, site: str) -> None:
        super().__init__(site)
        self._cache = cache

    def blob(self, sha256: str, max_bytes: int = 0) -> bytes:
        """Return the verified bytes of an address; LinkError if not in the cache."""
        data = self._cache.get(sha256)
        if data is None:
            raise LinkError(f"{sha256} is not in the cache; it has to be fetched again")
        return data


class LocalMapSource(MapSource):
    """Reads from a store's folder, for a robot without a server; the current version does not need the store's database.

    version: number of another version than the current one, drafts included.
    """

    def __init__(self, folder: Path, site: str, version: int | None = None) -> None:
        """Raises StoreError if `folder` is not a store, UsageError for an invalid site name."""
        super().__init__(site)
        if not (folder / "sites").is_dir():
            raise StoreError(
                f"{folder} is not a map store; check --store, or "
                f"make one with `mapserver build RECORDING --site {site} --store {shlex.quote(str(folder))}`"
            )
        self._folder, self._version = folder, version

    def ready(self) -> ReadyVersion:
        return ReadyVersion(self.wanted())

    def wanted(self) -> WantedVersion:
        """Return the version to run; UsageError for a missing version, StoreError if the store cannot be read."""
        if (number := self._version) is not None:
            known = self._rows("SELECT version, manifest_sha256 FROM versions WHERE site = ?")
            if number not in known:
                names = ", ".join(str(version) for version in sorted(known)) or "none"
                raise UsageError(f"site {self.site} has no version {number} in {self._folder}; it has: {names}")
            return WantedVersion(site=self.site, version=number, manifest_sha256=known[number])
        path = self._folder / current_path(self.site)
        try:
            sha256 = check_sha256(path.read_text("ascii").strip())
        except FileNotFoundError:
            return WantedVersion(site=self.site, version=None, manifest_sha256=None)
        except (OSError, UnicodeDecodeError, MapFormatError) as error:
            raise StoreError(f"{path} cannot be read ({error}); open the store with mapserver to repair it") from error
        version = decode_manifest(self.blob(sha256)).version
        return WantedVersion(site=self.site, version=version, manifest_sha256=sha256)

    def site_file(self, kind: str, max_bytes: int) -> bytes | None:
        """Return the file of this kind that the site keeps beside its versions; None without one. Errors as of `wanted` and `blob`."""
        sha256 = self._rows("SELECT kind, sha256 FROM site_files WHERE site = ?").get(kind)
        return None if sha256 is None else self.blob(sha256)

    def _rows(self, query: str) -> dict[Any, str]:
        """Return the two columns of a query for this site; StoreError if the database cannot be read."""
        path = self._folder / "store.sqlite3"
        # Without write access beside the database, and without a write-ahead log, SQLite must open it as immutable.
        log = path.with_name(f"{path.name}-wal")
        how = "mode=ro" if os.access(self._folder, os.W_OK) or log.exists() else "mode=ro&immutable=1"
        try:
            with closing(sqlite3.connect(f"{path.absolute().as_uri()}?{how}", uri=True)) as database:
                return dict(database.execute(query, (self.site,)).fetchall())
        except sqlite3.Error as error:
            raise StoreError(
                f"{path} cannot be read ({error}); check the store with `mapserver verify --store {shlex.quote(str(self._folder))}`"
            ) from error

    def blob(self, sha256: str, max_bytes: int = 0) -> bytes:
        """Return the verified bytes of an address; StoreError for missing ones, MapFormatError for damaged ones."""
        path = self._folder / blob_path(sha256)
        with errors.disk_errors(f"{path} cannot be read", "the store is incomplete"):
            return verified(path.read_bytes(), sha256)


def address_of(wanted: WantedVersion) -> tuple[int, str]:
    """Return number and manifest address of a version; LinkError if the site has none."""
    if wanted.version is None or wanted.manifest_sha256 is None:
        raise LinkError(
            f"site {wanted.site} has no published version; publish one with `mapserver publish --site {wanted.site} --store DIR` "
            "on the machine of its store"
        )
    return wanted.version, check_sha256(wanted.manifest_sha256)


def addresses_of(manifest: Manifest, sha256: str) -> list[str]:
    """Return all blobs of a version, its manifest's address first, except a vocabulary that ships with the program."""
    vocabulary = manifest.vocabulary.sha256
    words = [] if shipped_vocabulary(vocabulary) else [vocabulary]
    return [sha256, *words, *(tile.sha256 for tile in manifest.tiles)]


def checked_manifest(data: bytes, wanted: WantedVersion) -> Manifest:
    """Decode the manifest; MapFormatError if it is not the wanted version's."""
    manifest = decode_manifest(data)
    if (manifest.site, manifest.version) != (wanted.site, wanted.version):
        raise MapFormatError(
            f"the manifest is of {manifest.site} version {manifest.version}, wanted was {wanted.site} {wanted.version}"
        )
    return manifest


def checked_tile(entry: TileEntry, size_m: float, data: bytes) -> Tile:
    """Decode the tile; MapFormatError if it does not match the manifest."""
    tile = decode_tile(data)
    if (tile.tile_x, tile.tile_y, tile.size_m, len(tile)) != (entry.x, entry.y, size_m, entry.landmarks):
        raise MapFormatError(
            f"{tile.name} with {len(tile)} landmarks is not the manifest's ({entry.x}, {entry.y}) of {entry.landmarks}"
        )
    return tile
