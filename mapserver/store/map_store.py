"""The store of maps: versions of sites in one folder.

    DIR/store.sqlite3            sites, versions and their states, robots, jobs, events; or in PostgreSQL, as DIR/places.json says
        DIR/lock                     exclusive during garbage collection, shared while new, still unreferenced bytes arrive
    DIR/blobs/ab/<sha256>        tiles, manifests, vocabularies, archives, by content; or in an object store that DIR/places.json names
        DIR/reserve                  space freed by `gc` to work on a full disk
    DIR/sites/<site>/current     the current manifest's address as text, for robots that read the folder; derived

Bytes are on the disk before the transaction that references them, so a crash leaves at most unreferenced files.
"""

import hashlib
import sqlite3
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Self

import msgspec

from fleetmap.encoding import to_json, to_plain
from fleetmap.errors import BusyError, ChangedError, MapFormatError, StateError, StoreError, UsageError, disk_errors
from fleetmap.files import sync_path, write_atomically
from fleetmap.mapformat.building import AREAS, BUILDING_KEY
from fleetmap.mapformat.manifest import BlobEntry, Manifest, TileEntry, decode_manifest, encode_manifest
from fleetmap.mapformat.names import check_name, current_path
from fleetmap.mapformat.tile import encode_tile
from fleetmap.mapformat.version_file import ExportBlob, ExportHead, open_export
from mapserver.quality.figures import carried_evidence, trusted_calibrations
from mapserver.store import files as disk
from mapserver.store import upkeep
from mapserver.store.blobs import Blobs
from mapserver.store.database import Transaction, format_of
from mapserver.store.fleet_queries import name_failures
from mapserver.store.places import DATABASE, Places, open_database, open_objects, read_places, write_places
from mapserver.store.queries import EXTRA_TABLES, Release, StoreQueries
from mapserver.store.rows import NOBODY, Actor, DraftContent, Retention, VerdictRow, VersionInfo
from mapserver.store.schema import FORMAT

_USUAL_RETENTION = Retention()
AREAS_BEFORE = "areas before"
"""Kind of a site's file with its areas before their last change."""


