"""Reports outlive the process, the order is kept, room is bounded and what is lost is counted."""

import stat
from pathlib import Path

import pytest

from fleetmap.files import OWN_FILE
from locclient.delivery.outbox import Outbox, QueuedReport


def report(name: str, size: int = 10) -> QueuedReport:
    return QueuedReport(name, name.encode() * size)


def test_what_waits_survives_a_restart_in_order(tmp_path: Path) -> None:
    spool = Outbox(tmp_path / "new" / "spool.sqlite3", max_bytes=10_000)
    assert stat.S_IMODE((tmp_path / "new" / "spool.sqlite3").stat().st_mode) == OWN_FILE
    for name in ("a", "b", "c"):
        spool.put(report(name))
    spool.put(report("a", size=20))
    again = Outbox(tmp_path / "new" / "spool.sqlite3", max_bytes=10_000)
    assert again.waiting(10) == [report("a"), report("b"), report("c")]
    again.done("a")
    again.done("a")
    again.refused("c")
    assert again.waiting() == [report("b")]
    assert again.counts() == {"waiting": 1, "delivered": 1, "dropped": 0, "refused": 1}


def test_the_oldest_are_dropped_and_counted(tmp_path: Path) -> None:
    spool = Outbox(tmp_path / "spool", max_bytes=250)
    for name in "abcde":
        spool.put(report(name, size=100))
    assert [kept.id for kept in spool.waiting(10)] == ["d", "e"]
    assert spool.counts()["dropped"] == 3
    spool.put(report("f", size=1000))
    assert [kept.id for kept in spool.waiting(10)] == ["f"]


@pytest.mark.parametrize("content", [b"no database at all" * 300, b"SQLite format 3\0" + b"\xff" * 8000])
def test_a_damaged_file_is_set_aside(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "spool").write_bytes(content)
    spool = Outbox(tmp_path / "spool", max_bytes=1000)
    assert spool.set_aside == tmp_path / "spool.damaged"
    assert spool.set_aside.read_bytes() == content
    spool.put(report("a"))
    assert spool.waiting() == [report("a")]
