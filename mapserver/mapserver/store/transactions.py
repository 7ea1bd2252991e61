"""Reading, write transactions and the log of an open store's database."""

import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fleetmap.errors import StoreError
from mapserver.store.database import open_database, open_reader, transaction
from mapserver.store.rows import LogEntry


class Transactions:
    """Methods may be called from any thread.

    One connection writes and another one reads, each under a lock of its own: reading does not wait while a write is forced to the
    disk. Within a transaction its own thread reads what it has written.
    """

    def __init__(self, path: Path, clock_ns: Callable[[], int]) -> None:
        self.now_ns = clock_ns
        self._path = path
        self._lock, self._reading = threading.RLock(), threading.Lock()
        self._writing_thread: int | None = None
        self._database = open_database(path)
        try:
            self._reader = open_reader(path)
        except sqlite3.Error as error:
            self._database.close()
            raise StoreError(f"the store {path} cannot be read ({error}); check its disk") from error

    def close(self) -> None:
        """Closes the database; nothing here must be used afterwards."""
        with self._lock, self._reading:
            self._reader.close()
            self._database.close()  # the last one tidies up the write-ahead log

    @contextmanager
    def write(self, *, durable: bool = True) -> Iterator[sqlite3.Connection]:
        """One transaction: all of the block or nothing. Raises StoreError where the disk refuses."""
        with self._lock:
            self._writing_thread = threading.get_ident()
            try:
                with transaction(self._database, durable=durable) as connection:
                    yield connection
            except sqlite3.Error as error:
                raise StoreError(f"the store {self._path} refuses to be written ({error}); check its disk") from error
            finally:
                self._writing_thread = None

    def query(self, sql: str, values: tuple[object, ...] = ()) -> list[dict[str, Any]]:
        """The rows by column. Raises StoreError where the disk refuses."""
        try:
            if self._writing_thread == threading.get_ident():
                return list(self._database.query(sql, values))
            with self._reading:
                return list(self._reader.query(sql, values))
        except sqlite3.Error as error:
            raise StoreError(f"the store {self._path} cannot be read ({error}); check its disk") from error

    def log(self, connection: sqlite3.Connection, site: str, entry: LogEntry) -> None:
        """One line of a site's history, within a transaction."""
        connection.execute(
            """INSERT INTO events (stamp_ns, site, kind, detail, version, actor, reason)
               VALUES (?, ?, ?, ?, ?, ?, ?)""",
            (self.now_ns(), site, entry.kind, entry.detail, entry.version, entry.actor.name, entry.actor.reason),
        )
