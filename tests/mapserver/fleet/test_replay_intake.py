"""Recordings of failures come in parts, are judged as files of strangers, and cost the reports nothing. Rows 8, 23, 25."""

import struct
import subprocess
import threading
from dataclasses import dataclass
from pathlib import Path

import pytest
import zstandard
from mcap.opcode import Opcode

from fleetmap.errors import LinkError, UsageError
from fleetmap.failure_summary import ReplayPart
from fleetmap.messages import FailureAck
from mapserver.fleet import replay_intake
from mapserver.fleet.bounded_process import ProcessLimits
from mapserver.fleet.fleet import Fleet
from mapserver.fleet.ingest import IngestSettings
from mapserver.store import MapStore
from support.fleet.failed_robot import asked, small_file
from support.fleet.reports import blindness
from support.plugins import needs_plugin
from support.storage.clock import Clock
from support.storage.map_samples import publish_samples

MAGIC = b"\x89MCAP0\r\n"


@dataclass
class Server:
    store: MapStore
    fleet: Fleet
    clock: Clock

    def report(self, name: str = "f1", robot: str = "r1") -> None:
        report = blindness(name, robot, wall_ns=self.clock.now_ns)
        assert self.fleet.take_failure("lab", robot, report).refused == ""

    def send(self, data: bytes, name: str = "f1", robot: str = "r1", part_bytes: int = 50_000) -> FailureAck:
        """All of it, as a robot sends it."""
        offset = 0
        while True:
            part = ReplayPart(id=name, total_bytes=len(data), offset=offset, data=data[offset : offset + part_bytes])
            ack = asked(self.fleet, "lab", robot, part)
            if ack.refused or ack.received_bytes in (offset, len(data)):
                return ack
            offset = ack.received_bytes


@pytest.fixture
def server(store: MapStore, clock: Clock) -> Server:
    publish_samples(store, 1)
    return Server(store, Fleet(store, clock_ns=clock), clock)


def test_parts_make_the_recording(server: Server, tmp_path: Path) -> None:
    data = small_file(tmp_path / "f.mcap")
    server.report()
    assert server.send(data) == FailureAck(id="f1", received_bytes=len(data))
    assert server.store.fleet.replay(1) == data
    pictures = server.store.fleet.failure(1).pictures
    assert [(picture.kind, picture.stamp_ns) for picture in pictures] == [("replay", k * 10**8) for k in (0, 2, 4)]
    assert server.store.fleet.picture(1, 2).startswith(b"\xff\xd8")
    assert server.send(data).received_bytes == len(data), "once more is no fault"
    assert len(server.store.fleet.failure(1).pictures) == 3


def test_a_part_that_is_lost_or_comes_twice_is_asked_for(server: Server, tmp_path: Path) -> None:
    data = small_file(tmp_path / "f.mcap")
    server.report()

    def send(offset: int, end: int) -> int:
        part = ReplayPart(id="f1", total_bytes=len(data), offset=offset, data=data[offset:end])
        return server.fleet.replays.take("lab", "r1", part).received_bytes

    assert send(1000, 2000) == 0, "from the beginning, please"
    assert [send(0, 1000), send(0, 1000), send(5000, 6000), send(1000, 1500)] == [1000, 1000, 1000, 1500]
    server.clock.now_ns += 61 * 10**9
    server.report("f2", robot="r2")
    server.send(data, "f2", robot="r2")  # the idle one is forgotten
    assert send(1500, 2000) == 0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"robot": "r2"}, "not of 'f1' of 'r1'"),
        ({"id": "f9"}, "failure 'f9'"),
        ({"attached": False}, "not a failure's recording"),
        ({"jpegs": [b"\xff\xd8<script>\xff\xd9"] * 2}, "cannot be read as an image"),
        pytest.param({"jpegs": []}, "no message", marks=needs_plugin("mcap")),
    ],
)
def test_what_no_robot_writes_is_refused_and_nothing_else_is_lost(
    server: Server, tmp_path: Path, changes: dict[str, object], said: str
) -> None:
    server.report()
    assert said in server.send(small_file(tmp_path / "f.mcap", **changes)).refused
    with pytest.raises(UsageError, match="no recording"):
        server.store.fleet.replay(1)
    assert server.store.fleet.failure(1).report.id == "f1"
    good = small_file(tmp_path / "g.mcap")
    assert server.send(good).refused == ""
    assert server.store.fleet.replay(1) == good


