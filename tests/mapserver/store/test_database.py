"""Reading beside a write: it neither waits nor sees what is not committed. Stores of older formats."""

import errno
import os
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from sqlite_utils import Database

from fleetmap.errors import StoreError
from mapserver.store import MapStore, map_store, schema
from mapserver.store import database as database_module
from mapserver.store.database import SqliteDatabase
from mapserver.store.schema import FORMAT
from support.storage.map_samples import save_sample_draft

COUNT = "SELECT count(*) AS n FROM events"
_LINE = "INSERT INTO events (stamp_ns, site, kind, detail) VALUES (1, 'hall', 'note', 'x')"


@pytest.fixture
def ledger(tmp_path: Path) -> Iterator[SqliteDatabase]:
    opened = SqliteDatabase(tmp_path / "store.sqlite3", lambda: 1)
    yield opened
    opened.close()


def _read_elsewhere(ledger: SqliteDatabase) -> int:
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(ledger.query(COUNT)[0]["n"]), daemon=True)
    thread.start()
    thread.join(timeout=20)
    assert found, "reading waits for the transaction"
    return found[0]


def test_others_read_on_while_a_transaction_is_open(ledger: SqliteDatabase) -> None:
    with ledger.write() as connection:
        connection.execute(_LINE)
        assert ledger.query(COUNT)[0]["n"] == 1, "its own thread sees what it wrote"
        assert _read_elsewhere(ledger) == 0
    assert _read_elsewhere(ledger) == ledger.query(COUNT)[0]["n"] == 1


def test_what_is_taken_back_was_never_there(ledger: SqliteDatabase) -> None:
    with pytest.raises(RuntimeError), ledger.write() as connection:
        connection.execute(_LINE)
        raise RuntimeError
    assert ledger.query(COUNT)[0]["n"] == 0


def test_reading_cannot_write(ledger: SqliteDatabase) -> None:
    with pytest.raises(StoreError, match="cannot be read"):
        ledger.query(_LINE)


def test_closing_leaves_one_file(tmp_path: Path) -> None:
    """The write-ahead log is folded in by the last connection; a copy of the file is then the whole database."""
    opened = SqliteDatabase(tmp_path / "store.sqlite3", lambda: 1)
    with opened.write() as connection:
        connection.execute(_LINE)
    opened.query(COUNT)
    opened.close()
    assert [path.name for path in tmp_path.iterdir()] == ["store.sqlite3"]


def test_a_store_of_the_first_day_with_named_migrations_opens(tmp_path: Path) -> None:
    MapStore.open(tmp_path, create=True).close()
    with closing(sqlite3.connect(tmp_path / "store.sqlite3")) as connection:
        connection.execute("PRAGMA user_version = 13")
    with MapStore.open(tmp_path) as store:
        assert store.sites() == []


def test_a_store_is_copied_before_it_is_migrated_and_never_by_who_only_looks(tmp_path: Path, monkeypatch) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        save_sample_draft(store)

    def wings(database: Database) -> None:
        database.execute("ALTER TABLE sites ADD COLUMN wing TEXT")

    monkeypatch.setattr(database_module, "MIGRATIONS", [*schema.MIGRATIONS, wings])
    for module in (database_module, map_store):
        monkeypatch.setattr(module, "FORMAT", FORMAT + 1)
    path, copy = tmp_path / "store.sqlite3", tmp_path / f"store-format-{FORMAT}.sqlite3"
    before = path.read_bytes()
    with MapStore.open(tmp_path, read_only=True) as store:
        assert store._database.query("SELECT site, wing FROM sites") == [{"site": "lab", "wing": None}]
        with pytest.raises(StoreError, match="cannot be written"):
            store.record_robot_report("lab", "r1", {}, 1)
    assert (path.read_bytes(), copy.exists()) == (before, False)

    def is_full(path: Path) -> None:
        if path.is_dir():
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(database_module, "sync_path", is_full)
        with pytest.raises(StoreError, match="free some space: the store is unchanged"):
            MapStore.open(tmp_path)
    assert format_of(path) == FORMAT
    copy.unlink()
    MapStore.open(tmp_path).close()
    assert (format_of(path), format_of(copy)) == (FORMAT + 1, FORMAT)
    copied = copy.read_bytes()
    with MapStore.open(tmp_path) as store:
        assert [info.version for info in store.versions("lab")] == [1]
        applied = store._database.column("SELECT name FROM _sqlite_migrations ORDER BY rowid")
    assert applied == ["tables", "wings"]
    assert copy.read_bytes() == copied, "once"


def format_of(path: Path) -> int:
    with closing(sqlite3.connect(path)) as connection:
        return int(connection.execute("PRAGMA user_version").fetchone()[0])
