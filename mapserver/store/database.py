"""The database of an open store: reading, write transactions, the log. Its SQL is the same in SQLite, here, and in those of plug-ins."""

import hashlib
import json
import os
import sqlite3
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import astuple
from pathlib import Path
from typing import Any, ClassVar, TypeVar
from urllib.parse import quote

from fleetmap.errors import NewerFormatError, StoreError, UsageError
from fleetmap.files import sync_path
from mapserver.store import files
from mapserver.store.rows import NOBODY, UNLIMITED, Actor, AuditLine
from mapserver.store.schema import FORMAT, MIGRATIONS, TABLES, names

APPLICATION_ID = 0x464D4150  # "FMAP": identifies the file as a map store
NUL = r"\x00"
"""Text in place of a NUL character, which PostgreSQL does not store."""
_JSON = {"report", "last_report", "reasons"}
"""Columns whose text is JSON."""
_MOST_VALUES = 30_000  # of one statement
ROWS_AT_ONCE = 20  # of tables with recordings of some megabytes

Row = TypeVar("Row")
Values = Sequence[Any]


def matching(wanted: Mapping[str, object]) -> tuple[str, list[object]]:
    """Return a condition, and its values, on columns by name and, if not =, operator ("hour >="); None matches all."""
    given = {name: value for name, value in wanted.items() if value is not None}
    words = [f"{name} ?" if " " in name else f"{name} = ?" for name in given]
    return " AND ".join(words) or "TRUE", list(given.values())


class Transaction:
    """A write transaction."""

    def __init__(self, database: "Database", session: Any) -> None:
        self._database, self._session = database, session

    def execute(self, sql: str, values: Values = ()) -> Any:
        """Return the cursor of a statement."""
        return self._database.run(self._session, sql, values)

    def insert(self, table: str, rows: Iterable[Mapping[str, Any]], otherwise: str = "") -> Any:
        """Insert rows that have the same columns; return the cursor of the last statement. otherwise: such as ON CONFLICT."""
        every, cursor = list(rows), None
        columns = list(every[0]) if every else []
        group, at_once = f"({', '.join('?' * len(columns))})", _MOST_VALUES // max(1, len(columns))
        for first in range(0, len(every), at_once):
            some = every[first : first + at_once]
            sql = f"INSERT INTO {table} ({', '.join(columns)}) VALUES {', '.join([group] * len(some))} {otherwise}"
            cursor = self.execute(sql, [row[name] for row in some for name in columns])
        return cursor

    def log(self, site: str, kind: str, detail: str, version: int | None = None, actor: Actor = NOBODY) -> None:
        """Write a line of the log, chained to the previous one; site: empty if not about one."""
        number, before = self.execute("SELECT id, sha256 FROM events ORDER BY id DESC LIMIT 1").fetchone() or (0, "")
        texts = [text.replace("\0", NUL) for text in (site, kind, detail, *actor)]
        values = (number + 1, self._database.now_ns(), *texts[:3], version, *texts[3:])
        row = dict(zip(AuditLine.__dataclass_fields__, (*values, _line_sha256(before, values)), strict=True))
        self.insert("events", [row])


def chain_faults(lines: Iterable[AuditLine]) -> list[str]:
    """Return changed or missing lines, oldest first. A log rewritten completely from some line on shows no fault."""
    faults: list[str] = []
    before, number = "", 0
    for line in lines:
        if line.id != number + 1:
            faults.append(f"lines {number + 1} to {line.id - 1} are missing")
        if line.sha256 != _line_sha256(before, astuple(line)[:-1]):
            faults.append(f"line {line.id} was changed, or follows a removed one")
        before, number = line.sha256, line.id
    return faults


def _line_sha256(before: str, values: Sequence[object]) -> str:
    """Return the hash of a line with these columns, all but the hash, after a line of hash `before` (empty for the first)."""
    return hashlib.sha256(json.dumps([before, *values], separators=(",", ":")).encode()).hexdigest()


