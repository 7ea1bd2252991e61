"""The robot's outbox (spool): reports on the disk until the server acknowledges them, then for a week more.

A server that loses its disk is restored from a backup, and the reports that it acknowledged since are sent again. The only module of the
robot with SQL.
"""

import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NamedTuple

from fleetmap.errors import StoreError
from fleetmap.files import OWN_FILE

_SCHEMA = """
CREATE TABLE IF NOT EXISTS report (
  number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL UNIQUE, payload BLOB NOT NULL,
  delivered_ns INTEGER NOT NULL DEFAULT 0 -- 0: it waits
) STRICT;
CREATE TABLE IF NOT EXISTS count (name TEXT PRIMARY KEY, value INTEGER NOT NULL) STRICT;
"""
_RESTORED = "restored_ns"  # of the server, for which reports were sent again
_KEPT_NS = 7 * 86_400 * 1_000_000_000
_BUSY_S = 10.0


class QueuedReport(NamedTuple):
    """A waiting report; payload: the encoded message."""

    id: str
    payload: bytes


class Outbox:
    """Queue of reports, first in, first out; above `max_bytes` the oldest are dropped, delivered ones first; others are counted.

    Once `put` has returned, a report survives a crash and a power failure. A damaged file is renamed and replaced by a new one: a
    robot that cannot report must still drive. Thread-safe; each call opens the file itself.
    """

    def __init__(self, path: Path, *, max_bytes: int, wall_ns: Callable[[], int] = time.time_ns) -> None:
        """The first call creates the file and its folder; it raises StoreError if that fails, and the next one tries again."""
        self._path, self._max_bytes, self._wall_ns = path, max_bytes, wall_ns
        self._is_made = False
        self.set_aside: Path | None = None
        self.received_bytes: dict[str, int] = {}  # by the server, of reports that it gets in parts

    def _make(self) -> None:
        path = self._path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch(OWN_FILE)
            path.chmod(OWN_FILE)  # SQLite gives its other files the same
            try:
                self._check()
            except sqlite3.OperationalError:
                raise
            except sqlite3.DatabaseError:
                self._set_aside()
                self._check()
        except (OSError, sqlite3.Error) as error:
            reason = f"the spool {path} cannot be used ({error}); check the disk and the file's owner, or change [run] outbox"
            raise StoreError(reason) from error
        self._is_made = True

    def put(self, report: QueuedReport) -> None:
        """Store a report; ignore one whose id waits already. Raises StoreError on a disk error."""
        with self._transaction() as database:
            database.execute("INSERT OR IGNORE INTO report (id, payload) VALUES (?, ?)", (report.id, report.payload))
            # The oldest reports make room, delivered ones first, never the newest one.
            query = "SELECT number, LENGTH(payload), delivered_ns = 0 FROM report ORDER BY delivered_ns = 0, number"
            rows = database.execute(query).fetchall()
            total, dropped = sum(size for _, size, _ in rows), 0
            for number, size, is_waiting in rows[:-1]:
                if total <= self._max_bytes:
                    break
                database.execute("DELETE FROM report WHERE number = ?", (number,))
                total, dropped = total - size, dropped + is_waiting
            self._count(database, "dropped", dropped)

    def waiting(self, limit: int = 1) -> list[QueuedReport]:
        with self._transaction("DEFERRED") as database:
            rows = database.execute(
                "SELECT id, payload FROM report WHERE delivered_ns = 0 ORDER BY number LIMIT ?", (limit,)
            ).fetchall()
        return [QueuedReport(*row) for row in rows]

    def done(self, report_id: str) -> None:
        """The server has stored a report; it is kept for a week, in case the server loses it."""
        with self._transaction() as database:
            delivered = "UPDATE report SET delivered_ns = ? WHERE id = ? AND delivered_ns = 0"
            self._count(database, "delivered", database.execute(delivered, (self._wall_ns(), report_id)).rowcount)

    def refused(self, report_id: str) -> None:
        """Remove a report that the server rejects for good or cannot read."""
        with self._transaction() as database:
            self._count(database, "refused", database.execute("DELETE FROM report WHERE id = ?", (report_id,)).rowcount)

    def send_again(self, restored_ns: int) -> int:
        """Let delivered reports wait again, once for each restoration of the server, at its time; return their number.

        Those delivered longer than a week ago are removed.
        """
        with self._transaction() as database:
            database.execute("DELETE FROM report WHERE delivered_ns BETWEEN 1 AND ?", (self._wall_ns() - _KEPT_NS,))
            known = database.execute("SELECT value FROM count WHERE name = ?", (_RESTORED,)).fetchone()
            # Not "before": its clock may have been set back.
            if restored_ns in (0, None if known is None else known[0]):
                return 0
            database.execute("INSERT OR REPLACE INTO count VALUES (?, ?)", (_RESTORED, restored_ns))
            return database.execute("UPDATE report SET delivered_ns = 0 WHERE delivered_ns").rowcount

    def counts(self) -> dict[str, int]:
        """Return `waiting` now; `delivered`, `dropped` for lack of space and `refused` (including damaged) since the file was made."""
        with self._transaction("DEFERRED") as database:
            known = dict(database.execute("SELECT name, value FROM count").fetchall())
            waiting = database.execute("SELECT COUNT(*) FROM report WHERE delivered_ns = 0").fetchone()[0]
        return {"waiting": waiting, **{name: known.get(name, 0) for name in ("delivered", "dropped", "refused")}}

    def _count(self, database: sqlite3.Connection, name: str, more: int) -> None:
        if more:
            database.execute(
                "INSERT INTO count VALUES (?, ?) ON CONFLICT (name) DO UPDATE SET value = value + excluded.value",
                (name, more),
            )

    def _check(self) -> None:
        with closing(self._open()) as database:
            database.execute("PRAGMA journal_mode = WAL")
            database.executescript(_SCHEMA)
            if database.execute("PRAGMA quick_check").fetchone()[0] != "ok":
                raise sqlite3.DatabaseError("damaged")

    def _set_aside(self) -> None:
        aside = self._path.with_name(f"{self._path.name}.damaged")
        for suffix in ("", "-wal", "-shm"):
            part = self._path.with_name(self._path.name + suffix)
            if part.exists():
                part.replace(aside.with_name(aside.name + suffix))
        self.set_aside = aside

    def _open(self) -> sqlite3.Connection:
        database = sqlite3.connect(self._path, timeout=_BUSY_S, isolation_level=None)
        database.execute("PRAGMA synchronous = FULL")
        return database

    @contextmanager
    def _transaction(self, kind: str = "IMMEDIATE") -> Iterator[sqlite3.Connection]:
        if not self._is_made:
            self._make()
        try:
            with closing(self._open()) as database, database:  # whose end commits, or takes all back after an error
                database.execute(f"BEGIN {kind}")
                yield database
        except sqlite3.Error as error:
            raise StoreError(
                f"the spool {self._path} refused ({error}); is its disk full, read-only or damaged?"
            ) from error
