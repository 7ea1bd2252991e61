"""Reports wait on the disk; recordings of failures travel in parts behind them: all of their bytes once, whatever the server forgets."""

import stat
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest

from fleetmap.failure_summary import ReplayPart
from fleetmap.files import OWN_FILE
from fleetmap.messages import PART_BYTES, FailureAck, decode_message
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.delivery.report_delivery import ReplayQueue, deliver_replay_part


def report(name: str, size: int = 10) -> QueuedReport:
    return QueuedReport(name, name.encode() * size)


def test_what_waits_survives_a_restart_in_order(tmp_path: Path) -> None:
    spool = Outbox(tmp_path / "new" / "spool.sqlite3", max_bytes=10_000)
    for name in ("a", "b", "c"):
        spool.put(report(name))
    assert stat.S_IMODE((tmp_path / "new" / "spool.sqlite3").stat().st_mode) == OWN_FILE
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
    spool.put(report("a"))
    assert spool.waiting() == [report("a")]
    assert spool.set_aside == tmp_path / "spool.damaged"
    assert spool.set_aside.read_bytes() == content


DATA = bytes(range(256)) * (5 * PART_BYTES // 512)  # two parts and a half


@dataclass
class Server:
    """What arrived, as a map client sees it. forgets: once, when a part begins here."""

    data: bytes = b""
    forgets: int = -1
    refuses: str = ""
    parts: list[int] = field(default_factory=list)

    def deliver(self, _: str, payload: bytes) -> FailureAck:
        part = decode_message(payload, ReplayPart)
        self.parts.append(part.offset)
        assert len(part.data) <= PART_BYTES
        if part.offset == self.forgets:
            self.data, self.forgets = b"", -1
        if part.offset == len(self.data):
            self.data += part.data
        return FailureAck(id=part.id, received_bytes=len(self.data), refused=self.refuses)


@pytest.fixture
def outbox(tmp_path: Path) -> Outbox:
    made = Outbox(tmp_path / "replays", max_bytes=10**7)
    made.put(QueuedReport("f1", DATA))
    return made


def sent(server: Server, outbox: Outbox) -> int:
    """Calls until nothing goes on."""
    for count in range(20):
        if not deliver_replay_part(server, outbox):  # type: ignore[arg-type]
            return count
    raise AssertionError("it never ends")


@pytest.mark.parametrize("forgets", [-1, PART_BYTES, 2 * PART_BYTES])
def test_all_bytes_arrive_in_their_order(outbox: Outbox, forgets: int) -> None:
    server = Server(forgets=forgets)
    sent(server, outbox)
    assert server.data == DATA
    assert server.parts[:2] == [0, PART_BYTES]
    assert outbox.counts() == {"waiting": 0, "delivered": 1, "dropped": 0, "refused": 0}


def test_what_the_server_refuses_is_not_sent_again(outbox: Outbox) -> None:
    server = Server(refuses="no such failure")
    assert sent(server, outbox) == 1
    assert server.parts == [0]
    assert outbox.counts()["refused"] == 1


def test_more_failures_than_are_held_are_named(outbox: Outbox, caplog: pytest.LogCaptureFixture) -> None:
    queue = ReplayQueue(outbox, None)
    for number in range(5):
        queue.add(SimpleNamespace(id=f"f{number}"), SimpleNamespace(frames=None))
    assert caplog.messages == ["failures follow each other too fast: f0 goes without its recording"]
    queue.work()
    assert outbox.counts()["waiting"] == 1, "the four are not whole yet"
