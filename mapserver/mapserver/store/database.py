"""The SQLite file of a store: opening, numbered migrations, transactions. All settings of SQLite are here."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sqlite_utils import Database

from fleetmap.errors import NewerFormatError, StoreError
from mapserver.store.migrations import MIGRATIONS

APPLICATION_ID = 0x464D4150  # "FMAP": says whose file this is
_BUSY_TIMEOUT_MS = 30_000


def open_database(path: Path) -> Database:
    """The database at `path`, created or migrated as needed, usable from any thread under one lock.

    Raises NewerFormatError for one that a newer fleetmap made, StoreError for one that cannot be opened or is another program's.
    """
    connection = sqlite3.connect(path, timeout=_BUSY_TIMEOUT_MS / 1000, isolation_level=None, check_same_thread=False)
    try:
        database = Database(connection, execute_plugins=False)
        _check_ours(connection, path)
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA foreign_keys = ON")
        _migrate(database)
    except BaseException:
        connection.close()
        raise
    return database


def open_reader(path: Path) -> Database:
    """A second connection to a database that `open_database` has open, which cannot write; usable from any thread under one lock."""
    connection = sqlite3.connect(path, timeout=_BUSY_TIMEOUT_MS / 1000, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA query_only = ON")
    except BaseException:
        connection.close()
        raise
    return Database(connection, execute_plugins=False)


@contextmanager
def transaction(database: Database, *, durable: bool = True) -> Iterator[sqlite3.Connection]:
    """One write transaction: all of the block or nothing; a durable one is on the disk when it ends."""
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


def _check_ours(connection: sqlite3.Connection, path: Path) -> None:
    application = connection.execute("PRAGMA application_id").fetchone()[0]
    number = connection.execute("PRAGMA user_version").fetchone()[0]
    tables = connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0]
    if application != APPLICATION_ID and (application != 0 or number != 0 or tables != 0):
        reason = f"{path} is not the database of a map store (application id {application}); choose another --store"
        raise StoreError(reason)
    if number > len(MIGRATIONS):
        raise NewerFormatError(
            f"{path} has store format {number}, this fleetmap reads up to {len(MIGRATIONS)}; update fleetmap to open it"
        )


def _migrate(database: Database) -> None:
    done = int(database.conn.execute("PRAGMA user_version").fetchone()[0])
    for number in range(done + 1, len(MIGRATIONS) + 1):
        with transaction(database) as connection:
            # Another process may have come first between the look above and the lock that this transaction holds.
            if int(connection.execute("PRAGMA user_version").fetchone()[0]) >= number:
                continue
            for statement in MIGRATIONS[number - 1]:
                connection.execute(statement)
            connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            connection.execute(f"PRAGMA user_version = {number}")