class StoreFiles:
    """Files in a store's folder that are the same for all of its servers: signed lists, enrolled robots. Here of the only server."""

    def __init__(self, root: Path, database: "Database") -> None:
        self._root, self._database = root, database

    @contextmanager
    def changing(self, folder: str) -> Iterator[Path]:
        """Hold the lock of a folder for a change of its files below the yielded path: it is that of all servers, or of none."""
        with self._database.locked(f"{folder}/lock"):
            yield self._root

    def share(self) -> None:
        """Give the other servers what is here."""

    def follow(self) -> None:
        """Take what other servers changed."""

    def connected(self, here: Sequence[str]) -> list[str]:
        """Tell the other servers which certificates are connected to this one; return those of their connections.

        To be called every five seconds; a server that does not is one without connections.
        """
        return []


class Database(ABC):
    """Methods may be called from any thread; within a transaction its own thread reads its own writes.

    One transaction writes at a time, in all processes. Raises StoreError if the disk or the server refuses.
    """

    is_shared: ClassVar[bool]
    """True if servers on several machines may use it."""

    def __init__(self, clock_ns: Callable[[], int]) -> None:
        self.now_ns = clock_ns
        self._lock = threading.RLock()
        self._writing: tuple[int, Any] | None = None  # thread and session of the running transaction

    @contextmanager
    def write(self, *, durable: bool = True) -> Iterator[Transaction]:
        """Run the block as one transaction; a durable one is on the disk when it ends."""
        with self._lock, self._errors("written"):
            session = self._begin(durable)
            try:
                self._writing = threading.get_ident(), session
                yield Transaction(self, session)
                self._writing = None
                self._commit(session)
            except BaseException:
                self._writing = None
                with suppress(Exception):  # the first error says more
                    self.run(session, "ROLLBACK")
                raise

    def query(self, sql: str, values: Values = ()) -> list[dict[str, Any]]:
        """Return the rows by column."""
        with self._errors("read"):
            writing = self._writing
            if writing is not None and writing[0] == threading.get_ident():
                return self._dicts(writing[1], sql, values)
            return self._read(sql, values)

    def rows(self, kind: Callable[..., Row], sql: str, values: Values = ()) -> list[Row]:
        """Return the rows, each as a `kind` with a field for every column."""
        return [
            kind(**{name: json.loads(value) if name in _JSON else value for name, value in row.items()})
            for row in self.query(sql, values)
        ]

    def select(
        self, kind: type[Row], table: str, wanted: Mapping[str, object], order: str, limit: int | None = None
    ) -> list[Row]:
        """Return the records of a table that match, as of `matching`, in order."""
        words, values = matching(wanted)
        sql = f"SELECT {names(kind)} FROM {table} WHERE {words} ORDER BY {order} LIMIT ?"
        return self.rows(kind, sql, [*values, UNLIMITED if limit is None else limit])

    def value(self, sql: str, values: Values = ()) -> Any:
        """Return the first column of the first row, None without any."""
        found = self.query(sql, values)
        return next(iter(found[0].values())) if found else None

    def column(self, sql: str, values: Values = ()) -> list[Any]:
        """Return the first column."""
        return [next(iter(row.values())) for row in self.query(sql, values)]

    def copy_from(self, source: "Database") -> None:
        """Fill the database, which is empty, with the rows of another one. StoreError if it holds something."""
        with self.write() as change:
            if any(self.query(f"SELECT 1 FROM {table} LIMIT 1") for table in TABLES):
                raise StoreError("the database holds a store already; name an empty one")
            for table, rows in source.tables():
                change.insert(table, rows)

    def leads(self) -> bool:
        """True if this process is the one of all servers that does what one alone may do, until it ends or loses the database."""
        return True

    def files(self, root: Path) -> StoreFiles:
        return StoreFiles(root, self)

    def run(self, session: Any, sql: str, values: Values = ()) -> Any:
        """Return the cursor of a statement in a session."""
        return session.execute(sql, values)

    def _dicts(self, session: Any, sql: str, values: Values) -> list[dict[str, Any]]:
        cursor = self.run(session, sql, values)
        return [dict(zip([column[0] for column in cursor.description], row, strict=True)) for row in cursor.fetchall()]

    def shrink(self, pages: int) -> None:
        """Return up to `pages` unused pages of a file to the disk."""
        return

    def faults(self) -> list[str]:
        """Return what the database itself finds wrong, each a sentence."""
        return []

    @abstractmethod
    def close(self) -> None: ...

    @abstractmethod
    def tables(self) -> Iterator[tuple[str, list[dict[str, Any]]]]:
        """Yield table and some rows, as of one moment; a table is yielded as often as it has so many rows."""

    @abstractmethod
    def copy_to(self, path: Path) -> None:
        """Copy the database, as of one moment, into a new file of SQLite."""

    @abstractmethod
    def total_bytes(self) -> int: ...

    @abstractmethod
    def locked(self, name: str, *, shared: bool = False, waits: bool = True) -> AbstractContextManager[None]:
        """Hold a lock in the block: shared or exclusive, in all processes that have this store open. That of a dead process is released.

        Raises StoreError if it is not free within a minute, BusyError at once without `waits`.
        """

    @abstractmethod
    def _begin(self, durable: bool) -> Any:
        """Begin a transaction and return its session."""

    def _commit(self, session: Any) -> None:
        self.run(session, "COMMIT")

    @abstractmethod
    def _read(self, sql: str, values: Values) -> list[dict[str, Any]]: ...

    @abstractmethod
    def _errors(self, done: str) -> AbstractContextManager[None]:
        """Turn errors of the driver into StoreError: the database cannot be `done`."""


