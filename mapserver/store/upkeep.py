"""Garbage collection and verification of a store: every hash, every reference, the database itself."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import msgspec

from fleetmap.errors import FleetmapError
from fleetmap.mapformat.manifest import Manifest, decode_manifest
from fleetmap.mapformat.names import current_path
from mapserver.store.blobs import Blobs
from mapserver.store.database import Database
from mapserver.store.files import is_plain_file
from mapserver.store.queries import EXTRA_TABLES, Release, mentioned, site_releases
from mapserver.store.rows import Actor, Retention, SiteReleases, VersionInfo

_DAY_NS = 86_400_000_000_000


class Garbage(msgspec.Struct):
    """Result, real or of a dry run: (site, version) retired and removed, files and bytes freed."""

    retired: list[tuple[str, int]] = []
    removed: list[tuple[str, int]] = []
    files: int = 0
    freed_bytes: int = 0


class StoreFindings(msgspec.Struct):
    """Result of a verification. faults: each a sentence, empty for an intact store.

    orphans and leftovers: unreferenced files, as left by a killed process; `gc` removes them. open_to_others: True if
    other users of the machine can read the folder or its database.
    """

    sites: int = 0
    versions: int = 0
    blobs: int = 0
    blob_bytes: int = 0
    orphans: int = 0
    leftovers: int = 0
    open_to_others: int = 0
    faults: list[str] = []


def collect(database: Database, blobs: Blobs, retention: Retention, actor: Actor | None) -> Garbage:
    """Remove versions first; this must be on the disk before the first file is deleted. The caller holds the exclusive lock.

    Never removed: current versions, canaries, rollback targets, versions in use by robots. actor: None for a dry run.
    """
    garbage = Garbage()
    with nullcontext() if actor is None else database.write() as change:
        for site in database.column("SELECT site FROM sites ORDER BY site"):
            retired, removed = _planned(database, site_releases(database, site), retention)
            garbage.retired += [(site, version) for version in retired]
            garbage.removed += [(site, version) for version in removed]
            if change is None or actor is None:
                continue
            release = Release(database, change, site)
            for version in retired:
                release.set_state(version, "retired")
                release.log("retired", f"version {version}", version, actor)
            for version in removed:
                for table in ("currents", "verdicts", "evidence", *EXTRA_TABLES.values(), "version_blobs", "versions"):
                    change.execute(f"DELETE FROM {table} WHERE site = ? AND version = ?", (site, version))
                release.log("removed", f"version {version}", version, actor)
    kept = mentioned(database, set(garbage.removed) if actor is None else frozenset())
    unmentioned = {sha256: size for sha256, size in sorted(blobs.sizes().items()) if sha256 not in kept}
    for name, size_bytes in (unmentioned | blobs.leftovers()).items():
        if actor is not None:
            blobs.remove(name)
        garbage.freed_bytes += size_bytes
        garbage.files += 1
    return garbage


def _planned(database: Database, rows: SiteReleases, retention: Retention) -> tuple[list[int], list[int]]:
    """Return the versions of a site that are to be retired, and removed."""
    now_ns, versions = database.now_ns(), rows.versions.values()
    old_ns, silent_ns = (now_ns - int(days * _DAY_NS) for days in (retention.keep_days, retention.robot_days))
    query = "SELECT DISTINCT version FROM robots WHERE site = ? AND version IS NOT NULL AND last_seen_ns >= ?"
    needed = {rows.rollback_target, *database.column(query, (rows.site, silent_ns))}
    needed |= {each.version for each in (rows.current, rows.canary) if each is not None}

    def beyond(state: str, keep: int) -> list[VersionInfo]:
        every = [info for info in versions if info.state == state]
        return sorted(every, key=lambda info: (info.published_ns or 0, info.version), reverse=True)[keep:]

    surplus = [info.version for info in beyond("published", retention.keep_versions) if info.version not in needed]
    gone = [info.version for info in versions if info.state == "retired" and (info.retired_ns or 0) <= old_ns]
    gone += surplus if retention.keep_days <= 0 else []
    gone += [info.version for info in beyond("draft", retention.keep_drafts) if info.saved_ns <= old_ns]
    return surplus, sorted(version for version in gone if version not in needed)


def columns_of(manifest: Manifest) -> dict[str, Any]:
    """Return the columns of a version that follow from its manifest."""
    names = ("site", "version", "parent", "created", "tile_bytes", "landmarks")
    vocabulary = {"vocabulary_sha256": manifest.vocabulary.sha256, "vocabulary_bytes": manifest.vocabulary.bytes}
    return {name: getattr(manifest, name) for name in names} | {"tiles": len(manifest.tiles)} | vocabulary


def references(info: VersionInfo, manifest: Manifest) -> set[tuple[str, str]]:
    """Return kind and address of all bytes of a version."""
    found = {("manifest", info.manifest_sha256), ("vocabulary", manifest.vocabulary.sha256)}
    found |= {("tile", tile.sha256) for tile in manifest.tiles}
    return found | ({("archive", info.archive_sha256)} if info.archive_sha256 is not None else set())


def verify(root: Path, database: Database, blobs: Blobs) -> StoreFindings:
    """Read everything in the store."""
    sizes, named = blobs.sizes(), mentioned(database)
    trust = root / "trust"
    links = [*blobs.links(), *sorted(path for path in (trust, *trust.rglob("*")) if path.is_symlink())]
    missing = named - sizes.keys()
    damaged = {sha256 for sha256 in named - missing if not blobs.is_whole(sha256)}
    sound = {sha256: sizes[sha256] for sha256 in named - missing - damaged}
    found = StoreFindings(
        blobs=len(sizes),
        blob_bytes=sum(sizes.values()),
        orphans=len(sizes.keys() - named),
        leftovers=len(blobs.leftovers()),
        open_to_others=sum(bool(path.stat().st_mode & 0o077) for path in (root, *root.glob("store.sqlite3*"))),
        faults=[f"database: {text}" for text in database.faults()]
        + [f"{path} is a symbolic link, which a store does not follow" for path in links]
        + [f"{blobs.where(sha256)} is missing" for sha256 in sorted(missing)]
        + [f"{blobs.where(sha256)} is damaged" for sha256 in sorted(damaged)],
    )
    for site in database.query("SELECT site, last_version FROM sites ORDER BY site"):
        rows = site_releases(database, site["site"])
        found.sites += 1
        found.versions += len(rows.versions)
        for info in rows.versions.values():
            found.faults += _version_faults(database, blobs, info, sound)
        found.faults += _site_faults(database, site["last_version"], rows)
        if any(info.state != "draft" and info.manifest_sha256 not in sound for info in rows.versions.values()):
            found.faults.append(f"site {rows.site}: a published version has no whole manifest")
        wanted = None if rows.current is None else f"{rows.current.manifest_sha256}\n".encode()
        path = root / current_path(rows.site)
        if blobs.is_folder and (path.read_bytes()[:100] if is_plain_file(path) else None) != wanted:
            found.faults.append(f"{path} does not name the current version; open the store again to repair it")
    return found


def _version_faults(database: Database, blobs: Blobs, info: VersionInfo, sound: dict[str, int]) -> list[str]:
    """Return the faults of a version. sound: sizes of all undamaged blobs."""
    if info.manifest_sha256 not in sound:
        return []  # reported with the blobs, unless it is unreferenced
    name = f"version {info.version} of {info.site}"
    try:
        manifest = decode_manifest(blobs.get(info.manifest_sha256))
    except FleetmapError as error:
        return [f"{name}: {error}"]
    faults = []
    query = "SELECT kind, sha256 FROM version_blobs WHERE site = ? AND version = ?"
    rows = database.query(query, (info.site, info.version))
    if {(row["kind"], row["sha256"]) for row in rows} != references(info, manifest):
        faults.append(f"{name}: the database and its manifest reference different bytes")
    made = columns_of(manifest)
    if (stored := {column: getattr(info, column) for column in made}) != made:
        faults.append(f"{name}: the database says {stored}, its manifest {made}")
    wrong = [tile for tile in manifest.tiles if sound.get(tile.sha256, tile.bytes) != tile.bytes]
    return faults + [f"{name}: tile {tile.x},{tile.y} has another size than in its manifest" for tile in wrong]


def _site_faults(database: Database, last_version: int, rows: SiteReleases) -> list[str]:
    faults, name = [], f"site {rows.site}"
    if rows.versions and max(rows.versions) > last_version:
        faults.append(f"{name}: version {max(rows.versions)} is beyond the last number {last_version}")
    current = [number for number, info in rows.versions.items() if info.state == "current"]
    newest = database.column("SELECT version FROM currents WHERE site = ? ORDER BY id DESC LIMIT 1", (rows.site,))
    if newest != current:
        faults.append(f"{name}: current is {current}, but the history of current versions ends with {newest}")
    if not current and any(info.state in {"published", "retired"} for info in rows.versions.values()):
        faults.append(f"{name}: it has published versions, none of them current")
    return faults
