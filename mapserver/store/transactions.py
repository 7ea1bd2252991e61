"""The database of an open store, in SQLite or PostgreSQL: reading, write transactions, the log. The SQL is the same for both."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeVar

from fleetmap.errors import StoreError
from mapserver.store.access.chain import COLUMNS, AuditLine, chain_head, line_sha256
from mapserver.store.rows import UNLIMITED, LogEntry
from mapserver.store.schema import TABLES

NUL = r"\x00"
"""Text in place of a NUL character, which PostgreSQL does not store."""

Row = TypeVar("Row")
Values = Sequence[object] | Mapping[str, object]


class Result(Protocol):
    """Rows of a statement, in order of its columns."""

    @property
    def rowcount(self) -> int: ...
    def fetchone(self) -> Any: ...
    def fetchall(self) -> Sequence[Any]: ...


class Connection(Protocol):
    """A write transaction. Parameters are written ?, ?1 or :name; `(?1 IS NULL OR condition with ?1)` makes a condition optional."""

    def execute(self, sql: str, values: Any = ..., /) -> Result: ...
    def executemany(self, sql: str, rows: Iterable[Any], /) -> object: ...


class Transactions(ABC):
    """The database. Methods may be called from any thread; within a transaction its own thread reads its own writes.

    One transaction writes at a time, in all processes.
    """

    is_shared: ClassVar[bool]
    """True if servers on several machines may use it."""

    def __init__(self, clock_ns: Callable[[], int]) -> None:
        self.now_ns = clock_ns

    @abstractmethod
    def close(self) -> None: ...

    @abstractmethod
    def write(self, *, durable: bool = True) -> AbstractContextManager[Connection]:
        """Run the block as one transaction; a durable one is on the disk when it ends. Raises StoreError on a disk error."""

    @abstractmethod
    def query(self, sql: str, values: tuple[object, ...] = ()) -> list[dict[str, Any]]:
        """Return the rows by column. Raises StoreError on a disk error."""

    @abstractmethod
    def tables(self) -> Iterator[tuple[str, list[str], list[Any]]]:
        """Yield table, columns and some rows, as of one moment; a table is yielded as often as it has so many rows."""

    @abstractmethod
    def copy_to(self, path: Path) -> None:
        """Copy the database, as of one moment, into a new file of SQLite. Raises StoreError on a disk error."""

    @abstractmethod
    def shrink(self, pages: int) -> None:
        """Return up to `pages` unused pages of a file to the disk."""

    @abstractmethod
    def faults(self) -> list[str]:
        """Return what the database itself finds wrong, each a sentence."""

    @abstractmethod
    def total_bytes(self) -> int: ...

    @abstractmethod
    def locked(self, name: str, *, shared: bool = False, waits: bool = True) -> AbstractContextManager[None]:
        """Hold a lock in the block: shared or exclusive, in all processes that have this store open. That of a dead process is released.

        Raises StoreError if it is not free within a minute, BusyError at once without `waits`.
        """

    def leads(self) -> bool:
        """True if this process is the one of all servers that does what one alone may do, until it ends or loses the database."""
        return True

    def copy_from(self, source: "Transactions") -> None:
        """Fill the database, which is empty, with the rows of another one. StoreError if it holds something."""
        with self.write() as connection:
            if any(self.query(f"SELECT 1 FROM {table} LIMIT 1") for table in TABLES):
                raise StoreError("the database holds a store already; name an empty one")
            for table, columns, rows in source.tables():
                sql = f"INSERT INTO {table} ({', '.join(columns)}) VALUES ({', '.join('?' * len(columns))})"
                connection.executemany(sql, rows)

    def rows(self, kind: Callable[..., Row], sql: str, values: tuple[object, ...] = ()) -> list[Row]:
        """Return the rows, each as a `kind` with a field for every column. Raises StoreError on a disk error."""
        return [kind(**row) for row in self.query(sql, values)]

    def first(self, kind: Callable[..., Row], sql: str, values: tuple[object, ...] = ()) -> Row | None:
        """As `rows`: the first of them, None if absent."""
        return next(iter(self.rows(kind, sql, values)), None)

    def log(self, connection: Connection, site: str, entry: LogEntry) -> None:
        """Write a line of the log, chained to the previous one, within a transaction; site: empty if not about one."""
        actor = entry.actor
        last = connection.execute("SELECT id, sha256 FROM events ORDER BY id DESC LIMIT 1").fetchone()
        number, before = last or (0, "")
        if number and not before:  # all lines are from before the chain: the first chained one covers them
            before = chain_head(self.audit_lines())
        values: tuple[object, ...] = (number + 1, self.now_ns(), site, entry.kind, entry.detail, entry.version)
        values += (actor.name, actor.reason, actor.operator, actor.address)
        # Before the hash, which is of what every database stores.
        values = tuple(value.replace("\0", NUL) if isinstance(value, str) else value for value in values)
        connection.execute(
            f"INSERT INTO events ({COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (*values, line_sha256(before, values)),
        )

    def audit_lines(self, last: int | None = None) -> list[AuditLine]:
        rows = self.rows(
            AuditLine, f"SELECT {COLUMNS} FROM events ORDER BY id DESC LIMIT ?", (UNLIMITED if last is None else last,)
        )
        return rows[::-1]
