"""Reading beside a write: it neither waits nor sees what is not committed."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from fleetmap.errors import StoreError
from mapserver.store.database import Transactions

COUNT = "SELECT count(*) AS n FROM events"
_LINE = "INSERT INTO events (stamp_ns, site, kind, detail) VALUES (1, 'hall', 'note', 'x')"


@pytest.fixture
def ledger(tmp_path: Path) -> Iterator[Transactions]:
    opened = Transactions(tmp_path / "store.sqlite3", lambda: 1)
    yield opened
    opened.close()


def _read_elsewhere(ledger: Transactions) -> int:
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(ledger.query(COUNT)[0]["n"]), daemon=True)
    thread.start()
    thread.join(timeout=20)
    assert found, "reading waits for the transaction"
    return found[0]


def test_others_read_on_while_a_transaction_is_open(ledger: Transactions) -> None:
    with ledger.write() as connection:
        connection.execute(_LINE)
        assert ledger.query(COUNT)[0]["n"] == 1, "its own thread sees what it wrote"
        assert _read_elsewhere(ledger) == 0
    assert _read_elsewhere(ledger) == ledger.query(COUNT)[0]["n"] == 1


def test_what_is_taken_back_was_never_there(ledger: Transactions) -> None:
    with pytest.raises(RuntimeError), ledger.write() as connection:
        connection.execute(_LINE)
        raise RuntimeError
    assert ledger.query(COUNT)[0]["n"] == 0


def test_reading_cannot_write(ledger: Transactions) -> None:
    with pytest.raises(StoreError, match="cannot be read"):
        ledger.query(_LINE)


def test_closing_leaves_one_file(tmp_path: Path) -> None:
    """The write-ahead log is folded in by the last connection; a copy of the file is then the whole database."""
    opened = Transactions(tmp_path / "store.sqlite3", lambda: 1)
    with opened.write() as connection:
        connection.execute(_LINE)
    opened.query(COUNT)
    opened.close()
    assert [path.name for path in tmp_path.iterdir()] == ["store.sqlite3"]
