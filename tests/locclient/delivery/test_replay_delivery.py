"""Recordings of failures travel in parts behind the reports: all of their bytes once, whatever the server forgets or refuses."""

import logging
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from fleetmap.failure_summary import ReplayPart
from fleetmap.messages import PART_BYTES, FailureAck, decode_message
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.delivery.report_delivery import ReplayQueue, deliver_replay_part

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
    received: dict[str, int] = {}
    for count in range(20):
        if not deliver_replay_part(server, outbox, received):  # type: ignore[arg-type]
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
    unfinished: Any = SimpleNamespace(frames=None)
    profile: Any = None
    queue = ReplayQueue(outbox, profile)
    with caplog.at_level(logging.WARNING):
        for number in range(5):
            report: Any = SimpleNamespace(id=f"f{number}")
            queue.add(report, unfinished)
    assert [record.getMessage() for record in caplog.records] == [
        "failures follow each other too fast: f0 goes without its recording"
    ]
    queue.work()
    assert outbox.counts()["waiting"] == 1, "the four are not whole yet"
