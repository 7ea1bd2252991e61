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
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast

from fleetmap.encoding import to_json, to_plain
from fleetmap.errors import (
    BusyError,
    ChangedError,
    MapFormatError,
    NewerFormatError,
    StateError,
    StoreError,
    UsageError,
    disk_errors,
)
from fleetmap.files import sync_path, write_atomically
from fleetmap.mapformat import (
    BlobEntry,
    Manifest,
    Tile,
    TileEntry,
    check_name,
    current_path,
    decode_manifest,
    encode_manifest,
    encode_tile,
)
from fleetmap.mapformat.building import AREAS, BUILDING_KEY
from fleetmap.mapformat.version_file import BlobKind, ExportBlob, ExportHead, open_export
from mapserver.quality.figures import carried_evidence, trusted_calibrations
from mapserver.store.blobs import Blobs
from mapserver.store.database import is_older
from mapserver.store.files import (
    check_no_link,
    is_plain_file,
    keep_reserve,
    locked,
    make_folder,
    make_own_file,
    read_chunks,
)
from mapserver.store.fleet_queries import name_failures
from mapserver.store.garbage_collection import Garbage, Retention, collect
from mapserver.store.places import DATABASE, Places, open_blobs, open_database, read_places, write_places
from mapserver.store.queries import StoreQueries
from mapserver.store.rows import (
    NOBODY,
    Actor,
    DraftContent,
    LogEntry,
    ReleaseChanges,
    SiteReleases,
    VerdictRow,
    VersionInfo,
)
from mapserver.store.shared_files import SHARED
from mapserver.store.verification import StoreFindings, verify
from mapserver.store.version_rows import (
    EXTRA_TABLES,
    apply_changes,
    extras,
    insert_draft,
    insert_extras,
    mentioned,
    site_releases,
)

if TYPE_CHECKING:
    pass

_USUAL_RETENTION = Retention()
AREAS_BEFORE = "areas before"
"""Kind of a site's file with its areas before their last change."""


