"""A server that is killed while failures come in has all that it acknowledged, and has it once, when it is back."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from fleetmap.bus import Bus
from fleetmap.errors import FleetmapError
from fleetmap.messages import FailureAck, FailureReport, Thumbnail, decode_message, encode_message, robot_key
from mapserver import releases
from mapserver.store import FailureFilter, MapStore
from support.storage.map_samples import save_sample_draft

ROBOTS, FAILURES = 4, 20
_REPOSITORY = Path(__file__).resolve().parents[3]
_SOURCES = os.pathsep.join(str(_REPOSITORY / folder) for folder in ("shared", ""))


def serve(folder: Path, endpoint: str) -> tuple[subprocess.Popen[str], str]:
    """A running server and its endpoint."""
    program = "import sys; from mapserver.cli import main; main()"
    words = ["serve", "--store", str(folder), "--http", "127.0.0.1:0", "--zenoh", endpoint]
    process = subprocess.Popen(
        [sys.executable, "-c", program, *words],
        env=os.environ | {"PYTHONPATH": _SOURCES},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    lines = [process.stdout.readline().strip() for _ in range(3)]
    assert lines[2] == "ready", lines
    return process, lines[1].removeprefix("zenoh: ")


class Robot(threading.Thread):
    """Sends its failures in order, each until it is acknowledged."""

    def __init__(self, endpoint: str, name: str, acknowledged: set[tuple[str, str]]) -> None:
        super().__init__()
        self._endpoint, self._name, self._acknowledged = endpoint, name, acknowledged

    def run(self) -> None:
        with Bus.connect(self._endpoint) as bus:
            for number in range(FAILURES):
                report = FailureReport(
                    site="lab", robot=self._name, id=f"f{number}", stamp_ns=number, wall_ns=time.time_ns(), duration_s=3.0,
                    kind="blind", status="LOST", cause="dark", version=1, tile=(0, 0),
                    thumbnails=(Thumbnail(stamp_ns=number, kind="frame", jpeg=b"\xff\xd8" + bytes(20_000) + b"\xff\xd9"),),
                )  # fmt: skip
                while (self._name, report.id) not in self._acknowledged:
                    try:
                        answer = bus.get(
                            robot_key("lab", self._name, "failures"), encode_message(report), timeout_s=1.0
                        )
                    except FleetmapError:
                        continue
                    if decode_message(answer, FailureAck) == FailureAck(id=report.id):
                        self._acknowledged.add((self._name, report.id))


def test_nothing_acknowledged_is_lost_and_nothing_is_counted_twice(tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        save_sample_draft(store)
        releases.publish(store, "lab")
    acknowledged: set[tuple[str, str]] = set()
    process, endpoint = serve(tmp_path, "tcp/127.0.0.1:0")
    robots = [Robot(endpoint, f"r{n}", acknowledged) for n in range(ROBOTS)]
    for robot in robots:
        robot.start()
    kills = 0
    try:
        for goal in (10, 40):
            deadline = time.monotonic() + 60
            while len(acknowledged) < goal and time.monotonic() < deadline:
                time.sleep(0.002)
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills += 1
            before = set(acknowledged)
            with MapStore.open(tmp_path) as store:
                kept = [(row.robot, row.failure_id) for row in store.fleet.failures(FailureFilter())]
                assert len(kept) == len(set(kept))
                assert before <= set(kept)
                assert store.verify().faults == []
            process, _ = serve(tmp_path, endpoint)
        for robot in robots:
            robot.join(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert kills == 2
    assert len(acknowledged) == ROBOTS * FAILURES
    with MapStore.open(tmp_path) as store:
        kept = [(row.robot, row.failure_id) for row in store.fleet.failures(FailureFilter())]
        assert sorted(kept) == sorted(acknowledged)
        for axis, key, count in (("site", "", 80), ("robot", "r0", 20), ("tile", "0,0", 80), ("cause", "dark", 80)):
            assert store.fleet.counters("lab", axis, key=key)["lab", key].failures == count