@pytest.mark.parametrize("opcode", [0, Opcode.MESSAGE])
def test_a_small_file_of_many_records_costs_little_and_nobody_waits_for_it(
    server: Server, tmp_path: Path, opcode: int, monkeypatch
) -> None:
    """507 bytes of 7 million empty records took 6 s, on the thread that hears all robots."""
    records = (bytes([opcode]) + bytes(8)) * (60_000_000 // 9)
    packed = zstandard.ZstdCompressor().compress(records)
    chunk = struct.pack("<QQQII4sQ", 0, 0, len(records), 0, 4, b"zstd", len(packed)) + packed
    server.report()
    assert "records; leave" in server.send(MAGIC + struct.pack("<BQ", Opcode.CHUNK, len(chunk)) + chunk + MAGIC).refused
    monkeypatch.setattr(replay_intake, "_LIMITS", ProcessLimits(wall_s=0.0))
    server.report("f2")
    assert "was ended after" in server.send(small_file(tmp_path / "f.mcap", id="f2"), "f2").refused
    held = threading.Event()
    monkeypatch.setattr(replay_intake, "run_bounded", lambda *_: held.wait(20.0))
    monkeypatch.setattr(replay_intake, "_ANSWER_WITHIN_S", 0.0)
    server.report("f3")
    part = ReplayPart(id="f3", total_bytes=1, offset=0, data=b"x")
    for _ in range(2):
        with pytest.raises(LinkError, match="later: the recording is being judged"):
            server.fleet.replays.take("lab", "r1", part)
    server.report("f3", robot="r2")
    more = ReplayPart(id="f3", total_bytes=2, offset=0, data=b"x")
    assert server.fleet.replays.take("lab", "r2", more).received_bytes == 1
    held.set()


def test_a_recording_without_a_report_and_one_too_large_are_refused(server: Server, tmp_path: Path) -> None:
    assert "send its report first" in server.send(small_file(tmp_path / "f.mcap")).refused
    server.report()
    part = ReplayPart(id="f1", total_bytes=1 << 30, offset=0, data=b"x")
    assert "limit" in server.fleet.replays.take("lab", "r1", part).refused


def test_uploads_and_rates_are_bounded(server: Server, monkeypatch) -> None:
    ended = subprocess.CompletedProcess([], 1, "", "no recording")
    monkeypatch.setattr(replay_intake, "run_bounded", lambda *_: ended)
    for number in range(replay_intake.MAX_UPLOADS + 1):
        server.report("f1", robot=f"r{number}")
        part = ReplayPart(id="f1", total_bytes=1000, offset=0, data=b"x")
        if number < replay_intake.MAX_UPLOADS:
            assert server.fleet.replays.take("lab", f"r{number}", part).received_bytes == 1
            continue
        with pytest.raises(LinkError, match=r"^later"):
            server.fleet.replays.take("lab", f"r{number}", part)
    server.clock.now_ns += 61 * 10**9
    for number in range(replay_intake.REPLAY_BURST):
        server.report(f"g{number}", robot="r9")
        assert server.send(b"x" * 100, f"g{number}", robot="r9").refused
    server.report("more", robot="r9")
    with pytest.raises(LinkError, match=r"^later.*ten minutes"):
        server.send(b"x" * 100, "more", robot="r9")


def test_the_oldest_recordings_go(store: MapStore, clock: Clock, tmp_path: Path) -> None:
    data = small_file(tmp_path / "f.mcap")
    publish_samples(store, 1)
    settings = IngestSettings(replay_bytes=2 * len(data) + 100)
    server = Server(store, Fleet(store, settings=settings, clock_ns=clock), clock)
    for number in range(3):
        server.report(f"f{number}")
        assert server.send(small_file(tmp_path / "n.mcap", id=f"f{number}"), f"f{number}").refused == ""
    with pytest.raises(UsageError, match="for space"):
        store.fleet.replay(1)
    assert store.fleet.failure(1).report.id == "f0", "the failure stays"
    assert store.fleet.replay(2)
    assert store.fleet.replay(3)