class MapStore(StoreQueries):
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
            self._transactions.close()
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
        is_new = not (path / "store.sqlite3").is_file()
        if is_new and not create:
            raise StoreError(
                f"{path} holds no map store; check --store, or make one with `mapserver build RECORDING --site NAME`"
            )
        if read_only and is_older(path / "store.sqlite3"):
            return cls(path, clock_ns, read_only=True)
        try:
            make_folder(path / "sites")
            if is_new:
                make_own_file(path / "store.sqlite3")
                keep_reserve(path)
            return cls(path, clock_ns)
        except NewerFormatError:
            raise
        except (OSError, sqlite3.Error, StoreError) as error:
            if read_only:
                return cls(path, clock_ns, read_only=True)
            if isinstance(error, StoreError):
                raise
            reason = f"the store {path} cannot be opened ({error}); check the path, its rights and space"
            raise StoreError(reason) from error

    @classmethod
    def attach(
        cls,
        path: Path,
        places: Places,
        progress: Callable[[int, int], None] = lambda done, total: None,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> int:
        """Copy what is in the folder to these places, where all who open the store then find it; return the copied bytes of content.

        A folder without a store is attached to the one that is there already. Files in the folder stay; the database is renamed.
        Raises StoreError if either side fails, or if there is a store on both; nothing is changed then.
        """
        before = read_places(path)
        places = Places(places.content or before.content, places.database or before.database)
        if before.database not in (None, places.database) or (
            before.database and before.content not in (None, places.content)
        ):
            raise UsageError(
                f"{path} shares its store with others; restore a backup into a new folder, and attach that to the new place"
            )
        file = path / DATABASE
        if not file.is_file() and before.database is None:
            if None in (places.content, places.database):
                raise UsageError(
                    f"{path} holds no map store; name the content and the database of the one that it shall share"
                )
            open_database(path, places, clock_ns, create=False, read_only=True).close()
            make_folder(path)
            write_places(path, places)
            return 0
        with cls.open(path, clock_ns=clock_ns) as store, store._locked(shared=False), store.served(shared=False):
            if running := store.running_jobs():
                raise BusyError(f"job {running[0].id} of site {running[0].site} runs; wait for its end")
            copied = store._copy_content(open_blobs(path, places), progress) if places.content != before.content else 0
            with store._transactions.write():  # nobody writes what is not copied any more
                if places.database != before.database:
                    with closing(open_database(path, places, clock_ns, create=True, read_only=False)) as target:
                        target.copy_from(store._transactions)
                write_places(path, places)
        if places.database is not None:
            with cls.open(path, clock_ns=clock_ns) as store:
                for folder in SHARED:
                    if (path / folder).is_dir():
                        with store.files.changing(folder):
                            pass
        if file.is_file() and places.database is not None:
            with disk_errors(f"{file} cannot be renamed", "rename it: nobody may use it any more"):
                file.replace(path / "store-moved.sqlite3")
        return copied

    def served(self, *, shared: bool = True) -> AbstractContextManager[None]:
        """Note for the block that a server has the store in this folder open; BusyError for its exclusive use while one has."""
        return locked(self._root / "served.lock", shared=shared, waits=False)

    def _copy_content(self, target: Blobs, progress: Callable[[int, int], None]) -> int:
        known, named, copied = target.sizes(), sorted(mentioned(self._transactions)), 0
        for number, sha256 in enumerate(named, start=1):
            progress(number, len(named))
            size = self._blobs.size(sha256)
            if size is None:
                raise StoreError(f"{self._blobs.where(sha256)} is missing; run `mapserver verify`, the content stays")
            if known.get(sha256) != size:
                target.put_chunks(self._blobs.chunks(sha256), sha256, size)
                copied += size
        return copied

    def close(self) -> None:
        self._transactions.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def save(self, site: str, content: DraftContent, *, actor: Actor = NOBODY) -> VersionInfo:
        """Store a new draft version of `site` on the disk, and return it as created.

        Raises MapFormatError for tiles that cannot be encoded, StoreError on a disk error.
        """
        check_name(site, "site")
        details = content.details
        with self._locked(shared=True):
            entries = sorted((self._put_tile(tile) for tile in content.tiles), key=lambda entry: (entry.x, entry.y))
            vocabulary = BlobEntry(sha256=self._blobs.put(content.vocabulary), bytes=len(content.vocabulary))
            archive_sha256 = None if content.archive is None else self._blobs.put(content.archive)
            every = {"grid": content.grid, "surfel": [*content.surfels, *content.pictures]}
            kept = {kind: [self._blobs.put(data) for data in blobs] for kind, blobs in every.items()}
            with self._transactions.write() as connection:
                connection.execute("INSERT INTO sites (site) VALUES (?) ON CONFLICT DO NOTHING", (site,))
                last = connection.execute("SELECT last_version FROM sites WHERE site = ?", (site,)).fetchone()[0]
                current = self._current_row(site)
                manifest = Manifest(
                    site=site,
                    version=last + 1,
                    parent=None if current is None else current.version,
                    tiles=tuple(entries),
                    vocabulary=vocabulary,
                    **{name: getattr(details, name) for name in details.__struct_fields__}
                    | {"configuration": details.configuration | ({} if current is None else self._building(site))},
                )
                draft = self._draft_row(manifest, archive_sha256, content.job)
                log = LogEntry("saved", f"draft {manifest.version}", manifest.version, actor)
                insert_draft(self._transactions, connection, manifest, draft, log)
                insert_extras(connection, draft, kept)
                if content.evidence is not None:
                    connection.execute(
                        "INSERT INTO evidence (site, version, figures) VALUES (?, ?, ?)",
                        (site, manifest.version, to_json(content.evidence).decode()),
                    )
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
        with self._locked(shared=True):
            addresses = {kind: self._blobs.put(data) for kind, data in files.items() if data is not None}
            with self._transactions.write() as connection:
                if areas_tag not in (None, self.areas_tag(site)):
                    raise ChangedError(
                        f"the areas of site {site} were changed meanwhile; load them anew, and make the change again"
                    )
                held = "SELECT 1 FROM site_files WHERE site = ? AND kind = ?"
                has_areas = connection.execute(held, (site, AREAS)).fetchone() is not None
                if AREAS in files and (has_areas or files[AREAS] is not None):  # none removed once more change nothing
                    connection.execute("DELETE FROM site_files WHERE site = ? AND kind = ?", (site, AREAS_BEFORE))
                    rename = "UPDATE site_files SET kind = ? WHERE site = ? AND kind = ?"
                    connection.execute(rename, (AREAS_BEFORE, site, AREAS))
                connection.executemany("DELETE FROM site_files WHERE site = ? AND kind = ?", [(site, k) for k in files])
                rows = [(site, kind, sha256) for kind, sha256 in addresses.items()]
                connection.executemany("INSERT INTO site_files (site, kind, sha256) VALUES (?, ?, ?)", rows)
                name_failures(connection, site, self.areas(site))
                self._transactions.log(connection, site, LogEntry(" and ".join(files), detail, None, actor))

    def change_releases(self, site: str, decide: Callable[[SiteReleases], ReleaseChanges]) -> ReleaseChanges:
        """Write the changes that `decide` returns for a site's rows, in the transaction that reads them; durable on return.

        Errors of `decide` propagate without any change. Raises StoreError on a disk error.
        """
        with self._transactions.write() as connection:
            changes = decide(site_releases(self._transactions, site))
            apply_changes(self._transactions, connection, site, changes)
        if self._blobs.is_folder and any(state == "current" for _, state in changes.states):
            self._write_current_file(site)
        return changes

    def record_verdict(self, draft: VersionInfo, verdict: VerdictRow, actor: Actor) -> None:
        """Store the gate's verdict on a draft; a refusal is also logged."""
        with self._transactions.write() as connection:
            connection.execute(
                """INSERT INTO verdicts (site, version, stamp_ns, accepted, forced, reasons, report)
                   VALUES (?, ?, ?, ?, ?, ?, ?)""",
                (
                    *(draft.site, draft.version, verdict.stamp_ns, int(verdict.accepted), int(verdict.forced)),
                    to_json(verdict.reasons).decode(),
                    to_json(verdict.report, order="sorted").decode(),
                ),
            )
            if verdict.reasons:
                kind = "forced" if verdict.forced else "refused"
                detail = f"draft {draft.version}: {'; '.join(verdict.reasons)}"
                self._transactions.log(connection, draft.site, LogEntry(kind, detail, draft.version, actor))

    def replace_manifest(self, draft: VersionInfo, manifest: Manifest, entry: LogEntry) -> VersionInfo:
        """Replace the manifest of a draft by one with the same tiles; return the draft, and log the change.

        Raises StateError if it is no longer a draft or was changed by another user, StoreError on a disk error.
        """
        data = encode_manifest(manifest)
        with self._locked(shared=True):
            new = replace(draft, manifest_sha256=self._blobs.put(data), manifest_bytes=len(data))
            with self._transactions.write() as connection:
                done = connection.execute(
                    """UPDATE versions SET manifest_sha256 = ?, manifest_bytes = ?
                       WHERE site = ? AND version = ? AND state = 'draft' AND manifest_sha256 = ?""",
                    (new.manifest_sha256, len(data), draft.site, draft.version, draft.manifest_sha256),
                )
                if not done.rowcount:
                    raise StateError(
                        f"draft {draft.version} of site {draft.site} was changed meanwhile by another operator; try again"
                    )
                connection.execute(
                    "UPDATE version_blobs SET sha256 = ? WHERE site = ? AND version = ? AND kind = 'manifest'",
                    (new.manifest_sha256, draft.site, draft.version),
                )
                self._transactions.log(connection, draft.site, entry)
        return new

    def check_bytes(self, version: VersionInfo) -> None:
        """Raise StoreError or MapFormatError unless all bytes of a version for robots are present and correct."""
        manifest = decode_manifest(self._blobs.get(version.manifest_sha256))
        for sha256 in (manifest.vocabulary.sha256, *(tile.sha256 for tile in manifest.tiles)):
            self._blobs.get(sha256)

    def verify(self) -> StoreFindings:
        with self._disk_errors():
            return verify(self._root, self._transactions, self._blobs)

    def collect_garbage(
        self, retention: Retention = _USUAL_RETENTION, *, dry_run: bool = False, actor: Actor = NOBODY
    ) -> Garbage:
        """Remove versions beyond retention and unreferenced files; raises StoreError on a disk error."""
        if dry_run:
            return collect(self._transactions, self._blobs, retention, dry_run=True, actor=actor)
        with self._locked(shared=False):
            garbage = collect(self._transactions, self._blobs, retention, dry_run=False, actor=actor)
            self._transactions.shrink(1 << 30)
            keep_reserve(self._root)
            return garbage

    def remove_survey_pictures(self, days: float, *, dry_run: bool = False) -> int:
        """Remove the surveys' pictures kept for longer from all versions, and return their number; StoreError on a disk error.

        Their age counts from their first build, whatever their recording's clock says. Indexes of versions, which are signed, still
        name them.
        """
        before_ns, old = self.now_ns() - int(days * 86_400e9), set[str]()
        with self._locked(shared=dry_run):
            for site in self.sites():
                for info in self.versions(site.site):
                    with suppress(StateError, MapFormatError):  # a version without pictures
                        pictures = self.survey_pictures(info.site, info.version)
                        old |= {one.sha256 for one in pictures if one.kept_ns < before_ns}
            if not dry_run and old:
                with self._transactions.write() as connection:
                    connection.executemany("DELETE FROM surfel_blobs WHERE sha256 = ?", [(sha256,) for sha256 in old])
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
        entries = [ExportBlob(kind="manifest", sha256=info.manifest_sha256, bytes=info.manifest_bytes)]
        entries.append(
            ExportBlob(kind="vocabulary", sha256=manifest.vocabulary.sha256, bytes=manifest.vocabulary.bytes)
        )
        tiles = {tile.sha256: tile.bytes for tile in manifest.tiles}
        entries += [ExportBlob(kind="tile", sha256=sha256, bytes=size) for sha256, size in tiles.items()]
        kept = extras(self._transactions, site, version) if archive else []
        if archive and info.archive_sha256 is not None:
            kept.append(("archive", info.archive_sha256))
        for kind, sha256 in kept:
            size = sum(len(chunk) for chunk in self._blobs.chunks(sha256))
            entries.append(ExportBlob(kind=cast(BlobKind, kind), sha256=sha256, bytes=size))
        return ExportHead(site=site, version=version, blobs=tuple(entries))

    def import_version(self, path: Path, *, actor: Actor = NOBODY) -> VersionInfo:
        """Import a version from an export file, as a draft of its site with its own number; publish it afterwards.

        Does nothing if the store already has it. Raises MapFormatError for an incomplete file, StateError
        if the site has another version of that number, StoreError on a disk error.
        """
        with open_export(path) as reader, self._locked(shared=True):
            reader.check_whole()
            manifest = reader.manifest()
            carried_evidence(manifest), trusted_calibrations(manifest)
            sha256 = reader.head.blobs[0].sha256
            known = self._known_import(manifest, sha256)
            if known is not None:
                return known
            reader.check_tiles(manifest)
            kept = {kind: [b.sha256 for b in reader.head.blobs if b.kind == kind] for kind in EXTRA_TABLES}
            for number, blob in enumerate(reader.head.blobs):
                self._blobs.put_chunks(reader.chunks(number), blob.sha256, blob.bytes)
            archive = reader.head.archive()
            with self._transactions.write() as connection:
                connection.execute("INSERT INTO sites (site) VALUES (?) ON CONFLICT DO NOTHING", (manifest.site,))
                self._known_import(manifest, sha256)
                draft = self._draft_row(manifest, None if archive is None else archive.sha256, None)
                log = LogEntry("saved", f"import as draft {manifest.version}", manifest.version, actor)
                insert_draft(self._transactions, connection, manifest, draft, log)
                insert_extras(connection, draft, kept)
        return self.version(manifest.site, manifest.version)

    def _building(self, site: str) -> dict[str, Any]:
        """Return the configuration entry of a new manifest with the map's pose in the building; empty if unknown.

        A first version, without a current one before it, has a frame of its own.
        """
        alignment = self.alignment(site)
        return {} if alignment is None else {BUILDING_KEY: to_plain(alignment.frame)}

    def _put_tile(self, tile: Tile) -> TileEntry:
        data = encode_tile(tile)
        sha256 = self._blobs.put(data)
        return TileEntry(x=tile.tile_x, y=tile.tile_y, sha256=sha256, bytes=len(data), landmarks=len(tile))

    def _draft_row(self, manifest: Manifest, archive_sha256: str | None, job: int | None) -> VersionInfo:
        """Return the row of a new draft; its manifest is on the disk when this returns."""
        data = encode_manifest(manifest)
        return VersionInfo(
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
            saved_ns=self.now_ns(),
            retired_ns=None,
            job=job,
        )

    def _known_import(self, manifest: Manifest, sha256: str) -> VersionInfo | None:
        known = self._find_version(manifest.site, manifest.version)
        if known is not None and known.manifest_sha256 != sha256:
            reason = f"site {manifest.site} has another version {manifest.version}; import it into a separate store"
            raise StateError(reason)
        return known

    def _repair_current_files(self) -> None:
        if not self._blobs.is_folder:
            return
        for row in self._transactions.query("SELECT site, manifest_sha256 FROM versions WHERE state = 'current'"):
            path = self._root / current_path(row["site"])
            if not is_plain_file(path) or b"".join(read_chunks(path)) != f"{row['manifest_sha256']}\n".encode():
                self._write_current_file(row["site"])

    def _write_current_file(self, site: str) -> None:
        """Write within a transaction, so that the file always matches the latest change of several processes."""
        path = self._root / current_path(site)
        with self._transactions.write(durable=False):
            current = self._current_row(site)
            assert current is not None
            check_no_link(self._root, path.parent)
            try:
                make_folder(path.parent)
                write_atomically(path, [f"{current.manifest_sha256}\n".encode()])
            except OSError as error:
                raise StoreError(
                    f"{path} cannot be written ({error.strerror}), though version {current.version} is current; free some "
                    "space and open the store again to repair it"
                ) from error

    @contextmanager
    def _locked(self, *, shared: bool) -> Iterator[None]:
        with self._disk_errors(), self._transactions.locked("lock", shared=shared):
            yield

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise StoreError(f"{error.filename or self._root}: {error.strerror}; check the store's disk") from error


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