class SqliteDatabase(Database):
    """The database at a path, created or migrated as needed.

    One connection writes and another one reads, each under its own lock: reading does not wait while a write is forced to the disk.
    read_only: nothing is created or migrated. Raises NewerFormatError for a database of a newer fleetmap, StoreError for one that
    cannot be opened or belongs to another program.
    """

    is_shared = False

    def __init__(self, path: Path, clock_ns: Callable[[], int], *, read_only: bool = False) -> None:
        super().__init__(clock_ns)
        self._path, self._reading = path, threading.Lock()
        if read_only:
            self._connection = self._reader = _for_reading(path)
            return
        self._connection = _connected(path, "mode=rwc")
        try:
            found = _check_ours(self._connection, path)
            for setting in ("auto_vacuum = INCREMENTAL", "journal_mode = WAL", "foreign_keys = ON"):
                self._connection.execute(f"PRAGMA {setting}")
            if 0 < found < FORMAT:
                _copy(self._connection, path, path.with_name(f"{path.stem}-format-{found}{path.suffix}"))
            if found < FORMAT:
                with self.write():
                    _migrate(self._connection)
            with self._errors("read"):
                self._reader = _connected(path, "mode=rwc")
                self._reader.execute("PRAGMA query_only = ON")
        except BaseException:
            self._connection.close()
            raise

    def close(self) -> None:
        with self._lock, self._reading:
            self._reader.close()
            self._connection.close()  # the last one checkpoints the write-ahead log

    def tables(self) -> Iterator[tuple[str, list[dict[str, Any]]]]:
        with self._reading:
            self._reader.execute("BEGIN")
            try:
                for table in TABLES:
                    found = self._reader.execute(f"SELECT * FROM {table}")
                    columns = [column[0] for column in found.description]
                    while rows := found.fetchmany(ROWS_AT_ONCE):
                        yield table, [dict(zip(columns, row, strict=True)) for row in rows]
            finally:
                self._reader.execute("COMMIT")

    def copy_to(self, path: Path) -> None:
        with closing(sqlite3.connect(path)) as target, self._reading, self._errors(f"copied to {path}"):
            self._reader.backup(target)

    def shrink(self, pages: int) -> None:
        with self._lock, suppress(sqlite3.Error):  # a busy file is shrunk the next time
            # One step of `execute` frees one page
            self._connection.executescript(f"PRAGMA incremental_vacuum({pages:d})")

    def faults(self) -> list[str]:
        found = [text for text in self.column("PRAGMA integrity_check") if text != "ok"]
        return found + [f"a row of {table} refers to nothing" for table in self.column("PRAGMA foreign_key_check")]

    def total_bytes(self) -> int:
        return sum(path.stat().st_size for path in self._path.parent.glob("store*.sqlite3*"))

    def locked(self, name: str, *, shared: bool = False, waits: bool = True) -> AbstractContextManager[None]:
        return files.locked(self._path.parent / name, shared=shared, waits=waits)

    def _begin(self, durable: bool) -> sqlite3.Connection:
        # NORMAL may lose the last commits when the power fails, never the file's integrity: enough for robots' reports.
        self._connection.execute(f"PRAGMA synchronous = {'FULL' if durable else 'NORMAL'}")
        self._connection.execute("BEGIN IMMEDIATE")
        return self._connection

    def _read(self, sql: str, values: Values) -> list[dict[str, Any]]:
        with self._reading:
            return self._dicts(self._reader, sql, values)

    @contextmanager
    def _errors(self, done: str) -> Iterator[None]:
        try:
            yield
        except OverflowError as error:
            raise UsageError("a number of more than 64 bits; nothing in a store has one") from error
        except sqlite3.Error as error:
            raise StoreError(f"the store {self._path} cannot be {done} ({error}); check its disk and space") from error


