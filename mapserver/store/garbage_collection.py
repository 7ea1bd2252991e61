"""Garbage collection: versions beyond retention, unreferenced bytes, files left by killed processes."""

from dataclasses import dataclass, field

from mapserver.store.blobs import Blobs
from mapserver.store.rows import Actor, LogEntry
from mapserver.store.transactions import Transactions
from mapserver.store.version_rows import EXTRA_TABLES, mentioned, set_state, site_releases

_DAY_NS = 86_400_000_000_000


@dataclass(frozen=True, slots=True)
class Retention:
    """Retention rules. keep_versions, keep_drafts: the newest of each site, besides protected ones.

    keep_days: time for which a retired version or superfluous draft is kept; robot_days: time for which a silent robot counts as
    using the version that it reported.
    """

    keep_versions: int = 5
    keep_drafts: int = 3
    keep_days: float = 7.0
    robot_days: float = 30.0


@dataclass(slots=True)
class Garbage:
    """Result, real or of a dry run: (site, version) retired and removed, files and bytes freed."""

    retired: list[tuple[str, int]] = field(default_factory=list)
    removed: list[tuple[str, int]] = field(default_factory=list)
    files: int = 0
    freed_bytes: int = 0


def collect(transactions: Transactions, blobs: Blobs, retention: Retention, *, dry_run: bool, actor: Actor) -> Garbage:
    """Remove versions first; this must be on the disk before the first file is deleted. The caller holds the exclusive lock.

    Never removed: current versions, canaries, rollback targets, versions in use by robots.
    """
    garbage = Garbage()
    if dry_run:
        _plan(transactions, retention, garbage)
    else:
        with transactions.write() as connection:
            _plan(transactions, retention, garbage)
            for site, version in garbage.retired:
                set_state(connection, (site, version), "retired", transactions.now_ns())
                transactions.log(connection, site, LogEntry("retired", f"version {version}", version, actor))
            for site, version in garbage.removed:
                for table in ("currents", "verdicts", "evidence", *EXTRA_TABLES.values(), "version_blobs", "versions"):
                    connection.execute(f"DELETE FROM {table} WHERE site = ? AND version = ?", (site, version))
                transactions.log(connection, site, LogEntry("removed", f"version {version}", version, actor))
    kept = mentioned(transactions, set(garbage.removed) if dry_run else set())
    unmentioned = {sha256: size for sha256, size in sorted(blobs.sizes().items()) if sha256 not in kept}
    for found, remove in ((unmentioned, blobs.remove), (blobs.leftovers(), blobs.remove_leftover)):
        for name, size_bytes in found.items():
            if not dry_run:
                remove(name)
            garbage.freed_bytes += size_bytes
            garbage.files += 1
    return garbage


def _plan(transactions: Transactions, retention: Retention, garbage: Garbage) -> None:
    now_ns = transactions.now_ns()
    old_ns = now_ns - int(retention.keep_days * _DAY_NS)
    for row in transactions.query("SELECT site FROM sites ORDER BY site"):
        site = row["site"]
        releases = site_releases(transactions, site)
        versions = releases.versions.values()
        robots = transactions.query(
            "SELECT DISTINCT version FROM robots WHERE site = ? AND version IS NOT NULL AND last_seen_ns >= ?",
            (site, now_ns - int(retention.robot_days * _DAY_NS)),
        )
        current = None if releases.current is None else releases.current.version
        tried = None if releases.canary is None else releases.canary.version
        needed = {current, tried, releases.rollback_target, *(row["version"] for row in robots)}
        published = sorted(
            (v for v in versions if v.state == "published"),
            key=lambda v: (v.published_ns or 0, v.version),
            reverse=True,
        )
        surplus = [v for v in published[retention.keep_versions :] if v.version not in needed]
        garbage.retired += [(site, v.version) for v in surplus]
        drafts = sorted((v.version for v in versions if v.state == "draft"), reverse=True)[retention.keep_drafts :]
        gone = [v for v in versions if v.state == "retired" and (v.retired_ns or 0) <= old_ns]
        gone += surplus if retention.keep_days <= 0 else []
        gone += [v for v in versions if v.version in drafts and v.saved_ns <= old_ns]
        garbage.removed += sorted((site, v.version) for v in gone if v.version not in needed)
