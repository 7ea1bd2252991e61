"""The SQLite file of a store: opening, numbered migrations, transactions. It alone decides how SQLite behaves."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlite_utils import Database

from fleetmap.errors import NewerFormatError, StoreError

APPLICATION_ID = 0x464D4150  # "FMAP": says whose file this is
_BUSY_TIMEOUT_MS = 30_000

MIGRATIONS: tuple[tuple[str, ...], ...] = (
    (
        """CREATE TABLE sites (
            site TEXT PRIMARY KEY,
            vocabulary_sha256 TEXT)""",
        """CREATE TABLE versions (
            site TEXT NOT NULL REFERENCES sites(site),
            version INTEGER NOT NULL CHECK (version >= 1),
            state TEXT NOT NULL CHECK (state IN ('draft', 'published', 'current', 'retired')),
            parent INTEGER,
            created TEXT NOT NULL,
            published_ns INTEGER,
            manifest_sha256 TEXT NOT NULL,
            manifest_bytes INTEGER NOT NULL,
            tiles INTEGER NOT NULL,
            tile_bytes INTEGER NOT NULL,
            landmarks INTEGER NOT NULL,
            vocabulary_sha256 TEXT NOT NULL,
            vocabulary_bytes INTEGER NOT NULL,
            archive_sha256 TEXT,
            PRIMARY KEY (site, version))""",
        "CREATE UNIQUE INDEX one_current_per_site ON versions(site) WHERE state = 'current'",
        """CREATE TABLE version_blobs (
            site TEXT NOT NULL,
            version INTEGER NOT NULL,
            kind TEXT NOT NULL CHECK (kind IN ('manifest', 'tile', 'vocabulary', 'archive')),
            sha256 TEXT NOT NULL,
            PRIMARY KEY (site, version, kind, sha256),
            FOREIGN KEY (site, version) REFERENCES versions(site, version)) WITHOUT ROWID""",
        "CREATE INDEX version_blobs_by_address ON version_blobs(sha256)",
        """CREATE TABLE robots (
            site TEXT NOT NULL,
            robot TEXT NOT NULL,
            version INTEGER,
            last_seen_ns INTEGER NOT NULL,
            last_report TEXT NOT NULL,
            PRIMARY KEY (site, robot)) WITHOUT ROWID""",
        """CREATE TABLE events (
            id INTEGER PRIMARY KEY,
            stamp_ns INTEGER NOT NULL,
            site TEXT NOT NULL,
            kind TEXT NOT NULL,
            detail TEXT NOT NULL)""",
    ),
)


def open_database(path: Path) -> Database:
    """The database at `path`, created or migrated as needed, usable from any thread under one lock.

    Raises NewerFormatError for one that a newer fleetmap made, StoreError for one that cannot be opened or is another
    program's.
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
            connection.execute("ROLLBACK")
        raise


def _check_ours(connection: sqlite3.Connection, path: Path) -> None:
    application = connection.execute("PRAGMA application_id").fetchone()[0]
    number = connection.execute("PRAGMA user_version").fetchone()[0]
    tables = connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0]
    if application != APPLICATION_ID and (application != 0 or number != 0 or tables != 0):
        raise StoreError(
            f"{path} is not the database of a map store (application id {application}); choose another --store"
        )
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
