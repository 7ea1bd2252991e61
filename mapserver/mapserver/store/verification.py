"""Whether a store is what it claims to be: every hash, every reference, the database itself."""

from dataclasses import dataclass, field
from pathlib import Path

from fleetmap.errors import FleetmapError
from fleetmap.mapformat import Manifest, current_path, decode_manifest
from mapserver.store.blobs import BlobFolder
from mapserver.store.rows import VersionInfo
from mapserver.store.transactions import Transactions
from mapserver.store.version_rows import references


@dataclass(slots=True)
class StoreFindings:
    """What was found. faults: each a sentence, none in a sound store.

    orphans and leftovers are files that nothing mentions, as a killed process leaves them; `gc` removes them.
    """

    sites: int = 0
    versions: int = 0
    blobs: int = 0
    blob_bytes: int = 0
    orphans: int = 0
    leftovers: int = 0
    faults: list[str] = field(default_factory=list)


def verify(root: Path, transactions: Transactions, blobs: BlobFolder) -> StoreFindings:
    """Reads everything in the store. Raises StoreError only where the database cannot be read at all."""
    found = StoreFindings()
    found.faults += [f"database: {row['integrity_check']}" for row in _unless_ok(transactions)]
    found.faults += [f"database: a row of {row['table']} refers to nothing" for row in transactions.query(_FOREIGN)]
    sound = _check_blobs(transactions, blobs, found)
    for row in transactions.query("SELECT * FROM versions ORDER BY site, version"):
        found.versions += 1
        _check_version(transactions, blobs, VersionInfo(**row), sound, found)
    for row in transactions.query("SELECT * FROM sites ORDER BY site"):
        found.sites += 1
        _check_site(root, transactions, row["site"], row["last_version"], row["vocabulary_sha256"], sound, found)
    return found


_FOREIGN = "PRAGMA foreign_key_check"


def _unless_ok(transactions: Transactions) -> list[dict[str, str]]:
    return [row for row in transactions.query("PRAGMA integrity_check") if row["integrity_check"] != "ok"]


def _check_blobs(transactions: Transactions, blobs: BlobFolder, found: StoreFindings) -> set[str]:
    """The addresses whose bytes are whole."""
    mentioned = {row["sha256"] for row in transactions.query("SELECT DISTINCT sha256 FROM version_blobs")}
    mentioned |= {
        row["vocabulary_sha256"]
        for row in transactions.query("SELECT vocabulary_sha256 FROM sites WHERE vocabulary_sha256 IS NOT NULL")
    }
    present = blobs.addresses()
    found.orphans = len(present - mentioned)
    found.leftovers = len(blobs.strangers())
    found.blobs = len(present)
    found.blob_bytes = sum(blobs.path(sha256).stat().st_size for sha256 in present)
    found.faults += [f"{blobs.path(sha256)} is missing" for sha256 in sorted(mentioned - present)]
    damaged = {sha256 for sha256 in mentioned & present if not blobs.is_whole(sha256)}
    found.faults += [f"{blobs.path(sha256)} is damaged" for sha256 in sorted(damaged)]
    return (mentioned & present) - damaged


def _check_version(
    transactions: Transactions, blobs: BlobFolder, info: VersionInfo, sound: set[str], found: StoreFindings
) -> None:
    name = f"version {info.version} of {info.site}"
    if info.manifest_sha256 not in sound:
        return  # told with the blobs, unless nothing mentions it
    try:
        manifest = decode_manifest(blobs.get(info.manifest_sha256))
    except FleetmapError as error:
        found.faults.append(f"{name}: {error}")
        return
    rows = transactions.query(
        "SELECT kind, sha256 FROM version_blobs WHERE site = ? AND version = ?", (info.site, info.version)
    )
    if {(row["kind"], row["sha256"]) for row in rows} != references(info, manifest):
        found.faults.append(f"{name}: the database does not mention exactly the bytes of its manifest")
    if _figures_of(manifest) != _figures(info):
        found.faults.append(f"{name}: the database says {_figures(info)}, its manifest {_figures_of(manifest)}")
    for tile in manifest.tiles:
        if tile.sha256 in sound and blobs.path(tile.sha256).stat().st_size != tile.bytes:
            found.faults.append(f"{name}: tile {tile.x},{tile.y} has another size than its manifest says")


def _figures(info: VersionInfo) -> tuple[object, ...]:
    return (info.site, info.version, info.parent, info.tiles, info.tile_bytes, info.landmarks, info.vocabulary_sha256)


def _figures_of(manifest: Manifest) -> tuple[object, ...]:
    return (
        manifest.site, manifest.version, manifest.parent, len(manifest.tiles), manifest.tile_bytes,
        manifest.landmarks, manifest.vocabulary.sha256,
    )  # fmt: skip


def _check_site(
    root: Path,
    transactions: Transactions,
    site: str,
    last_version: int,
    vocabulary: str | None,
    sound: set[str],
    found: StoreFindings,
) -> None:
    versions = {v["version"]: v for v in transactions.query("SELECT * FROM versions WHERE site = ?", (site,))}
    if versions and max(versions) > last_version:
        found.faults.append(f"site {site}: version {max(versions)} is beyond the last number {last_version}")
    current = [number for number, row in versions.items() if row["state"] == "current"]
    newest = transactions.query("SELECT version FROM currents WHERE site = ? ORDER BY id DESC LIMIT 1", (site,))
    if [row["version"] for row in newest] != current:
        found.faults.append(f"site {site}: current is {current}, the record of what was current ends with {newest}")
    if current and vocabulary != versions[current[0]]["vocabulary_sha256"]:
        found.faults.append(f"site {site}: the current version has another vocabulary than the site")
    if not current and any(row["state"] in {"published", "retired"} for row in versions.values()):
        found.faults.append(f"site {site}: it has published versions, none of them current")
    path = root / current_path(site)
    wanted = f"{versions[current[0]]['manifest_sha256']}\n" if current else None
    text = path.read_text("ascii", "replace") if path.is_file() else None
    if text != wanted:
        found.faults.append(f"{path} does not name the current version; open the store again to repair it")
    if any(row["state"] != "draft" and row["manifest_sha256"] not in sound for row in versions.values()):
        found.faults.append(f"site {site}: a published version has no whole manifest")
