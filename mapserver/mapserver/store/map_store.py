"""The store of maps: versions of sites in one folder.

    DIR/store.sqlite3            sites, versions and their states, robots, jobs, events
    DIR/lock                     held alone while garbage is collected, shared while bytes come in that nothing mentions yet
    DIR/blobs/ab/<sha256>        tiles, manifests, vocabularies, archives, by content
    DIR/sites/<site>/current     the current manifest's address as text, for robots that read the folder; derived

Bytes are on the disk before the transaction that mentions them, so a crash leaves at most files that nothing mentions.
"""

import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Self

import msgspec

from fleetmap.errors import StateError, StoreError, UsageError
from fleetmap.mapformat import (
    BlobEntry,
    Manifest,
    Tile,
    TileEntry,
    check_name,
    current_path,
    decode_manifest,
    decode_tile,
    encode_manifest,
    encode_tile,
)
from mapserver.fleet_statistics.canary_test import threshold_for
from mapserver.quality.figures import Evidence
from mapserver.quality.gate import GateSettings, judge
from mapserver.store import lifecycle
from mapserver.store.canaries import start_canary, take_back_canary
from mapserver.store.export_import import ExportReader, open_export, write_export
from mapserver.store.files import locked, make_folder, read_file, sync_folder, write_atomically
from mapserver.store.fleet_rows import CanaryRow
from mapserver.store.garbage_collection import Garbage, Retention, collect
from mapserver.store.queries import StoreQueries
from mapserver.store.rows import NOBODY, Actor, DraftDetails, VersionInfo
from mapserver.store.verification import Findings, verify
from mapserver.store.version_diff import Difference, difference

_USUAL_GATE = GateSettings()
_USUAL_RETENTION = Retention()
_RECENT_NS = 2 * 86_400_000_000_000  # robots silent for longer do not count as somebody to try a version