class MapStore(StoreQueries, AbstractContextManager["MapStore"]):
    """One open store. Methods may be called from any thread; every process opens its own."""

    def __init__(
        self, root: Path, clock_ns: Callable[[], int], *, create: bool = False, read_only: bool = False
    ) -> None:
        super().__init__(root, clock_ns, create=create, read_only=read_only)
        try:
            self.files.follow()
            if not read_only:
                sync_path(root)
                self._repair_current_files()
        except BaseException:
            self.close()
            raise

    @classmethod
    def open(
        cls, path: Path, *, create: bool = False, read_only: bool = False, clock_ns: Callable[[], int] = time.time_ns
    ) -> Self:
        """Open the store in folder `path`, created with `create`. Derived files are repaired.

        read_only: also opens a store that cannot be written because of its rights or a full disk; an
        older format is not migrated.
        Raises StoreError if it does not exist, cannot be opened or is from an earlier fleetmap, NewerFormatError for one of
        a newer fleetmap.
        """
        if read_places(path).database is not None:
            return cls(path, clock_ns, create=create)
        file = path / DATABASE
        is_new = not file.is_file()
        if is_new and not create:
            raise StoreError(
                f"{path} holds no map store; check --store, or make one with `mapserver build RECORDING --site NAME`"
            )
        if read_only and 0 < format_of(file) < FORMAT:
            return cls(path, clock_ns, read_only=True)
        try:
            disk.make_folder(path / "sites")
            if is_new:
                disk.make_own_file(file)
                disk.keep_reserve(path)
            return cls(path, clock_ns)
        except (OSError, sqlite3.Error, StoreError) as error:
            if read_only:
                return cls(path, clock_ns, read_only=True)
            if isinstance(error, StoreError):
                raise
            reason = f"the store {path} cannot be opened ({error}); check the path, its rights and space"
            raise StoreError(reason) from error

    @classmethod
    def attach(cls, path: Path, places: Places, progress: Callable[[int, int], None] = lambda done, total: None) -> int:
        """Copy what is in the folder to these places, where all who open the store then find it; return the copied bytes of content.

        A folder without a store is attached to the one that is there already. Files in the folder stay; the database is renamed.
        Raises StoreError if either side fails, or if there is a store on both; nothing is changed then.
        """
        before, file = read_places(path), path / DATABASE
        places = Places(places.content or before.content, places.database or before.database)
        is_shared = before.database is not None
        if is_shared and (before.database != places.database or before.content not in (None, places.content)):
            raise UsageError(
                f"{path} shares its store with others; restore a backup into a new folder, and attach that to the new place"
            )
        if not file.is_file() and not is_shared:
            if None in (places.content, places.database):
                raise UsageError(
                    f"{path} holds no map store; name the content and the database of the one that it shall share"
                )
            open_database(path, places, time.time_ns, create=False, read_only=True).close()
            disk.make_folder(path)
            write_places(path, places)
            return 0
        with cls.open(path) as store, store._bytes(shared=False), store.served(shared=False):
            if running := store.running_jobs():
                raise BusyError(f"job {running[0].id} of site {running[0].site} runs; wait for its end")
            target = Blobs(open_objects(places.content or path))
            copied = store._copy_content(target, progress) if places.content != before.content else 0
            with store._database.write():  # nobody writes what is not copied any more
                if places.database != before.database:
                    with closing(open_database(path, places, time.time_ns, create=True, read_only=False)) as database:
                        database.copy_from(store._database)
                write_places(path, places)
        if places.database is not None:
            with cls.open(path) as store:
                store.files.share()
            if file.is_file():
                with disk_errors(f"{file} cannot be renamed", "rename it: nobody may use it any more"):
                    file.replace(path / "store-moved.sqlite3")
        return copied

    def _copy_content(self, target: Blobs, progress: Callable[[int, int], None]) -> int:
        known, named, copied = target.sizes(), sorted(self.named_blobs()), 0
        for number, sha256 in enumerate(named, start=1):
            progress(number, len(named))
            size = self._blobs.size(sha256)
            if size is None:
                raise StoreError(f"{self._blobs.where(sha256)} is missing; run `mapserver verify`, the content stays")
            if known.get(sha256) != size:
                target.put_chunks(self._blobs.chunks(sha256), sha256, size)
                copied += size
        return copied

    def served(self, *, shared: bool = True) -> AbstractContextManager[None]:
        """Note for the block that a server has the store in this folder open; BusyError for its exclusive use while one has."""
        return disk.locked(self.folder / "served.lock", shared=shared, waits=False)

    def close(self) -> None:
        self._database.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def save(self, site: str, content: DraftContent, *, actor: Actor = NOBODY) -> VersionInfo:
        """Store a new draft version of `site` on the disk, and return it as created.

        Raises MapFormatError for tiles that cannot be encoded, StoreError on a disk error.
        """
        check_name(site, "site")
        with self._bytes():
            tiles = []
            for tile in sorted(content.tiles, key=lambda tile: (tile.tile_x, tile.tile_y)):
                data = encode_tile(tile)
                where = {"x": tile.tile_x, "y": tile.tile_y, "landmarks": len(tile)}
                tiles.append(TileEntry(**where, sha256=self._blobs.put(data), bytes=len(data)))
            vocabulary = BlobEntry(sha256=self._blobs.put(content.vocabulary), bytes=len(content.vocabulary))
            archive_sha256 = None if content.archive is None else self._blobs.put(content.archive)
            extras = {
                kind: [self._blobs.put(data) for one, data in content.extras if one == kind] for kind in EXTRA_TABLES
            }
            with self._database.write() as change:
                change.insert("sites", [{"site": site}], "ON CONFLICT DO NOTHING")
                last = change.execute("SELECT last_version FROM sites WHERE site = ?", (site,)).fetchone()[0]
                current = self.current(site)
                alignment = None if current is None else self.alignment(site)  # a first version has a frame of its own
                building = {} if alignment is None else {BUILDING_KEY: to_plain(alignment.frame)}
                details = msgspec.structs.asdict(content.details)
                details["configuration"] = details["configuration"] | building
                parent = None if current is None else current.version
                manifest = Manifest(
                    site=site, version=last + 1, parent=parent, tiles=tuple(tiles), vocabulary=vocabulary, **details
                )
                words = f"draft {manifest.version}"
                draft = self._add_draft(change, manifest, archive_sha256, extras, words, content.job, actor)
                if content.evidence is not None:
                    figures = to_json(content.evidence).decode()
                    change.insert("evidence", [{"site": site, "version": draft.version, "figures": figures}])
        return draft

    def _add_draft(
        self,
        change: Transaction,
        manifest: Manifest,
        archive_sha256: str | None,
        extras: Mapping[str, Iterable[str]],
        words: str,
        job: int | None,
        actor: Actor,
    ) -> VersionInfo:
        """Insert a draft, whose bytes are on the disk but for the manifest. extras: addresses by kind in EXTRA_TABLES."""
        data = encode_manifest(manifest)
        draft = VersionInfo(
            **upkeep.columns_of(manifest),
            state="draft",
            published_ns=None,
            manifest_sha256=self._blobs.put(data),
            manifest_bytes=len(data),
            archive_sha256=archive_sha256,
            saved_ns=self.now_ns(),
            retired_ns=None,
            job=job,
        )
        own = {"site": draft.site, "version": draft.version}
        change.insert("versions", [asdict(draft)])
        query = "UPDATE sites SET last_version = ? WHERE site = ? AND last_version < ?"
        change.execute(query, (draft.version, draft.site, draft.version))
        named = sorted(upkeep.references(draft, manifest))
        change.insert("version_blobs", [own | {"kind": kind, "sha256": sha256} for kind, sha256 in named])
        for kind, addresses in extras.items():
            change.insert(EXTRA_TABLES[kind], [own | {"sha256": sha256} for sha256 in sorted(set(addresses))])
        change.log(draft.site, "saved", words, draft.version, actor)
        return draft

    def keep_site_files(
        self,
        site: str,
        files: Mapping[str, bytes | None],
        detail: str,
        *,
        actor: Actor = NOBODY,
        areas_tag: str | None = None,
    ) -> None:
        """Store files of a site beside its versions, by kind, in one transaction; None deletes a kind. detail: for the log.

        Failures get the area names valid then; the replaced areas are kept as AREAS_BEFORE. Raises UsageError for an unknown site,
        for invalid areas and for areas without the alignment that they need, ChangedError if the areas have another tag than
        areas_tag (None: any), StoreError on a disk error.
        """
        self._check_site(site)
        with self._bytes():
            addresses = {kind: self._blobs.put(data) for kind, data in files.items() if data is not None}
            with self._database.write() as change:
                if areas_tag not in (None, self.areas_tag(site)):
                    raise ChangedError(
                        f"the areas of site {site} were changed meanwhile; load them anew, and make the change again"
                    )
                remove = "DELETE FROM site_files WHERE site = ? AND kind = ?"
                has_areas = self.site_file_sha256(site, AREAS) is not None
                if AREAS in files and (has_areas or files[AREAS] is not None):  # none removed once more change nothing
                    change.execute(remove, (site, AREAS_BEFORE))
                    rename = "UPDATE site_files SET kind = ? WHERE site = ? AND kind = ?"
                    change.execute(rename, (AREAS_BEFORE, site, AREAS))
                for kind in files:
                    change.execute(remove, (site, kind))
                rows = [{"site": site, "kind": kind, "sha256": sha256} for kind, sha256 in addresses.items()]
                change.insert("site_files", rows)
                name_failures(change, site, self.areas(site))
                change.log(site, " and ".join(files), detail, actor=actor)

    @contextmanager
    def releasing(self, site: str) -> Iterator[Release]:
        """Change a site's releases in the transaction that reads them; durable at the end, all taken back by an error of the block."""
        with self._database.write() as change:
            release = Release(self._database, change, site)
            yield release
        if self._blobs.is_folder and release.has_new_current:
            self._write_current_file(site)

    def record_verdict(self, draft: VersionInfo, verdict: VerdictRow, actor: Actor) -> None:
        """Store the gate's verdict on a draft; a refusal is also logged."""
        row = {
            **{"site": draft.site, "version": draft.version, "stamp_ns": verdict.stamp_ns},
            **{"accepted": int(verdict.accepted), "forced": int(verdict.forced)},
            "reasons": to_json(verdict.reasons).decode(),
            "report": to_json(verdict.report, order="sorted").decode(),
        }
        with self._database.write() as change:
            change.insert("verdicts", [row])
            if verdict.reasons:
                kind = "forced" if verdict.forced else "refused"
                detail = f"draft {draft.version}: {'; '.join(verdict.reasons)}"
                change.log(draft.site, kind, detail, draft.version, actor)

    def replace_manifest(
        self, draft: VersionInfo, manifest: Manifest, kind: str, detail: str, actor: Actor
    ) -> VersionInfo:
        """Replace the manifest of a draft by one with the same tiles; return the draft, and log the change.

        Raises StateError if it is no longer a draft or was changed by another user, StoreError on a disk error.
        """
        data, own = encode_manifest(manifest), (draft.site, draft.version)
        with self._bytes():
            new = replace(draft, manifest_sha256=self._blobs.put(data), manifest_bytes=len(data))
            with self._database.write() as change:
                query = """UPDATE versions SET manifest_sha256 = ?, manifest_bytes = ?
                           WHERE site = ? AND version = ? AND state = 'draft' AND manifest_sha256 = ?"""
                values = (new.manifest_sha256, len(data), *own, draft.manifest_sha256)
                if not change.execute(query, values).rowcount:
                    raise StateError(
                        f"draft {draft.version} of site {draft.site} was changed meanwhile by another operator; try again"
                    )
                query = "UPDATE version_blobs SET sha256 = ? WHERE site = ? AND version = ? AND kind = 'manifest'"
                change.execute(query, (new.manifest_sha256, *own))
                change.log(draft.site, kind, detail, draft.version, actor)
        return new

    def check_bytes(self, version: VersionInfo) -> None:
        """Raise StoreError or MapFormatError unless all bytes of a version for robots are present and correct."""
        manifest = decode_manifest(self._blobs.get(version.manifest_sha256))
        for sha256 in (manifest.vocabulary.sha256, *(tile.sha256 for tile in manifest.tiles)):
            self._blobs.get(sha256)

    def verify(self) -> upkeep.StoreFindings:
        """Read everything in the store. Raises StoreError only if the database cannot be read at all."""
        with self._disk_errors():
            return upkeep.verify(self.folder, self._database, self._blobs)

    def collect_garbage(
        self, retention: Retention = _USUAL_RETENTION, *, dry_run: bool = False, actor: Actor = NOBODY
    ) -> upkeep.Garbage:
        """Remove versions beyond retention and unreferenced files; raises StoreError on a disk error."""
        if dry_run:
            return upkeep.collect(self._database, self._blobs, retention, None)
        with self._bytes(shared=False):
            garbage = upkeep.collect(self._database, self._blobs, retention, actor)
            self._database.shrink(1 << 30)
            disk.keep_reserve(self.folder)
            return garbage

    def remove_survey_pictures(self, days: float, *, dry_run: bool = False) -> int:
        """Remove the surveys' pictures kept for longer from all versions, and return their number; StoreError on a disk error.

        Their age counts from their first build, whatever their recording's clock says. Indexes of versions, which are signed, still
        name them.
        """
        before_ns, old = self.now_ns() - int(days * 86_400e9), set[str]()
        with self._bytes(shared=dry_run):
            for site in self.sites():
                for info in self.versions(site.site):
                    with suppress(StateError, MapFormatError):  # a version without pictures
                        pictures = self.survey_pictures(info.site, info.version)
                        old |= {one.sha256 for one in pictures if one.kept_ns < before_ns}
            if not dry_run and old:
                with self._database.write() as change:
                    for sha256 in old:
                        change.execute("DELETE FROM surfel_blobs WHERE sha256 = ?", (sha256,))
                for sha256 in old - self.named_blobs():
                    self._blobs.remove(sha256)
        return len(old)

    def export_version(self, site: str, version: int, path: Path, *, archive: bool = True) -> int:
        """Write a version into one file and return its size; errors as of `manifest`, StoreError for the disk."""
        head = self._export_head(site, version, archive=archive)
        with disk_errors(f"{path} cannot be written", "check the folder, its space and rights"):
            write_atomically(path, _export_chunks(head, self._blobs))
            return path.stat().st_size

    def version_file(self, site: str, version: int) -> tuple[ExportHead, Callable[[], Iterator[bytes]]]:
        """Return the file of a version without its archive: its head, and its bytes in pieces, always the same."""
        head = self._export_head(site, version, archive=False)
        return head, lambda: _export_chunks(head, self._blobs)

    def _export_head(self, site: str, version: int, *, archive: bool) -> ExportHead:
        info, manifest = self.version(site, version), self.manifest(site, version)
        found: list[tuple[Any, str, int]] = [("manifest", info.manifest_sha256, info.manifest_bytes)]
        found.append(("vocabulary", manifest.vocabulary.sha256, manifest.vocabulary.bytes))
        found += [("tile", *each) for each in {tile.sha256: tile.bytes for tile in manifest.tiles}.items()]
        if archive:
            query = "SELECT sha256 FROM {} WHERE site = ? AND version = ? ORDER BY sha256"
            tables = EXTRA_TABLES.items()
            kept = [(k, s) for k, t in tables for s in self._database.column(query.format(t), (site, version))]
            kept += [] if info.archive_sha256 is None else [("archive", info.archive_sha256)]
            found += [(kind, sha256, sum(map(len, self._blobs.chunks(sha256)))) for kind, sha256 in kept]
        blobs = tuple(ExportBlob(kind=kind, sha256=sha256, bytes=size) for kind, sha256, size in found)
        return ExportHead(site=site, version=version, blobs=blobs)

    def import_version(self, path: Path, *, actor: Actor = NOBODY) -> VersionInfo:
        """Import a version from an export file, as a draft of its site with its own number; publish it afterwards.

        Does nothing if the store already has it. Raises MapFormatError for an incomplete file, StateError
        if the site has another version of that number, StoreError on a disk error.
        """
        with open_export(path) as reader, self._bytes():
            reader.check_whole()
            manifest = reader.manifest()
            carried_evidence(manifest), trusted_calibrations(manifest)
            site, number, blobs = manifest.site, manifest.version, reader.head.blobs
            if (known := self._known_import(site, number, blobs[0].sha256)) is not None:
                return known
            reader.check_tiles(manifest)
            for place, blob in enumerate(blobs):
                self._blobs.put_chunks(reader.chunks(place), blob.sha256, blob.bytes)
            archive, words = reader.head.archive(), f"import as draft {number}"
            extras = {kind: [blob.sha256 for blob in blobs if blob.kind == kind] for kind in EXTRA_TABLES}
            with self._database.write() as change:
                change.insert("sites", [{"site": site}], "ON CONFLICT DO NOTHING")
                self._known_import(site, number, blobs[0].sha256)
                sha256 = None if archive is None else archive.sha256
                return self._add_draft(change, manifest, sha256, extras, words, None, actor)

    def _known_import(self, site: str, version: int, manifest_sha256: str) -> VersionInfo | None:
        known = self._version(site, version=version)
        if known is not None and known.manifest_sha256 != manifest_sha256:
            raise StateError(f"site {site} has another version {version}; import it into a separate store")
        return known

    def _repair_current_files(self) -> None:
        currents = self._database.query("SELECT site, manifest_sha256 FROM versions WHERE state = 'current'")
        for row in currents if self._blobs.is_folder else ():
            path = self.folder / current_path(row["site"])
            line = f"{row['manifest_sha256']}\n".encode()
            if not disk.is_plain_file(path) or b"".join(disk.read_chunks(path)) != line:
                self._write_current_file(row["site"])

    def _write_current_file(self, site: str) -> None:
        """Write within a transaction, so that the file always matches the latest change of several processes."""
        path = self.folder / current_path(site)
        with self._database.write(durable=False):
            current = self.current(site)
            assert current is not None
            disk.check_no_link(self.folder, path.parent)
            words = (
                f"though version {current.version} is current; free some space and open the store again to repair it"
            )
            with disk_errors(f"{path} cannot be written", words):
                disk.make_folder(path.parent)
                write_atomically(path, [f"{current.manifest_sha256}\n".encode()])

    @contextmanager
    def _bytes(self, *, shared: bool = True) -> Iterator[None]:
        """Hold the lock under which bytes arrive (shared), or unreferenced ones are removed."""
        with self._disk_errors(), self._database.locked("lock", shared=shared):
            yield

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise StoreError(f"{error.filename or self.folder}: {error.strerror}; check the store's disk") from error


def _export_chunks(head: ExportHead, blobs: Blobs) -> Iterator[bytes]:
    """Yield the bytes of the file; raises MapFormatError, before its end, for damaged bytes in the store."""
    start = head.start()
    whole = hashlib.sha256(start)
    yield start
    for blob in head.blobs:
        own, size = hashlib.sha256(), 0
        for chunk in blobs.chunks(blob.sha256):
            own.update(chunk)
            whole.update(chunk)
            size += len(chunk)
            yield chunk
        if own.hexdigest() != blob.sha256 or size != blob.bytes:
            raise MapFormatError(f"{blob.kind} {blob.sha256} in the store is damaged; run `mapserver verify`")
    yield whole.digest()