def format_of(path: Path) -> int:
    """Return the format of a store's database, 0 if it is not one; reads only the header of its file, without SQLite."""
    try:
        with path.open("rb") as file:
            head = file.read(100)
    except OSError:
        return 0
    return int.from_bytes(head[60:64], "big") if head[68:72] == APPLICATION_ID.to_bytes(4, "big") else 0


def _connected(path: Path, options: str) -> sqlite3.Connection:
    address = f"file:{quote(str(path.absolute()))}?{options}"
    return sqlite3.connect(address, timeout=30, isolation_level=None, check_same_thread=False, uri=True)


def _for_reading(path: Path) -> sqlite3.Connection:
    """Open a connection that does not change the disk.

    If the folder is not writable, SQLite reads the database file alone, which is complete unless the last writing process was killed. An
    older format is migrated in a copy in memory. Raises StoreError after a killed process, and for an invalid database.
    """
    log = path.with_name(f"{path.name}-wal")
    has_log = log.is_file() and log.stat().st_size > 0
    for options in ("mode=ro",) if has_log else ("mode=ro", "mode=ro&immutable=1"):
        connection = _connected(path, options)
        try:
            if _check_ours(connection, path) == FORMAT:
                return connection
            copy = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
            connection.backup(copy)
            connection.close()
            _migrate(copy)
            copy.execute("PRAGMA query_only = ON")
            return copy
        except sqlite3.OperationalError as error:
            connection.close()
            reason = error
        except BaseException:
            connection.close()
            raise
    raise StoreError(
        f"the store {path.parent} cannot be read without writing ({reason}); copy it to a writable folder"
    ) from reason


def _check_ours(connection: sqlite3.Connection, path: Path) -> int:
    """Return the format, 0 for an empty database. Raises StoreError for the database of another program."""
    application, number = (connection.execute(f"PRAGMA {n}").fetchone()[0] for n in ("application_id", "user_version"))
    tables = connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()[0]
    if application != APPLICATION_ID and (application, number, tables) != (0, 0, 0):
        raise StoreError(
            f"{path} is not the database of a map store (application id {application}); choose another --store"
        )
    if number > FORMAT:
        raise NewerFormatError(
            f"{path} has store format {number}, this fleetmap reads up to {FORMAT}; update fleetmap to open it"
        )
    return int(number)


def _migrate(connection: sqlite3.Connection) -> None:
    """Run the pending migrations: another process may have run some."""
    # Here, since few starts migrate, and it imports pandas where that is installed.
    from sqlite_utils import Database, Migrations

    named = Migrations("fleetmap")
    for migration in MIGRATIONS:
        named()(migration)
    named.apply(Database(connection, execute_plugins=False))
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
        fresh.unlink(missing_ok=True)
        raise StoreError(
            f"{path} has an older format, and its copy {target.name} cannot be written before it is migrated ({error}); free some space: "
            "the store is unchanged"
        ) from error
