"""Which version is current: publishing, promoting, rolling back. Each is one transaction that is on the disk when it ends.

draft -> current when published; current -> published when another becomes current, -> retired when it is rolled back;
published -> retired by `gc`, once newer ones are enough; published or retired -> current when promoted.
"""

import json
import sqlite3

from fleetmap.errors import GateRefusedError, StateError
from fleetmap.mapformat import Manifest
from mapserver.quality.gate import Verdict
from mapserver.store.canaries import check_running, close_canary
from mapserver.store.fleet_rows import CanaryRow
from mapserver.store.rows import Actor, VersionInfo
from mapserver.store.transactions import Transactions

# The row of what was current before what is current now.
ROLLBACK_TARGET = """
    SELECT id, version FROM currents
    WHERE site = :site AND version <> (SELECT version FROM versions WHERE site = :site AND state = 'current')
    ORDER BY id DESC LIMIT 1"""


def record_verdict(ledger: Transactions, draft: VersionInfo, verdict: Verdict, *, forced: bool, actor: Actor) -> None:
    """Keeps what the gate said; a refusal also stands in the log."""
    reasons = [*verdict.hard_reasons, *verdict.reasons]
    with ledger.write() as connection:
        connection.execute(
            """INSERT INTO verdicts (site, version, stamp_ns, accepted, forced, reasons, report)
               VALUES (?, ?, ?, ?, ?, ?, ?)""",
            (
                draft.site,
                draft.version,
                ledger.now_ns(),
                int(verdict.accepted),
                int(forced),
                json.dumps(reasons),
                json.dumps(verdict.report, sort_keys=True),
            ),
        )
        if reasons:
            kind = "forced" if forced else "refused"
            detail = f"draft {draft.version}: {'; '.join(reasons)}"
            ledger.log(connection, draft.site, kind, detail, version=draft.version, actor=actor)


def refusal(draft: VersionInfo, verdict: Verdict) -> GateRefusedError:
    """The error for a refused draft."""
    reasons = "; ".join((*verdict.hard_reasons, *verdict.reasons))
    way_out = (
        "this cannot be forced"
        if verdict.hard_reasons
        else "`mapserver inspect` shows the draft, `publish --force --reason TEXT` publishes it all the same"
    )
    return GateRefusedError(f"draft {draft.version} of {draft.site} is refused: {reasons}; {way_out}")


def admit(ledger: Transactions, draft: VersionInfo, actor: Actor) -> None:
    """Makes a draft a published version that is not current, for robots that try it first."""
    with ledger.write() as connection:
        done = connection.execute(
            "UPDATE versions SET state = 'published', published_ns = ? WHERE site = ? AND version = ? AND state = 'draft'",
            (ledger.now_ns(), draft.site, draft.version),
        ).rowcount
        if done != 1:
            raise StateError(f"version {draft.version} of site {draft.site} is no draft any more; look at `versions`")
        detail = f"version {draft.version}, not current yet"
        ledger.log(connection, draft.site, "admitted", detail, version=draft.version, actor=actor)


def publish(ledger: Transactions, draft: VersionInfo, judged_against: int | None, actor: Actor) -> None:
    """Makes a draft current that was compared with version `judged_against`; StateError where someone was faster."""
    with ledger.write() as connection:
        left = _leave_current(connection, draft.site, "published")
        if left != judged_against:
            raise StateError(
                f"version {left} of site {draft.site} became current while draft {draft.version} was compared with "
                f"{judged_against}; publish again"
            )
        done = connection.execute(
            """UPDATE versions SET state = 'current', published_ns = ?
               WHERE site = ? AND version = ? AND state = 'draft'""",
            (ledger.now_ns(), draft.site, draft.version),
        ).rowcount
        if done != 1:
            raise StateError(f"version {draft.version} of site {draft.site} is no draft any more; look at `versions`")
        connection.execute(
            "UPDATE sites SET vocabulary_sha256 = coalesce(vocabulary_sha256, ?) WHERE site = ?",
            (draft.vocabulary_sha256, draft.site),
        )
        _enter_current(ledger, connection, draft.site, draft.version)
        close_canary(ledger, connection, draft.site, draft.version, actor)
        detail = f"version {draft.version}, " + ("the first" if left is None else f"replacing {left}")
        ledger.log(connection, draft.site, "published", detail, version=draft.version, actor=actor)


