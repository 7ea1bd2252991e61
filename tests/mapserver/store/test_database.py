"""Reading beside a write: it neither waits nor sees what is not committed. Stores of older formats."""

import errno
import os
import shutil
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from sqlite_utils import Database, Migrations

from fleetmap.errors import StoreError
from mapserver import releases
from mapserver.store import FailureFilter, MapStore, schema
from mapserver.store import database as database_module
from mapserver.store.access.chain import chain_faults
from mapserver.store.database import APPLICATION_ID, SqliteTransactions
from mapserver.store.schema import FORMAT, LAST_UNNAMED
from support.storage.map_samples import save_sample_draft

COUNT = "SELECT count(*) AS n FROM events"
_LINE = "INSERT INTO events (stamp_ns, site, kind, detail) VALUES (1, 'hall', 'note', 'x')"


@pytest.fixture
def ledger(tmp_path: Path) -> Iterator[SqliteTransactions]:
    opened = SqliteTransactions(tmp_path / "store.sqlite3", lambda: 1)
    yield opened
    opened.close()


def _read_elsewhere(ledger: SqliteTransactions) -> int:
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(ledger.query(COUNT)[0]["n"]), daemon=True)
    thread.start()
    thread.join(timeout=20)
    assert found, "reading waits for the transaction"
    return found[0]


def test_others_read_on_while_a_transaction_is_open(ledger: SqliteTransactions) -> None:
    with ledger.write() as connection:
        connection.execute(_LINE)
        assert ledger.query(COUNT)[0]["n"] == 1, "its own thread sees what it wrote"
        assert _read_elsewhere(ledger) == 0
    assert _read_elsewhere(ledger) == ledger.query(COUNT)[0]["n"] == 1


def test_what_is_taken_back_was_never_there(ledger: SqliteTransactions) -> None:
    with pytest.raises(RuntimeError), ledger.write() as connection:
        connection.execute(_LINE)
        raise RuntimeError
    assert ledger.query(COUNT)[0]["n"] == 0


def test_reading_cannot_write(ledger: SqliteTransactions) -> None:
    with pytest.raises(StoreError, match="cannot be read"):
        ledger.query(_LINE)


def test_closing_leaves_one_file(tmp_path: Path) -> None:
    """The write-ahead log is folded in by the last connection; a copy of the file is then the whole database."""
    opened = SqliteTransactions(tmp_path / "store.sqlite3", lambda: 1)
    with opened.write() as connection:
        connection.execute(_LINE)
    opened.query(COUNT)
    opened.close()
    assert [path.name for path in tmp_path.iterdir()] == ["store.sqlite3"]


@pytest.mark.parametrize("read_only", [False, True])
@pytest.mark.parametrize("number", [1, LAST_UNNAMED - 1])
def test_a_store_of_before_is_refused_and_stays_as_it_is(tmp_path: Path, number: int, read_only: bool) -> None:
    path = tmp_path / "store.sqlite3"
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE sites (site TEXT PRIMARY KEY, vocabulary_sha256 TEXT)")
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {number}")
    before = path.read_bytes()
    with pytest.raises(StoreError, match=rf"store format {number};.*`mapserver export FILE`.*another --store"):
        MapStore.open(tmp_path, read_only=read_only)
    assert path.read_bytes() == before
    assert [found.name for found in tmp_path.iterdir() if found.is_file()] == [path.name]


@pytest.mark.parametrize("unchained", [2, 1 << 30])
def test_a_store_of_the_last_numbered_format_is_copied_and_migrated(tmp_path: Path, unchained: int) -> None:
    golden = Path(__file__).parents[2] / "golden"
    path, copy = tmp_path / "store.sqlite3", tmp_path / f"store-format-{LAST_UNNAMED}.sqlite3"
    shutil.copy(golden / f"store-{LAST_UNNAMED}.sqlite3", path)
    shutil.copytree(golden / "store-blobs", tmp_path / "blobs")
    with (
        closing(sqlite3.connect(path)) as connection,
        connection,
    ):  # as one that began before the chain and the moments of traces
        connection.execute("DROP TRIGGER events_stay_as_they_are")
        connection.execute("UPDATE events SET sha256 = '' WHERE id <= ?", (unchained,))
        connection.execute("INSERT INTO traces (hour, key_id, stamp_ns, status) VALUES (0, 1, 1, 'LOST')")
    before = path.read_bytes()
    with MapStore.open(tmp_path, read_only=True) as store:
        assert [info.state for info in store.versions("lab")] == ["current", "retired", "draft"]
    assert (path.read_bytes(), copy.exists()) == (before, False)
    with MapStore.open(tmp_path) as store:
        assert store.verify().faults == []
        assert [robot.robot for robot in store.robots("lab")] == ["r1"]
        (failure,) = store.fleet.failures(FailureFilter())
        assert store.fleet.counters("lab", "cause", key="dark")["lab", "dark"].failures == 1
        assert releases.publish(store, "lab") == 3
        assert releases.roll_back(store, "lab") == 1
        assert store.verify().faults == []
        assert chain_faults(store.audit_lines()) == []
        assert store._transactions.query("SELECT * FROM traces WHERE heard_ns IS NULL") == []
    assert (failure.failure_id, format_of(path), format_of(copy)) == ("f1", FORMAT, LAST_UNNAMED)


def test_a_store_is_copied_before_it_is_migrated_and_never_by_who_only_looks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        save_sample_draft(store)
    later = Migrations("fleetmap")
    later()(schema.tables)

    @later()
    def wings(database: Database) -> None:
        database.execute("ALTER TABLE sites ADD COLUMN wing TEXT")

    monkeypatch.setattr(database_module, "MIGRATIONS", later)
    monkeypatch.setattr(database_module, "FORMAT", FORMAT + 1)
    path, copy = tmp_path / "store.sqlite3", tmp_path / f"store-format-{FORMAT}.sqlite3"
    before = path.read_bytes()
    with MapStore.open(tmp_path, read_only=True) as store:
        assert store._transactions.query("SELECT site, wing FROM sites") == [{"site": "lab", "wing": None}]
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
        applied = store._transactions.query("SELECT name FROM _sqlite_migrations ORDER BY rowid")
    assert [row["name"] for row in applied] == ["tables", "wings"]
    assert copy.read_bytes() == copied, "once"


def format_of(path: Path) -> int:
    with closing(sqlite3.connect(path)) as connection:
        return int(connection.execute("PRAGMA user_version").fetchone()[0])
