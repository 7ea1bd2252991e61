"""The SQLite file of an open store: its migrations, reading, write transactions. All settings of SQLite are here."""

import os
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from sqlite_utils import Database

from fleetmap.errors import NewerFormatError, StoreError, UsageError
from fleetmap.files import sync_path
from mapserver.store.files import locked
from mapserver.store.schema import FORMAT, MIGRATIONS, TABLES
from mapserver.store.transactions import Transactions

APPLICATION_ID = 0x464D4150  # "FMAP": identifies the file as a map store
_BUSY_TIMEOUT_MS = 30_000
_INCREMENTAL = 2
_HEAD_BYTES, _FORMAT_AT, _APPLICATION_AT = 100, 60, 68  # SQLite header; its user_version and application_id
_ROWS_AT_ONCE = 100


class SqliteTransactions(Transactions):
    """The database at a path, created or migrated as needed. Methods may be called from any thread.

    One connection writes and another one reads, each under its own lock: reading does not wait while a write is forced to the
    disk. Within a transaction its own thread reads its own writes. read_only: nothing is created or migrated.
    Raises NewerFormatError for a database of a newer fleetmap, StoreError for one that cannot be opened or belongs to another program.
    """

    is_shared = False

    def __init__(self, path: Path, clock_ns: Callable[[], int], *, read_only: bool = False) -> None:
        super().__init__(clock_ns)
        self._path = path
        self._lock, self._reading = threading.RLock(), threading.Lock()
        self._writing_thread: int | None = None
        if read_only:
            self._database, self._reader = _opened_for_reading(path), _opened_for_reading(path)
            return
        self._database = _opened(path, _prepare)
        try:
            self._reader = _opened(path, lambda reader, _: reader.conn.execute("PRAGMA query_only = ON"))
        except sqlite3.Error as error:
            self._database.close()
            raise StoreError(f"the store {path} cannot be read ({error}); check its disk") from error

    def close(self) -> None:
        with self._lock, self._reading:
            self._reader.close()
            self._database.close()  # the last one checkpoints the write-ahead log

    @contextmanager
    def write(self, *, durable: bool = True) -> Iterator[sqlite3.Connection]:
        with self._lock:
            self._writing_thread = threading.get_ident()
            try:
                with _transaction(self._database, durable=durable) as connection:
                    yield connection
            except sqlite3.Error as error:
                raise StoreError(f"the store {self._path} cannot be written ({error}); check its disk") from error
            finally:
                self._writing_thread = None

    def query(self, sql: str, values: tuple[object, ...] = ()) -> list[dict[str, Any]]:
        try:
            if self._writing_thread == threading.get_ident():
                return list(self._database.query(sql, values))
            with self._reading:
                return list(self._reader.query(sql, values))
        except OverflowError as error:
            raise UsageError("a number of more than 64 bits; nothing in a store has one") from error
        except sqlite3.Error as error:
            raise StoreError(f"the store {self._path} cannot be read ({error}); check its disk") from error

    def copy_to(self, path: Path) -> None:
        try:
            with self._reading, closing(sqlite3.connect(path)) as target:
                self._reader.conn.backup(target)
        except sqlite3.Error as error:
            raise StoreError(f"{self._path} cannot be copied to {path} ({error}); check its disk and space") from error

    def shrink(self, pages: int) -> None:
        with self._lock, suppress(sqlite3.Error):  # a busy file is shrunk the next time
            # One step of `execute` frees one page
            self._database.conn.executescript(f"PRAGMA incremental_vacuum({pages:d})")

    def tables(self) -> Iterator[tuple[str, list[str], list[Any]]]:
        with self._reading:
            self._reader.execute("BEGIN")
            try:
                for table in TABLES:
                    found = self._reader.execute(f"SELECT * FROM {table}")
                    columns = [column[0] for column in found.description]
                    while rows := found.fetchmany(_ROWS_AT_ONCE):
                        yield table, columns, rows
            finally:
                self._reader.execute("COMMIT")

    def faults(self) -> list[str]:
        found = [row["integrity_check"] for row in self.query("PRAGMA integrity_check")]
        foreign = self.query("PRAGMA foreign_key_check")
        return [text for text in found if text != "ok"] + [
            f"a row of {row['table']} refers to nothing" for row in foreign
        ]

    def total_bytes(self) -> int:
        return sum(path.stat().st_size for path in self._path.parent.glob("store*.sqlite3*"))

    def locked(self, name: str, *, shared: bool = False, waits: bool = True) -> AbstractContextManager[None]:
        return locked(self._path.parent / name, shared=shared, waits=waits)


