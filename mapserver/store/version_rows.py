"""SQL on versions, canaries and the history of current versions. `releases` decides the changes."""

from collections.abc import Iterable, Mapping, Set

from fleetmap.mapformat import Manifest
from fleetmap.mapformat.building import FOR_ROBOTS
from mapserver.store.rows import CanaryRow, LogEntry, ReleaseChanges, SiteReleases, VersionInfo
from mapserver.store.transactions import Connection, Transactions

EXTRA_TABLES = {"grid": "grid_blobs", "surfel": "surfel_blobs"}
"""By kind: table of the bytes of a version not needed by its robots; pictures of surveys are among the surfels."""

# The newest row of an earlier current version.
_ROLLBACK_TARGET = """
    SELECT id, version FROM currents
    WHERE site = ?1 AND version <> (SELECT version FROM versions WHERE site = ?1 AND state = 'current')
    ORDER BY id DESC LIMIT 1"""


def site_releases(transactions: Transactions, site: str) -> SiteReleases:
    """Return the state of a site's releases; empty for an unknown site."""
    rows = transactions.query("SELECT * FROM versions WHERE site = ? ORDER BY version", (site,))
    before = transactions.query(_ROLLBACK_TARGET, (site,))
    running = canaries(transactions, site, running=True)
    files = transactions.query("SELECT kind, sha256 FROM site_files WHERE site = ? ORDER BY kind", (site,))
    return SiteReleases(
        site=site,
        versions={row["version"]: VersionInfo(**row) for row in rows},
        rollback_target=before[0]["version"] if before else None,
        rollback_row=before[0]["id"] if before else None,
        canary=running[0] if running else None,
        files={row["kind"]: row["sha256"] for row in files if row["kind"] in FOR_ROBOTS},
    )


def canaries(transactions: Transactions, site: str | None, *, running: bool) -> list[CanaryRow]:
    """Return canaries (of a site), latest first."""
    query = "SELECT * FROM canaries WHERE (?1 IS NULL OR site = ?1) AND (?2 = 0 OR state = 'running') ORDER BY id DESC"
    return transactions.rows(CanaryRow, query, (site, int(running)))


def apply_changes(transactions: Transactions, connection: Connection, site: str, changes: ReleaseChanges) -> None:
    """Write the changes of a release, within its transaction."""
    now_ns = transactions.now_ns()
    for version, state in changes.states:
        set_state(connection, (site, version), state, now_ns)
    if changes.drop_currents_after is not None:
        connection.execute("DELETE FROM currents WHERE site = ? AND id > ?", (site, changes.drop_currents_after))
    if changes.new_current is not None:
        row = (site, changes.new_current, now_ns)
        connection.execute("INSERT INTO currents (site, version, since_ns) VALUES (?, ?, ?)", row)
    if (new := changes.new_canary) is not None:
        connection.execute(
            """INSERT INTO canaries (site, version, base_version, share, threshold, state, started_ns, actor, reason,
               outcome) VALUES (?, ?, ?, ?, ?, 'running', ?, ?, ?, '')""",
            (site, new.version, new.base_version, new.share, new.threshold, now_ns, new.actor.name, new.actor.reason),
        )
    if (end := changes.ended_canary) is not None:
        query = "UPDATE canaries SET state = ?, ended_ns = ?, outcome = ? WHERE id = ?"
        connection.execute(query, (end.state, now_ns, end.outcome, end.id))
    for entry in changes.log:
        transactions.log(connection, site, entry)


def set_state(connection: Connection, version: tuple[str, int], state: str, now_ns: int) -> None:
    """Set the state of (site, number), published, current or retired, with the time of the first and of the last."""
    connection.execute(
        """UPDATE versions SET state = ?, published_ns = coalesce(published_ns, ?), retired_ns = ?
           WHERE site = ? AND version = ?""",
        (state, now_ns, now_ns if state == "retired" else None, *version),
    )


def insert_draft(
    transactions: Transactions, connection: Connection, manifest: Manifest, draft: VersionInfo, log: LogEntry
) -> None:
    """Insert the rows of a new draft, within a transaction; its bytes are already on the disk."""
    row = {name: getattr(draft, name) for name in VersionInfo.__dataclass_fields__}
    connection.execute(f"INSERT INTO versions ({', '.join(row)}) VALUES ({', '.join(f':{name}' for name in row)})", row)
    query = "UPDATE sites SET last_version = ? WHERE site = ? AND last_version < ?"
    connection.execute(query, (draft.version, draft.site, draft.version))
    connection.executemany(
        "INSERT INTO version_blobs (site, version, kind, sha256) VALUES (?, ?, ?, ?)",
        [(draft.site, draft.version, kind, sha256) for kind, sha256 in sorted(references(draft, manifest))],
    )
    transactions.log(connection, draft.site, log)


def insert_extras(connection: Connection, draft: VersionInfo, extras: Mapping[str, Iterable[str]]) -> None:
    """Insert the bytes of a draft's grid and surfels, by their kind in EXTRA_TABLES, within a transaction."""
    for kind, addresses in extras.items():
        rows = [(draft.site, draft.version, sha256) for sha256 in sorted(set(addresses))]
        connection.executemany(f"INSERT INTO {EXTRA_TABLES[kind]} (site, version, sha256) VALUES (?, ?, ?)", rows)


def extras(transactions: Transactions, site: str, version: int) -> list[tuple[str, str]]:
    """Return kind and address of the bytes of a version's grid and surfels."""
    query = "SELECT sha256 FROM {} WHERE site = ? AND version = ? ORDER BY sha256"
    return [
        (kind, row["sha256"])
        for kind, table in EXTRA_TABLES.items()
        for row in transactions.query(query.format(table), (site, version))
    ]


def references(info: VersionInfo, manifest: Manifest) -> set[tuple[str, str]]:
    """Return kind and address of all bytes of a version."""
    found = {("manifest", info.manifest_sha256), ("vocabulary", manifest.vocabulary.sha256)}
    found |= {("tile", tile.sha256) for tile in manifest.tiles}
    return found | ({("archive", info.archive_sha256)} if info.archive_sha256 is not None else set())


def mentioned(transactions: Transactions, leaving: Set[tuple[str, int]] = frozenset()) -> set[str]:
    """Return the addresses that the database names, but for versions that leave."""
    tables = ("version_blobs", *EXTRA_TABLES.values())
    rows = [row for t in tables for row in transactions.query(f"SELECT site, version, sha256 FROM {t}")]
    kept = {row["sha256"] for row in rows if (row["site"], row["version"]) not in leaving}
    return kept | {row["sha256"] for row in transactions.query("SELECT sha256 FROM site_files")}
