"""Versions that some robots try before the others, as rows. What they change of versions is in the same transaction."""

import sqlite3

from fleetmap.errors import StateError
from mapserver.store.fleet_rows import CanaryRow
from mapserver.store.rows import Actor, VersionInfo
from mapserver.store.transactions import Transactions


def canaries(ledger: Transactions, site: str | None, *, running: bool) -> list[CanaryRow]:
    """Canaries (of a site), the last one first."""
    rows = ledger.query(
        """SELECT * FROM canaries WHERE (?1 IS NULL OR site = ?1) AND (?2 = 0 OR state = 'running') ORDER BY id DESC""",
        (site, int(running)),
    )
    return [CanaryRow(**row) for row in rows]


def start_canary(
    ledger: Transactions, version: VersionInfo, base_version: int, share: float, threshold: float, actor: Actor
) -> None:
    """Begins; StateError where another process began one meanwhile, or made another version current."""
    with ledger.write() as connection:
        # A second look under the lock: others may have acted since the first.
        current = connection.execute(
            "SELECT version FROM versions WHERE site = ? AND state = 'current'", (version.site,)
        ).fetchone()
        if current is None or current[0] != base_version or _running(connection, version.site) is not None:
            raise StateError(
                f"site {version.site} was changed by somebody else meanwhile; look at `versions`, try again"
            )
        connection.execute(
            "UPDATE versions SET state = 'published', retired_ns = NULL WHERE site = ? AND version = ?",
            (version.site, version.version),
        )
        connection.execute(
            """INSERT INTO canaries (site, version, base_version, share, threshold, state, started_ns, actor, reason,
               outcome) VALUES (?, ?, ?, ?, ?, 'running', ?, ?, ?, '')""",
            (
                version.site, version.version, base_version, share, threshold, ledger.now_ns(), actor.name, actor.reason,
            ),
        )  # fmt: skip
        detail = f"version {version.version} for {share:.1%} of the robots, beside version {base_version}"
        ledger.log(connection, version.site, "canary_started", detail, version=version.version, actor=actor)


def take_back_canary(ledger: Transactions, canary: CanaryRow, outcome: str, actor: Actor) -> None:
    """Ends it and retires its version. StateError where it does not run any more."""
    with ledger.write() as connection:
        check_running(connection, canary)
        _end(ledger, connection, canary.id, "rolled_back", outcome)
        connection.execute(
            """UPDATE versions SET state = 'retired', retired_ns = ?
               WHERE site = ? AND version = ? AND state = 'published'""",
            (ledger.now_ns(), canary.site, canary.version),
        )
        who = Actor(actor.name, outcome)
        detail = f"version {canary.version}; version {canary.base_version} stays current"
        ledger.log(connection, canary.site, "canary_rolled_back", detail, version=canary.version, actor=who)


def check_running(connection: sqlite3.Connection, canary: CanaryRow) -> None:
    """Raises StateError where it does not run any more, within the transaction that wants to end it."""
    running = _running(connection, canary.site)
    if running is None or running[0] != canary.id:
        raise StateError(f"version {canary.version} of site {canary.site} is not tried any more; look at `versions`")


def close_canary(ledger: Transactions, connection: sqlite3.Connection, site: str, version: int, actor: Actor) -> None:
    """Ends what runs at a site where `version` becomes current, within that transaction: its comparison is over."""
    running = _running(connection, site)
    if running is None:
        return
    number, tried = running
    is_promoted = tried == version
    outcome = actor.reason if is_promoted and actor.reason else f"version {version} became current"
    _end(ledger, connection, number, "promoted" if is_promoted else "stopped", outcome)
    kind = "canary_promoted" if is_promoted else "canary_stopped"
    ledger.log(connection, site, kind, f"version {tried}", version=tried, actor=Actor(actor.name, outcome))


def _running(connection: sqlite3.Connection, site: str) -> tuple[int, int] | None:
    """Id and version of what runs at a site."""
    row: tuple[int, int] | None = connection.execute(
        "SELECT id, version FROM canaries WHERE site = ? AND state = 'running'", (site,)
    ).fetchone()
    return row


def _end(ledger: Transactions, connection: sqlite3.Connection, number: int, state: str, outcome: str) -> None:
    connection.execute(
        "UPDATE canaries SET state = ?, ended_ns = ?, outcome = ? WHERE id = ?",
        (state, ledger.now_ns(), outcome, number),
    )