def _opened(path: Path, prepare: Callable[[Database, Path], object], options: str = "mode=rwc") -> Database:
    connection = sqlite3.connect(
        f"file:{quote(str(path.absolute()))}?{options}",
        timeout=_BUSY_TIMEOUT_MS / 1000,
        isolation_level=None,
        check_same_thread=False,
        uri=True,
    )
    try:
        database = Database(connection, execute_plugins=False)
        prepare(database, path)
    except BaseException:
        connection.close()
        raise
    return database


def _opened_for_reading(path: Path) -> Database:
    """Open a connection that does not change the disk.

    If the folder is not writable, SQLite reads the database file alone, which is complete unless the last writing process was killed. An
    older format is migrated in a copy in memory. Raises StoreError after a killed process, and for an invalid database.
    """
    log = path.with_name(f"{path.name}-wal")
    try:
        try:
            return _current(_opened(path, _check_ours, "mode=ro"))
        except sqlite3.OperationalError:
            if log.is_file() and log.stat().st_size > 0:
                raise
            return _current(_opened(path, _check_ours, "mode=ro&immutable=1"))
    except sqlite3.Error as error:
        raise StoreError(
            f"the store {path.parent} cannot be read without writing ({error}); copy it to a writable folder"
        ) from error


def format_of(path: Path) -> int:
    """Return the format of a store's database, 0 if it is not one; reads only the file header, without SQLite."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES).ljust(_HEAD_BYTES, b"\0")
    except OSError:
        return 0
    number, application = (int.from_bytes(head[at : at + 4], "big") for at in (_FORMAT_AT, _APPLICATION_AT))
    return number if application == APPLICATION_ID else 0


def is_older(path: Path) -> bool:
    """True if the database would be migrated when opened for writing."""
    return 0 < format_of(path) < FORMAT


def _current(database: Database) -> Database:
    if int(database.conn.execute("PRAGMA user_version").fetchone()[0]) == FORMAT:
        return database
    connection = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
    with closing(database.conn):
        database.conn.backup(connection)
    migrated = Database(connection, execute_plugins=False)
    _migrate(migrated)
    connection.execute("PRAGMA query_only = ON")
    return migrated


def _prepare(database: Database, path: Path) -> None:
    _check_ours(database, path)
    database.conn.execute(f"PRAGMA auto_vacuum = {_INCREMENTAL}")  # of a file that is still empty
    database.conn.execute("PRAGMA journal_mode = WAL")
    database.conn.execute("PRAGMA foreign_keys = ON")
    done = int(database.conn.execute("PRAGMA user_version").fetchone()[0])
    if 0 < done < FORMAT:
        _copy(database.conn, path, path.with_name(f"{path.stem}-format-{done}{path.suffix}"))
    _migrate(database)


@contextmanager
def _transaction(database: Database, *, durable: bool) -> Iterator[sqlite3.Connection]:
    """Run one write transaction; a durable one is on the disk when it ends."""
    connection = database.conn
    # NORMAL may lose the last commits when the power fails, never the file's integrity: enough for robots' reports.
    connection.execute(f"PRAGMA synchronous = {'FULL' if durable else 'NORMAL'}")
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield connection
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            with suppress(sqlite3.Error):  # the first error says more
                connection.execute("ROLLBACK")
        raise


def _check_ours(database: Database, path: Path) -> None:
    connection = database.conn
    application = connection.execute("PRAGMA application_id").fetchone()[0]
    number = connection.execute("PRAGMA user_version").fetchone()[0]
    tables = connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0]
    if application != APPLICATION_ID and (application != 0 or number != 0 or tables != 0):
        reason = f"{path} is not the database of a map store (application id {application}); choose another --store"
        raise StoreError(reason)
    if number > FORMAT:
        raise NewerFormatError(
            f"{path} has store format {number}, this fleetmap reads up to {FORMAT}; update fleetmap to open it"
        )


def _migrate(database: Database) -> None:
    if database.conn.execute("PRAGMA user_version").fetchone()[0] == FORMAT:
        return
    with _transaction(database, durable=True) as connection:
        # Pending migrations are listed under the lock: another process may have run them.
        MIGRATIONS.apply(database)
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {FORMAT}")


def _copy(connection: sqlite3.Connection, path: Path, target: Path) -> None:
    """Copy the database for the older fleetmap, atomically, before it is migrated. StoreError on a disk error."""
    fresh = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        connection.execute("VACUUM INTO ?", (str(fresh),))
        fresh.chmod(path.stat().st_mode & 0o777)
        sync_path(fresh)
        fresh.replace(target)
        sync_path(target.parent)
    except (OSError, sqlite3.Error) as error:
        with suppress(OSError):
            fresh.unlink()
        raise StoreError(
            f"{path} has an older format, and its copy {target.name} cannot be written before it is migrated ({error}); free some space: "
            "the store is unchanged"
        ) from error
