"""Verification of a store: every hash, every reference, the database itself."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fleetmap.errors import FleetmapError
from fleetmap.mapformat import current_path, decode_manifest
from mapserver.store.blobs import Blobs
from mapserver.store.files import is_plain_file
from mapserver.store.rows import SiteReleases, VersionInfo
from mapserver.store.transactions import Transactions
from mapserver.store.version_rows import mentioned, references, site_releases


@dataclass(slots=True)
class StoreFindings:
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
    faults: list[str] = field(default_factory=list)


def verify(root: Path, transactions: Transactions, blobs: Blobs) -> StoreFindings:
    """Read everything in the store. Raises StoreError only if the database cannot be read at all."""
    found, trust = StoreFindings(), root / "trust"
    found.faults += [f"database: {text}" for text in transactions.faults()]
    found.faults += [
        f"{path} is a symbolic link, which a store does not follow"
        for path in (*blobs.links(), *sorted(path for path in (trust, *trust.rglob("*")) if path.is_symlink()))
    ]
    found.open_to_others = sum(bool(path.stat().st_mode & 0o077) for path in (root, *root.glob("store.sqlite3*")))
    sizes = blobs.sizes()
    sound = _check_blobs(transactions, blobs, sizes, found)
    sites = transactions.query("SELECT * FROM sites ORDER BY site")
    releases = [site_releases(transactions, row["site"]) for row in sites]
    for info in (info for rows in releases for info in rows.versions.values()):
        found.versions += 1
        found.faults += _version_faults(transactions, blobs, info, {sha256: sizes[sha256] for sha256 in sound})
    for row, rows in zip(sites, releases, strict=True):
        found.sites += 1
        found.faults += _site_faults(transactions, row, rows)
        if blobs.is_folder:
            path = root / current_path(rows.site)
            wanted = None if rows.current is None else f"{rows.current.manifest_sha256}\n"
            text = path.read_bytes()[:100].decode("ascii", "replace") if is_plain_file(path) else None
            if text != wanted:
                found.faults.append(f"{path} does not name the current version; open the store again to repair it")
        if any(info.state != "draft" and info.manifest_sha256 not in sound for info in rows.versions.values()):
            found.faults.append(f"site {rows.site}: a published version has no whole manifest")
    return found


def _check_blobs(transactions: Transactions, blobs: Blobs, sizes: dict[str, int], found: StoreFindings) -> set[str]:
    named, present = mentioned(transactions), sizes.keys()
    found.orphans = len(present - named)
    found.leftovers = len(blobs.leftovers())
    found.blobs = len(present)
    found.blob_bytes = sum(sizes.values())
    found.faults += [f"{blobs.where(sha256)} is missing" for sha256 in sorted(named - present)]
    damaged = {sha256 for sha256 in named & present if not blobs.is_whole(sha256)}
    found.faults += [f"{blobs.where(sha256)} is damaged" for sha256 in sorted(damaged)]
    return (named & present) - damaged


def _version_faults(transactions: Transactions, blobs: Blobs, info: VersionInfo, sound: dict[str, int]) -> list[str]:
    """Return the faults of a version. sound: sizes of all undamaged blobs."""
    name = f"version {info.version} of {info.site}"
    if info.manifest_sha256 not in sound:
        return []  # reported with the blobs, unless it is unreferenced
    try:
        manifest = decode_manifest(blobs.get(info.manifest_sha256))
    except FleetmapError as error:
        return [f"{name}: {error}"]
    faults = []
    query = "SELECT kind, sha256 FROM version_blobs WHERE site = ? AND version = ?"
    rows = transactions.query(query, (info.site, info.version))
    if {(row["kind"], row["sha256"]) for row in rows} != references(info, manifest):
        faults.append(f"{name}: the database and its manifest reference different bytes")
    names = ("site", "version", "parent", "tile_bytes", "landmarks")
    stored = (*(getattr(info, name) for name in names), info.tiles, info.vocabulary_sha256)
    made = (*(getattr(manifest, name) for name in names), len(manifest.tiles), manifest.vocabulary.sha256)
    if stored != made:
        faults.append(f"{name}: the database says {stored}, its manifest {made}")
    wrong = [tile for tile in manifest.tiles if sound.get(tile.sha256, tile.bytes) != tile.bytes]
    return faults + [f"{name}: tile {tile.x},{tile.y} has another size than in its manifest" for tile in wrong]


def _site_faults(transactions: Transactions, site: dict[str, Any], rows: SiteReleases) -> list[str]:
    faults, name = [], f"site {rows.site}"
    if rows.versions and max(rows.versions) > site["last_version"]:
        faults.append(f"{name}: version {max(rows.versions)} is beyond the last number {site['last_version']}")
    current = [number for number, info in rows.versions.items() if info.state == "current"]
    newest = transactions.query("SELECT version FROM currents WHERE site = ? ORDER BY id DESC LIMIT 1", (rows.site,))
    if [row["version"] for row in newest] != current:
        faults.append(f"{name}: current is {current}, but the history of current versions ends with {newest}")
    if not current and any(info.state in {"published", "retired"} for info in rows.versions.values()):
        faults.append(f"{name}: it has published versions, none of them current")
    return faults