class MapStore(StoreQueries):
    """One open store. Methods may be called from any thread; every process opens its own."""

    def __init__(self, root: Path, clock_ns: Callable[[], int]) -> None:
        super().__init__(root, clock_ns)
        try:
            sync_folder(root)
            self._repair_current_files()
        except BaseException:
            self._ledger.close()
            raise

    @classmethod
    def open(cls, path: Path, *, create: bool = False, clock_ns: Callable[[], int] = time.time_ns) -> Self:
        """The store in folder `path`, which is made with `create`. What is derived is repaired here.

        Raises StoreError where there is none or it cannot be opened, NewerFormatError for one made by a newer fleetmap.
        """
        try:
            if not (path / "store.sqlite3").is_file() and not create:
                raise StoreError(f"{path} holds no map store; check --store, or make one with `mapserver build`")
            make_folder(path / "sites")
            store = cls(path, clock_ns)
        except (OSError, sqlite3.Error) as error:
            raise StoreError(
                f"the store {path} cannot be opened ({error}); check the path, its rights and space"
            ) from error
        return store

    def close(self) -> None:
        """Closes the database; the store must not be used afterwards."""
        self._ledger.close()

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
        evidence: Evidence | None = None,
        actor: Actor = NOBODY,
    ) -> int:
        """The number of a new draft version of `site`, whole on the disk; evidence: what the gate will judge it by.

        Raises MapFormatError for tiles that cannot be encoded, StoreError where the disk refuses.
        """
        check_name(site, "site")
        with self._locked(shared=True):
            entries = tuple(sorted((self._put_tile(tile) for tile in tiles), key=lambda entry: (entry.x, entry.y)))
            vocabulary_entry = BlobEntry(sha256=self._blobs.put(vocabulary), bytes=len(vocabulary))
            archive_sha256 = None if archive is None else self._blobs.put(archive)
            with self._ledger.write() as connection:
                connection.execute("INSERT OR IGNORE INTO sites (site) VALUES (?)", (site,))
                last = connection.execute("SELECT last_version FROM sites WHERE site = ?", (site,)).fetchone()[0]
                current = self._current_row(site)
                manifest = Manifest(
                    site=site,
                    version=last + 1,
                    parent=None if current is None else current.version,
                    tiles=entries,
                    vocabulary=vocabulary_entry,
                    **{name: getattr(details, name) for name in details.__struct_fields__},
                )
                self._insert_version(connection, manifest, archive_sha256, f"draft {manifest.version}", actor)
                if evidence is not None:
                    connection.execute(
                        "INSERT INTO evidence (site, version, figures) VALUES (?, ?, ?)",
                        (site, manifest.version, msgspec.json.encode(evidence).decode()),
                    )
        return manifest.version

    def publish(
        self,
        site: str,
        version: int | None = None,
        *,
        actor: Actor = NOBODY,
        force: bool = False,
        gate: GateSettings = _USUAL_GATE,
    ) -> int:
        """Takes a draft (the newest one, if not named) through the gate, makes it current and returns its number.

        force: what the gate says is logged with the actor, and only its hard limits refuse.

        Raises UsageError where there is no such draft, GateRefusedError for one that is refused (its reasons stay with
        it), StoreError or MapFormatError for one whose bytes are not all there.
        """
        draft = self._draft(site, version)
        judged_against = self._pass_gate(draft, actor=actor, force=force, gate=gate)
        lifecycle.publish(self._ledger, draft, judged_against, actor)
        self._write_current_file(site)
        return draft.version

    def _pass_gate(self, draft: VersionInfo, *, actor: Actor, force: bool, gate: GateSettings) -> int | None:
        """The version that the draft was compared with; errors as of `publish`."""
        site = draft.site
        if force and not (actor.name and actor.reason):
            raise UsageError("publishing by force needs who and why; name --reason")
        self._check_bytes(draft)
        current = self._current_row(site)
        verdict = judge(
            self.manifest(site, draft.version),
            None if current is None else self.manifest(site, current.version),
            next(info.vocabulary_sha256 for info in self.sites() if info.site == site),
            gate,
            self.evidence(site, draft.version),
        )
        forced = force and bool(verdict.reasons) and not verdict.hard_reasons
        lifecycle.record_verdict(self._ledger, draft, verdict, forced=forced, actor=actor)
        if not verdict.accepted and not forced:
            raise lifecycle.refusal(draft, verdict)
        return None if current is None else current.version

    def promote(self, site: str, version: int, *, actor: Actor = NOBODY) -> None:
        """Makes a version that was published before the current one.

        Raises UsageError for an unknown version, StateError for a draft, StoreError or MapFormatError for one whose
        bytes are not all there.
        """
        wanted = self.version(site, version)
        self._check_bytes(wanted)
        lifecycle.promote(self._ledger, wanted, actor)
        self._write_current_file(site)

    def start_canary(
        self, site: str, version: int, share: float, *, actor: Actor = NOBODY, gate: GateSettings = _USUAL_GATE
    ) -> CanaryRow:
        """Lets a share of the site's robots run a version before the others; a draft goes through the gate first.

        Raises UsageError for an unknown version or a share outside of 0 to 1, StateError where the site has no current version,
        this is it, or a canary runs already, and what `publish` raises for drafts.
        """
        wanted, current = self.version(site, version), self._current_row(site)
        if not 0 < share < 1:
            raise UsageError(f"a canary of {share:g} of the robots: name a share between 0 and 1, such as 5%")
        if current is None or current.version == version:
            held = "has no current version" if current is None else f"has version {version} as its current one"
            raise StateError(f"site {site} {held}; a canary is compared with another, current version")
        if running := self.canaries(site, running=True):
            raise StateError(f"site {site} tries version {running[0].version} already; `rollback` takes it back")
        if wanted.state == "draft":
            self._pass_gate(wanted, actor=actor, force=False, gate=gate)
            lifecycle.admit(self._ledger, wanted, actor)
        else:
            self._check_bytes(wanted)
        recent_ns = self._clock_ns() - _RECENT_NS
        robots = [robot.robot for robot in self.robots(site) if robot.last_seen_ns >= recent_ns]
        threshold = threshold_for(share, site, version, robots)
        start_canary(self._ledger, self.version(site, version), current.version, share, threshold, actor)
        return self.canaries(site, running=True)[0]

    def end_canary(self, canary: CanaryRow, *, promote: bool, outcome: str, actor: Actor = NOBODY) -> None:
        """Makes the canary's version current, or takes it back from the robots that try it, and retires it.

        Raises StateError where it does not run any more, and what `promote` raises.
        """
        if promote:
            wanted = self.version(canary.site, canary.version)
            self._check_bytes(wanted)
            lifecycle.promote(self._ledger, wanted, Actor(actor.name, outcome), canary)
            self._write_current_file(canary.site)
        else:
            take_back_canary(self._ledger, canary, outcome, actor)

    def rollback(self, site: str, *, actor: Actor = NOBODY) -> int:
        """Makes the version current that was so before and returns its number; the one that is retires.

        While some robots try another version, that is taken back instead, and the current one stays.

        Raises StateError where none was current before, StoreError or MapFormatError if its bytes are not all there.
        """
        self._check_site(site)
        if running := self.canaries(site, running=True):
            outcome = f"taken back by hand: {actor.reason or 'no reason given'}"
            self.end_canary(running[0], promote=False, outcome=outcome, actor=actor)
            return running[0].base_version
        target = self._ledger.query(lifecycle.ROLLBACK_TARGET.replace(":site", "?1"), (site,))
        for row in target:
            self._check_bytes(self.version(site, row["version"]))
        version = lifecycle.roll_back(self._ledger, site, actor)
        self._write_current_file(site)
        return version

    def difference(self, site: str, before: int, after: int) -> Difference:
        """What changed between two versions of a site; errors as of `manifest`."""
        return difference(
            self.manifest(site, before),
            self.manifest(site, after),
            self.version(site, after).manifest_bytes,
            lambda sha256: decode_tile(self._blobs.get(sha256)),
        )

    def verify(self) -> Findings:
        """What is wrong with the store; reads all of it."""
        with self._disk_told():
            return verify(self._root, self._ledger, self._blobs)

    def collect_garbage(
        self, retention: Retention = _USUAL_RETENTION, *, dry_run: bool = False, actor: Actor = NOBODY
    ) -> Garbage:
        """Removes what is beyond retention and what nothing mentions; raises StoreError where the disk refuses."""
        with self._locked(shared=False):
            return collect(self._ledger, self._blobs, retention, dry_run=dry_run, actor=actor)

    def export_version(self, site: str, version: int, path: Path, *, archive: bool = True) -> int:
        """Writes a version into one file and returns its size; errors as of `manifest`, StoreError for the disk."""
        return write_export(
            path, self.version(site, version), self.manifest(site, version), self._blobs, archive=archive
        )

    def import_version(self, path: Path, *, actor: Actor = NOBODY) -> VersionInfo:
        """Takes a version out of an export file, as a draft of its site with its own number; publishing comes after.

        Does nothing where the store has it already. Raises MapFormatError for a file that is not whole, StateError
        where the site has another version of that number, StoreError where a disk refuses.
        """
        with open_export(path) as reader, self._locked(shared=True):
            reader.check_whole()
            manifest = reader.manifest()
            sha256 = reader.head.blobs[0].sha256
            known = self._known_import(manifest, sha256)
            if known is not None:
                return known
            reader.check_tiles(manifest)
            self._put_blobs(reader)
            archive = reader.head.archive()
            with self._ledger.write() as connection:
                connection.execute("INSERT OR IGNORE INTO sites (site) VALUES (?)", (manifest.site,))
                self._known_import(manifest, sha256)
                archive_sha256 = None if archive is None else archive.sha256
                self._insert_version(connection, manifest, archive_sha256, f"import as draft {manifest.version}", actor)
        return self.version(manifest.site, manifest.version)

    def _put_tile(self, tile: Tile) -> TileEntry:
        data = encode_tile(tile)
        return TileEntry(
            x=tile.tile_x, y=tile.tile_y, sha256=self._blobs.put(data), bytes=len(data), landmarks=len(tile)
        )

    def _insert_version(
        self,
        connection: sqlite3.Connection,
        manifest: Manifest,
        archive_sha256: str | None,
        detail: str,
        actor: Actor,
    ) -> None:
        data = encode_manifest(manifest)
        sha256 = self._blobs.put(data)
        lifecycle.insert_version(self._ledger, connection, manifest, sha256, len(data), archive_sha256)
        self._ledger.log(connection, manifest.site, "saved", detail, version=manifest.version, actor=actor)

    def _known_import(self, manifest: Manifest, sha256: str) -> VersionInfo | None:
        rows = self._ledger.query(
            "SELECT * FROM versions WHERE site = ? AND version = ?", (manifest.site, manifest.version)
        )
        if not rows:
            return None
        if rows[0]["manifest_sha256"] != sha256:
            raise StateError(
                f"site {manifest.site} has another version {manifest.version}; import it into a store of its own"
            )
        return VersionInfo(**rows[0])

    def _put_blobs(self, reader: ExportReader) -> None:
        for number, blob in enumerate(reader.head.blobs):
            self._blobs.put_chunks(reader.chunks(number), blob.sha256, blob.bytes)

    def _draft(self, site: str, version: int | None) -> VersionInfo:
        drafts = [info for info in self.versions(site) if info.state == "draft"]
        if version is None:
            if not drafts:
                raise UsageError(f"site {site} has no draft to publish; make one with `mapserver build --site {site}`")
            return drafts[-1]
        info = self.version(site, version)
        if info.state != "draft":
            raise StateError(f"version {version} of site {site} is {info.state}, only a draft can be published")
        return info

    def _check_bytes(self, draft: VersionInfo) -> None:
        manifest = decode_manifest(self._blobs.get(draft.manifest_sha256))
        for sha256 in (manifest.vocabulary.sha256, *(tile.sha256 for tile in manifest.tiles)):
            self._blobs.get(sha256)

    def _repair_current_files(self) -> None:
        for row in self._ledger.query("SELECT site, manifest_sha256 FROM versions WHERE state = 'current'"):
            path = self._root / current_path(row["site"])
            if not path.is_file() or read_file(path) != f"{row['manifest_sha256']}\n".encode():
                self._write_current_file(row["site"])

    def _write_current_file(self, site: str) -> None:
        """Within a transaction, so that of two processes the one that comes last writes what came last."""
        path = self._root / current_path(site)
        with self._ledger.write(durable=False):
            current = self._current_row(site)
            assert current is not None
            try:
                make_folder(path.parent)
                write_atomically(path, [f"{current.manifest_sha256}\n".encode()])
            except OSError as error:
                raise StoreError(
                    f"{path} cannot be written ({error.strerror}), though version {current.version} is current; make "
                    "space and open the store again to repair it"
                ) from error

    @contextmanager
    def _locked(self, *, shared: bool) -> Iterator[None]:
        with self._disk_told(), locked(self._root / "lock", shared=shared):
            yield

    @contextmanager
    def _disk_told(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise StoreError(f"{error.filename or self._root}: {error.strerror}; check the store's disk") from error
