"""A server that is killed while failures come in has all that it acknowledged, and has it once, when it is back."""

import threading
import time
from contextlib import ExitStack
from pathlib import Path

from benchmarks.fleet.server_process import serving
from fleetmap.bus import Bus
from fleetmap.errors import FleetmapError
from fleetmap.messages import FailureAck, Thumbnail, decode_message, encode_message, robot_key
from mapserver.store import FailureFilter, MapStore
from support.fleet.reports import blindness
from support.storage.map_samples import publish_samples

ROBOTS, FAILURES = 4, 20


class Robot(threading.Thread):
    """Sends its failures in order, each until it is acknowledged."""

    def __init__(self, endpoint: str, name: str, acknowledged: set[tuple[str, str]]) -> None:
        super().__init__()
        self._endpoint, self._name, self._acknowledged = endpoint, name, acknowledged

    def run(self) -> None:
        with Bus.connect(self._endpoint) as bus:
            for number in range(FAILURES):
                seen = (Thumbnail(stamp_ns=number, kind="frame", jpeg=b"\xff\xd8" + bytes(20_000) + b"\xff\xd9"),)
                report = blindness(f"f{number}", self._name, wall_ns=time.time_ns(), tile=(0, 0), thumbnails=seen)
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
        publish_samples(store, 1)
    acknowledged: set[tuple[str, str]] = set()
    with ExitStack() as servers:
        process, _, endpoint = servers.enter_context(serving(tmp_path))
        robots = [Robot(endpoint, f"r{n}", acknowledged) for n in range(ROBOTS)]
        for robot in robots:
            robot.start()
        for goal in (10, 40):
            deadline = time.monotonic() + 60
            while len(acknowledged) < goal and time.monotonic() < deadline:
                time.sleep(0.002)
            process.kill()
            process.wait()
            before = set(acknowledged)
            with MapStore.open(tmp_path) as store:
                kept = [(row.robot, row.failure_id) for row in store.fleet.failures(FailureFilter())]
                assert len(kept) == len(set(kept))
                assert before <= set(kept)
                assert store.verify().faults == []
            process, *_ = servers.enter_context(serving(tmp_path, endpoint))
        for robot in robots:
            robot.join(timeout=60)
        process.kill()
        process.wait()
    assert len(acknowledged) == ROBOTS * FAILURES
    with MapStore.open(tmp_path) as store:
        kept = [(row.robot, row.failure_id) for row in store.fleet.failures(FailureFilter())]
        assert sorted(kept) == sorted(acknowledged)
        for axis, key, count in (("site", "", 80), ("robot", "r0", 20), ("tile", "0,0", 80), ("cause", "dark", 80)):
            assert store.fleet.counters("lab", axis, key=key)["lab", key].failures == count
