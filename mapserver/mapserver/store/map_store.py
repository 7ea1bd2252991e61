"""The store of maps: versions of sites in one folder.

    DIR/store.sqlite3            sites, versions and their states, robots, events
    DIR/blobs/ab/<sha256>        tiles, manifests, vocabularies, archives, by content
    DIR/sites/<site>/current     the current manifest's address as text, for robots that read the folder; derived

Bytes are on the disk before the transaction that mentions them, so a crash leaves at most files that nothing mentions.
"""

import json
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

import msgspec

from fleetmap.errors import GateRefusedError, StoreError, UsageError
from fleetmap.mapformat import (
    BlobEntry,
    Manifest,
    Tile,
    TileEntry,
    check_name,
    check_sha256,
    current_path,
    decode_manifest,
    encode_manifest,
    encode_tile,
)
from mapserver.store.blobs import BlobFolder, make_folder, sync_folder, write_atomically
from mapserver.store.database import open_database, transaction
from mapserver.store.rows import DraftDetails, Event, RobotInfo, SiteInfo, VersionInfo

_SERVED_KINDS = ("manifest", "tile", "vocabulary")


class MapStore:
    """One open store. Methods may be called from any thread; every process opens its own."""

    def __init__(self, root: Path, clock_ns: Callable[[], int]) -> None:
        self._root = root
        self._clock_ns = clock_ns
        self._blobs = BlobFolder(root)
        self._lock = threading.RLock()
        self._database = open_database(root / "store.sqlite3")
        try:
            sync_folder(root)
            self._repair_current_files()
        except BaseException:
            self._database.close()
            raise

    @classmethod
    def open(cls, path: Path, *, create: bool = False, clock_ns: Callable[[], int] = time.time_ns) -> Self:
        """The store in folder `path`, which is made with `create`. What is derived is repaired here.

        Raises StoreError where there is none or it cannot be opened, NewerFormatError for one made by a newer fleetmap.
        """
        if not (path / "store.sqlite3").is_file() and not create:
            raise StoreError(f"{path} holds no map store; check --store, or make one with `mapserver build`")
        try:
            make_folder(path / "sites")
            store = cls(path, clock_ns)
        except (OSError, sqlite3.Error) as error:
            raise StoreError(
                f"the store {path} cannot be opened ({error}); check the path, its rights and space"
            ) from error
        return store

    def close(self) -> None:
        """Closes the database; the store must not be used afterwards."""
        with self._lock:
            self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def save_draft(
        self,
        site: str,
        *,
        tiles: Sequence[Tile],
        vocabulary: bytes,
        details: DraftDetails,
        archive: bytes | None = None,
    ) -> int:
        """The number of a new draft version of `site`, whole on the disk.

        Raises MapFormatError for tiles that cannot be encoded, StoreError where the disk refuses.
        """
        check_name(site, "site")
        entries = tuple(sorted((self._put_tile(tile) for tile in tiles), key=lambda entry: (entry.x, entry.y)))
        vocabulary_entry = BlobEntry(sha256=self._blobs.put(vocabulary), bytes=len(vocabulary))
        archive_sha256 = None if archive is None else self._blobs.put(archive)
        with self._write() as connection:
            connection.execute("INSERT OR IGNORE INTO sites (site) VALUES (?)", (site,))
            newest = connection.execute("SELECT max(version) FROM versions WHERE site = ?", (site,)).fetchone()[0]
            current = self._current_row(site)
            manifest = Manifest(
                site=site,
                version=(newest or 0) + 1,
                parent=None if current is None else current.version,
                tiles=entries,
                vocabulary=vocabulary_entry,
                **{name: getattr(details, name) for name in details.__struct_fields__},
            )
            self._insert_version(connection, manifest, archive_sha256)
        return manifest.version

    def publish(self, site: str, version: int | None = None) -> int:
        """Makes a draft (the newest one, if not named) the site's current version and returns its number.

        Raises UsageError where there is no such draft, GateRefusedError for one that no robot could use, StoreError or
        MapFormatError for one whose bytes are not all there.
        """
        draft = self._draft(site, version)
        self._check_hard_limits(draft)
        self._check_bytes(draft)
        with self._write() as connection:
            changed = connection.execute(
                "UPDATE versions SET state = 'published' WHERE site = ? AND state = 'current'", (site,)
            ).rowcount
            published = connection.execute(
                """UPDATE versions SET state = 'current', published_ns = ?
                   WHERE site = ? AND version = ? AND state = 'draft'""",
                (self._clock_ns(), site, draft.version),
            ).rowcount
            if published != 1:
                raise StoreError(f"version {draft.version} of site {site} was published by someone else meanwhile")
            connection.execute(
                "UPDATE sites SET vocabulary_sha256 = coalesce(vocabulary_sha256, ?) WHERE site = ?",
                (draft.vocabulary_sha256, site),
            )
            self._insert_event(connection, site, "published", f"version {draft.version}, replacing {changed} current")
        self._write_current_file(site, draft.manifest_sha256)
        return draft.version

    def sites(self) -> list[SiteInfo]:
        """All sites by name."""
        rows = self._query(
            """SELECT s.site,
                      (SELECT version FROM versions v WHERE v.site = s.site AND state = 'current') current_version,
                      (SELECT count(*) FROM versions v WHERE v.site = s.site) versions, s.vocabulary_sha256
               FROM sites s ORDER BY s.site"""
        )
        return [SiteInfo(**row) for row in rows]

    def versions(self, site: str) -> list[VersionInfo]:
        """All versions of a site, oldest first; raises UsageError for a site that the store does not know."""
        self._check_site(site)
        rows = self._query("SELECT * FROM versions WHERE site = ? ORDER BY version", (site,))
        return [VersionInfo(**row) for row in rows]

    def version(self, site: str, version: int) -> VersionInfo:
        """One version; raises UsageError where it does not exist."""
        self._check_site(site)
        rows = self._query("SELECT * FROM versions WHERE site = ? AND version = ?", (site, version))
        if not rows:
            raise UsageError(f"site {site} has no version {version}; `mapserver versions --site {site}` lists them")
        return VersionInfo(**rows[0])

    def current(self, site: str) -> VersionInfo | None:
        """The site's current version, None before the first publication; raises UsageError for an unknown site."""
        self._check_site(site)
        return self._current_row(site)

    def manifest(self, site: str, version: int) -> Manifest:
        """The manifest of a version; errors as of `version` and `blob`."""
        return decode_manifest(self._blobs.get(self.version(site, version).manifest_sha256))

    def blob(self, sha256: str) -> bytes:
        """The bytes of an address, verified; raises StoreError for missing ones, MapFormatError for damaged ones."""
        return self._blobs.get(check_sha256(sha256))

    def served_kind(self, sha256: str, site: str | None = None) -> str | None:
        """What robots (of a site) may fetch under this address: manifest, tile, vocabulary.

        None for everything else: archives, and what only drafts mention.
        """
        rows = self._query(
            """SELECT kind FROM version_blobs JOIN versions USING (site, version)
               WHERE sha256 = ?1 AND state <> 'draft' AND (?2 IS NULL OR site = ?2)""",
            (check_sha256(sha256), site),
        )
        kinds = {row["kind"] for row in rows}
        return next((kind for kind in _SERVED_KINDS if kind in kinds), None)

    def archive(self, site: str, version: int) -> bytes | None:
        """The archive of a version, if it has one; errors as of `version` and `blob`."""
        sha256 = self.version(site, version).archive_sha256
        return None if sha256 is None else self._blobs.get(sha256)

    def site_vocabulary(self, site: str) -> bytes | None:
        """The vocabulary that new surveys of a site must use: the published one, else the newest draft's, else None."""
        check_name(site, "site")
        rows = self._query(
            """SELECT coalesce(s.vocabulary_sha256, v.vocabulary_sha256) sha256
               FROM sites s JOIN versions v USING (site) WHERE s.site = ? ORDER BY v.version DESC LIMIT 1""",
            (site,),
        )
        return self._blobs.get(rows[0]["sha256"]) if rows else None

    def robots(self, site: str | None = None) -> list[RobotInfo]:
        """What every robot (of a site) said last."""
        rows = self._query("SELECT * FROM robots WHERE ?1 IS NULL OR site = ?1 ORDER BY site, robot", (site,))
        return [RobotInfo(**{**row, "last_report": json.loads(row["last_report"])}) for row in rows]

    def record_robot_report(self, site: str, robot: str, report: dict[str, Any], version: int | None = None) -> None:
        """Keeps what a robot said; `version` is what it runs, None where it did not say."""
        text = msgspec.json.encode(report).decode()
        with self._write(durable=False) as connection:
            connection.execute(
                """INSERT INTO robots (site, robot, version, last_seen_ns, last_report) VALUES (?, ?, ?, ?, ?)
                   ON CONFLICT DO UPDATE SET version = coalesce(excluded.version, version),
                   last_seen_ns = excluded.last_seen_ns, last_report = excluded.last_report""",
                (check_name(site, "site"), check_name(robot, "robot"), version, self._clock_ns(), text),
            )

    def record_event(self, site: str, kind: str, detail: str) -> None:
        """Keeps one line of a site's history."""
        with self._write() as connection:
            self._insert_event(connection, site, kind, detail)

    def events(self, site: str) -> list[Event]:
        """A site's history, oldest first."""
        rows = self._query("SELECT stamp_ns, site, kind, detail FROM events WHERE site = ? ORDER BY id", (site,))
        return [Event(**row) for row in rows]

    def _put_tile(self, tile: Tile) -> TileEntry:
        data = encode_tile(tile)
        return TileEntry(
            x=tile.tile_x, y=tile.tile_y, sha256=self._blobs.put(data), bytes=len(data), landmarks=len(tile)
        )

    def _insert_version(self, connection: sqlite3.Connection, manifest: Manifest, archive_sha256: str | None) -> None:
        data = encode_manifest(manifest)
        info = VersionInfo(
            site=manifest.site,
            version=manifest.version,
            state="draft",
            parent=manifest.parent,
            created=manifest.created,
            published_ns=None,
            manifest_sha256=self._blobs.put(data),
            manifest_bytes=len(data),
            tiles=len(manifest.tiles),
            tile_bytes=manifest.tile_bytes,
            landmarks=manifest.landmarks,
            vocabulary_sha256=manifest.vocabulary.sha256,
            vocabulary_bytes=manifest.vocabulary.bytes,
            archive_sha256=archive_sha256,
        )
        row = asdict(info)
        marks = ", ".join(f":{name}" for name in row)
        connection.execute(f"INSERT INTO versions ({', '.join(row)}) VALUES ({marks})", row)
        blobs = [("manifest", info.manifest_sha256), ("vocabulary", info.vocabulary_sha256)]
        blobs += [("tile", tile.sha256) for tile in manifest.tiles]
        blobs += [("archive", archive_sha256)] if archive_sha256 is not None else []
        connection.executemany(
            "INSERT OR IGNORE INTO version_blobs (site, version, kind, sha256) VALUES (?, ?, ?, ?)",
            [(info.site, info.version, kind, sha256) for kind, sha256 in blobs],
        )

    def _insert_event(self, connection: sqlite3.Connection, site: str, kind: str, detail: str) -> None:
        row = (self._clock_ns(), site, kind, detail)
        connection.execute("INSERT INTO events (stamp_ns, site, kind, detail) VALUES (?, ?, ?, ?)", row)

    def _draft(self, site: str, version: int | None) -> VersionInfo:
        drafts = [info for info in self.versions(site) if info.state == "draft"]
        if version is None:
            if not drafts:
                raise UsageError(f"site {site} has no draft to publish; make one with `mapserver build --site {site}`")
            return drafts[-1]
        info = self.version(site, version)
        if info.state != "draft":
            raise UsageError(f"version {version} of site {site} is {info.state}, only a draft can be published")
        return info

    def _check_hard_limits(self, draft: VersionInfo) -> None:
        if draft.tiles == 0 or draft.landmarks == 0:
            raise GateRefusedError(
                f"draft {draft.version} of {draft.site} has {draft.tiles} tiles and {draft.landmarks} landmarks: no "
                "robot could localise in it; look at the build's report and at `mapserver doctor` for its recordings"
            )
        kept = next(site.vocabulary_sha256 for site in self.sites() if site.site == draft.site)
        if kept is not None and kept != draft.vocabulary_sha256:
            raise GateRefusedError(
                f"draft {draft.version} uses vocabulary {draft.vocabulary_sha256}, site {draft.site} keeps {kept}; "
                "build it again so that it takes the site's"
            )

    def _check_bytes(self, draft: VersionInfo) -> None:
        manifest = decode_manifest(self._blobs.get(draft.manifest_sha256))
        for sha256 in (manifest.vocabulary.sha256, *(tile.sha256 for tile in manifest.tiles)):
            self._blobs.get(sha256)

    def _check_site(self, site: str) -> None:
        check_name(site, "site")
        if not self._query("SELECT 1 FROM sites WHERE site = ?", (site,)):
            known = ", ".join(info.site for info in self.sites()) or "none"
            raise UsageError(f"the store has no site {site}; it has: {known}")

    def _current_row(self, site: str) -> VersionInfo | None:
        rows = self._query("SELECT * FROM versions WHERE site = ? AND state = 'current'", (site,))
        return VersionInfo(**rows[0]) if rows else None

    def _repair_current_files(self) -> None:
        for row in self._query("SELECT site, manifest_sha256 FROM versions WHERE state = 'current'"):
            path = self._root / current_path(row["site"])
            if not path.is_file() or path.read_text("ascii", "replace").strip() != row["manifest_sha256"]:
                self._write_current_file(row["site"], row["manifest_sha256"])

    def _write_current_file(self, site: str, manifest_sha256: str) -> None:
        path = self._root / current_path(site)
        try:
            make_folder(path.parent)
            write_atomically(path, f"{manifest_sha256}\n".encode())
        except OSError as error:
            raise StoreError(
                f"{path} cannot be written ({error.strerror}), though the version is current; make space and open the "
                "store again to repair it"
            ) from error

    @contextmanager
    def _write(self, *, durable: bool = True) -> Iterator[sqlite3.Connection]:
        with self._lock:
            try:
                with transaction(self._database, durable=durable) as connection:
                    yield connection
            except sqlite3.Error as error:
                raise StoreError(f"the store {self._root} refuses to be written ({error}); check its disk") from error

    def _query(self, sql: str, values: tuple[object, ...] = ()) -> list[dict[str, Any]]:
        with self._lock:
            try:
                return list(self._database.query(sql, values))
            except sqlite3.Error as error:
                raise StoreError(f"the store {self._root} cannot be read ({error}); check its disk") from error