def promote(ledger: Transactions, wanted: VersionInfo, actor: Actor, canary: CanaryRow | None = None) -> None:
    """Makes a published or retired version current; raises StateError for a draft, nothing happens to the current.

    canary: only while this one runs; StateError where it does not.
    """
    if wanted.state == "current":
        return
    if wanted.state == "draft":
        raise StateError(
            f"version {wanted.version} of site {wanted.site} is a draft; `mapserver publish --version "
            f"{wanted.version}` takes it through the gate"
        )
    with ledger.write() as connection:
        if canary is not None:
            check_running(connection, canary)
        left = _leave_current(connection, wanted.site, "published")
        _make_current(connection, wanted.site, wanted.version)
        _enter_current(ledger, connection, wanted.site, wanted.version)
        close_canary(ledger, connection, wanted.site, wanted.version, actor)
        detail = f"version {wanted.version}, replacing {left}"
        ledger.log(connection, wanted.site, "promoted", detail, version=wanted.version, actor=actor)


def roll_back(ledger: Transactions, site: str, actor: Actor) -> int:
    """Makes the version current that was so before, retires the one that is, and returns the number.

    Raises StateError where none was current before.
    """
    with ledger.write() as connection:
        found = connection.execute(ROLLBACK_TARGET, {"site": site}).fetchone()
        if found is None:
            raise StateError(f"site {site} has no version that was current before; `versions` shows what to promote")
        target_id, version = found
        connection.execute("DELETE FROM currents WHERE site = ? AND id > ?", (site, target_id))
        left = _leave_current(connection, site, "retired")
        connection.execute(
            "UPDATE versions SET retired_ns = ? WHERE site = ? AND version = ?", (ledger.now_ns(), site, left)
        )
        _make_current(connection, site, version)
        ledger.log(connection, site, "rolled_back", f"from version {left} to {version}", version=version, actor=actor)
    return int(version)


def insert_version(
    ledger: Transactions,
    connection: sqlite3.Connection,
    manifest: Manifest,
    manifest_sha256: str,
    manifest_bytes: int,
    archive_sha256: str | None,
) -> None:
    """The rows of a new draft, within a transaction; its bytes are on the disk already."""
    row = {
        "site": manifest.site,
        "version": manifest.version,
        "state": "draft",
        "parent": manifest.parent,
        "created": manifest.created,
        "manifest_sha256": manifest_sha256,
        "manifest_bytes": manifest_bytes,
        "tiles": len(manifest.tiles),
        "tile_bytes": manifest.tile_bytes,
        "landmarks": manifest.landmarks,
        "vocabulary_sha256": manifest.vocabulary.sha256,
        "vocabulary_bytes": manifest.vocabulary.bytes,
        "archive_sha256": archive_sha256,
        "saved_ns": ledger.now_ns(),
    }
    marks = ", ".join(f":{name}" for name in row)
    connection.execute(f"INSERT INTO versions ({', '.join(row)}) VALUES ({marks})", row)
    connection.execute(
        "UPDATE sites SET last_version = max(last_version, ?) WHERE site = ?", (manifest.version, manifest.site)
    )
    blobs = [("manifest", manifest_sha256), ("vocabulary", manifest.vocabulary.sha256)]
    blobs += [("tile", tile.sha256) for tile in manifest.tiles]
    blobs += [("archive", archive_sha256)] if archive_sha256 is not None else []
    connection.executemany(
        "INSERT OR IGNORE INTO version_blobs (site, version, kind, sha256) VALUES (?, ?, ?, ?)",
        [(manifest.site, manifest.version, kind, sha256) for kind, sha256 in blobs],
    )


def _leave_current(connection: sqlite3.Connection, site: str, state: str) -> int | None:
    row = connection.execute("SELECT version FROM versions WHERE site = ? AND state = 'current'", (site,)).fetchone()
    if row is None:
        return None
    connection.execute("UPDATE versions SET state = ? WHERE site = ? AND version = ?", (state, site, row[0]))
    return int(row[0])


def _make_current(connection: sqlite3.Connection, site: str, version: int) -> None:
    done = connection.execute(
        """UPDATE versions SET state = 'current', retired_ns = NULL
           WHERE site = ? AND version = ? AND state IN ('published', 'retired')""",
        (site, version),
    ).rowcount
    if done != 1:
        raise StateError(f"version {version} of site {site} is not published any more; look at `mapserver versions`")


def _enter_current(ledger: Transactions, connection: sqlite3.Connection, site: str, version: int) -> None:
    connection.execute(
        "INSERT INTO currents (site, version, since_ns) VALUES (?, ?, ?)", (site, version, ledger.now_ns())
    )
