"""The robot's outbox (spool): reports on the disk until the server acknowledges them. The only module of the robot with SQL."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from fleetmap.errors import StoreError

_SCHEMA = """
CREATE TABLE IF NOT EXISTS report (
  number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL UNIQUE, payload BLOB NOT NULL
) STRICT;
CREATE TABLE IF NOT EXISTS count (name TEXT PRIMARY KEY, value INTEGER NOT NULL) STRICT;
"""
_BUSY_S = 10.0


@dataclass(frozen=True, slots=True)
class QueuedReport:
    """A waiting report; payload: the encoded message."""

    id: str
    payload: bytes


class Outbox:
    """Queue of reports, first in, first out; above `max_bytes` the oldest are dropped and counted.

    Once `put` has returned, a report survives a crash and a power failure. A damaged file is renamed and replaced by a new one: a
    robot that cannot report must still drive. Thread-safe; each call opens the file itself.
    """

    def __init__(self, path: Path, *, max_bytes: int, is_needed: bool = True) -> None:
        """Create the file and its folder; raise StoreError if that fails.

        is_needed: if False, store the reason in `fault` instead and retry at each call.
        """
        self._path = path
        self._max_bytes = max_bytes
        self.set_aside: Path | None = None
        self._is_made, self.fault = False, ""
        try:
            self._make()
        except StoreError as error:
            if is_needed:
                raise
            self.fault = str(error)

    def _make(self) -> None:
        path = self._path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._check()
            except sqlite3.DatabaseError as error:
                if isinstance(error, sqlite3.OperationalError):
                    raise
                self._set_aside()
                self._check()
        except (OSError, sqlite3.Error) as error:
            reason = f"the spool {path} cannot be used ({error}); check the disk and the file's owner, or change [run] outbox"
            raise StoreError(reason) from error
        self._is_made, self.fault = True, ""

    def put(self, report: QueuedReport) -> None:
        """Store a report; ignore one whose id waits already. Raises StoreError on a disk error."""
        with self._transaction() as database:
            database.execute("INSERT OR IGNORE INTO report (id, payload) VALUES (?, ?)", (report.id, report.payload))
            self._make_room(database)

    def waiting(self, limit: int = 1) -> list[QueuedReport]:
        with self._transaction("DEFERRED") as database:
            rows = database.execute("SELECT id, payload FROM report ORDER BY number LIMIT ?", (limit,)).fetchall()
        return [QueuedReport(*row) for row in rows]

    def done(self, report_id: str) -> None:
        self._remove(report_id, "delivered")

    def refused(self, report_id: str) -> None:
        """Remove a report that the server rejects for good or cannot read."""
        self._remove(report_id, "refused")

    def counts(self) -> dict[str, int]:
        """Return `waiting` now; `delivered`, `dropped` for lack of space and `refused` (including damaged) since the file was made."""
        with self._transaction("DEFERRED") as database:
            known = dict(database.execute("SELECT name, value FROM count").fetchall())
            waiting = database.execute("SELECT COUNT(*) FROM report").fetchone()[0]
        return {"waiting": waiting, **{name: known.get(name, 0) for name in ("delivered", "dropped", "refused")}}

    def _remove(self, report_id: str, count: str) -> None:
        with self._transaction() as database:
            self._count(database, count, database.execute("DELETE FROM report WHERE id = ?", (report_id,)).rowcount)

    def _make_room(self, database: sqlite3.Connection) -> None:
        """Drop the oldest reports, never the newest one."""
        query = "SELECT number, LENGTH(payload) FROM report ORDER BY number"
        rows = database.execute(query).fetchall()
        total, dropped = sum(size for _, size in rows), 0
        for number, size in rows[:-1]:
            if total <= self._max_bytes:
                break
            database.execute("DELETE FROM report WHERE number = ?", (number,))
            total, dropped = total - size, dropped + 1
        self._count(database, "dropped", dropped)

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
            with closing(self._open()) as database:
                database.execute(f"BEGIN {kind}")
                try:
                    yield database
                except BaseException:
                    database.execute("ROLLBACK")
                    raise
                database.execute("COMMIT")
        except sqlite3.Error as error:
            raise StoreError(
                f"the spool {self._path} refused ({error}); is its disk full, read-only or damaged?"
            ) from error
