"""Two servers of one store in PostgreSQL and S3, behind a balancer, of which one after the other is killed while robots report and ask.

`PYTHONPATH=tests python -m support.fleet.two_servers [--robots N] [--seconds N] [--kill-every N] [--every N] [--out FILE.json]`.
Robots deliver failures until they are acknowledged, and ask for their version, both every so many seconds. Afterwards the store must hold
each acknowledged failure, once, in its rows and in its sums.
"""

import asyncio
import os
import random
import shutil
import subprocess
import tempfile
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

from benchmarks.common.recorded_runs import Options, Results, benchmark, tool
from fleetmap.bus.endpoints import with_free_port
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import FleetmapError
from fleetmap.messages import FailureAck, WantedVersion, decode_message, encode_message, robot_key
from mapserver.store import FailureFilter, MapStore, chain_faults
from mapserver.store.places import Places
from mapserver.trust import init_here
from support.fleet.reports import blindness
from support.storage.map_samples import publish_samples
from support.storage.postgres_server import postgres_server
from support.storage.s3_server import KEYS, s3_server

_ANSWER_WITHIN_S = 2.0


class Servers:
    """Two `mapserver serve`, each with a folder of its own, and a balancer at `endpoint`."""

    def __init__(self, folder: Path, database: str, content: str) -> None:
        self.folders = [folder / name for name in ("here", "there")]
        with MapStore.open(self.folders[0], create=True) as store:
            publish_samples(store, 1)
            init_here(store)
        MapStore.attach(self.folders[0], Places(content, database))
        MapStore.attach(self.folders[1], Places(content, database))
        shutil.copytree(self.folders[0] / "keys", self.folders[1] / "keys")
        self._endpoints = [with_free_port("tcp/127.0.0.1:0") for _ in self.folders]
        self._processes = [self._started(number) for number in range(2)]
        self.endpoint, self._loop = with_free_port("tcp/127.0.0.1:0"), asyncio.new_event_loop()
        threading.Thread(target=self._balance, daemon=True).start()

    def kill(self, number: int) -> None:
        """Kill one, and start it again."""
        self._processes[number].kill()
        self._processes[number].wait()
        self._processes[number] = self._started(number)

    def close(self) -> list[int]:
        """Stop both as a service manager does; return their statuses."""
        for process in self._processes:
            process.terminate()
        return [process.wait(timeout=30) for process in self._processes]

    def _started(self, number: int) -> subprocess.Popen[str]:
        command = [*tool("mapserver"), "serve", "--store", str(self.folders[number])]
        command += ["--http", "127.0.0.1:0", "--zenoh", self._endpoints[number]]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        lines = [process.stdout.readline().strip() for _ in range(3)]
        assert lines[2] == "ready", lines
        return process

    def _balance(self) -> None:
        asyncio.set_event_loop(self._loop)
        port = int(self.endpoint.rpartition(":")[2])
        self._loop.run_until_complete(asyncio.start_server(self._forward, "127.0.0.1", port))
        self._loop.run_forever()

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for endpoint in random.sample(self._endpoints, 2):
            with suppress(OSError):
                other = await asyncio.open_connection("127.0.0.1", int(endpoint.rpartition(":")[2]))
                await asyncio.gather(_pump(reader, other[1]), _pump(other[0], writer))
                return
        writer.close()


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(1 << 16):
            writer.write(data)
            await writer.drain()
    writer.close()


class Robot(threading.Thread):
    """Reports a failure and asks for its version, in turn, until told to stop. late_s: times of questions that took too long."""

    def __init__(self, endpoint: str, name: str, every_s: float, over: threading.Event) -> None:
        super().__init__(daemon=True)
        self.robot, self._endpoint, self._every_s, self._over = name, endpoint, every_s, over
        self.acknowledged: set[str] = set()
        self.late_s: list[float] = []
        self.questions = 0

    def run(self) -> None:
        with Bus(self._endpoint).open() as bus:
            while not self._over.wait(random.uniform(0, 2 * self._every_s)):
                self._report(bus, f"f{len(self.acknowledged)}")
                if not self._over.is_set():
                    self._ask(bus)

    def _report(self, bus: Bus, number: str) -> None:
        report = blindness(number, self.robot, wall_ns=time.time_ns(), tile=(0, 0))
        answer = self._answer(bus, "failures", encode_message(report), 60.0)[0]
        if answer is not None and decode_message(answer, FailureAck) == FailureAck(id=report.id):
            self.acknowledged.add(report.id)

    def _ask(self, bus: Bus) -> None:
        answer, took_s = self._answer(bus, "wanted", b"", 60.0)
        if answer is not None:
            assert decode_message(answer, WantedVersion).version == 1
            self.questions += 1
            self.late_s += [took_s] if took_s > _ANSWER_WITHIN_S else []

    def _answer(self, bus: Bus, what: str, payload: bytes, within_s: float) -> tuple[bytes | None, float]:
        """Ask again until there is an answer, as a robot does; its time from the first question on."""
        begun_s = time.monotonic()
        while time.monotonic() < begun_s + within_s:
            with suppress(FleetmapError):
                return bus.get(robot_key("lab", self.robot, what), payload, timeout_s=0.5), time.monotonic() - begun_s
        return None, within_s


def run(
    database: str, content: str, robots: int, seconds: float, kill_every_s: float, every_s: float
) -> dict[str, Any]:
    """Return what was acknowledged, asked, killed, and what is wrong; `wrong` is empty for a good run."""
    with tempfile.TemporaryDirectory() as folder:
        servers, over = Servers(Path(folder), database, content), threading.Event()
        fleet = [Robot(servers.endpoint, f"r{number}", every_s, over) for number in range(robots)]
        for robot in fleet:
            robot.start()
        begun_s, kills = time.monotonic(), 0
        while time.monotonic() < begun_s + seconds or kills < 2:  # a busy machine starts a server in half a minute
            time.sleep(kill_every_s)
            servers.kill(kills % 2)
            kills += 1
        over.set()
        for robot in fleet:
            robot.join(90)
        statuses = servers.close()
        wrong = [f"a server ended with {status}" for status in statuses if status]
        with MapStore.open(servers.folders[1]) as store:
            rows = Counter((row.robot, row.failure_id) for row in store.fleet.failures(FailureFilter()))
            kept = {(robot.robot, name) for robot in fleet for name in robot.acknowledged}
            wrong += [f"{name} is lost" for name in sorted(kept - rows.keys())]
            wrong += [f"{name} is there {count} times" for name, count in rows.items() if count > 1]
            for axis, key in (("site", ""), ("cause", "dark"), ("tile", "0,0")):
                counted = store.fleet.counters("lab", axis, key=key)["lab", key].failures
                wrong += [f"{axis}: {counted} counted, {len(rows)} there"] if counted != len(rows) else []
            wrong += store.verify().faults + chain_faults(store.log()[::-1])
    asked, late_s = sum(robot.questions for robot in fleet), sorted(t for robot in fleet for t in robot.late_s)
    return {
        "robots": robots, "kills": kills, "acknowledged": len(kept), "questions": asked, "late": len(late_s),
        "latest_s": round(late_s[-1], 1) if late_s else None, "within_2_s": round(1 - len(late_s) / max(1, asked), 5), "wrong": wrong,
    }  # fmt: skip


@benchmark(robots=300, seconds=600, kill_every=60, every=5)
def main(arguments: Options) -> Results:
    with postgres_server() as postgres, tempfile.TemporaryDirectory() as folder, s3_server(Path(folder)) as address:
        os.environ |= KEYS | {"AWS_ENDPOINT_URL": address}
        how = (arguments.robots, arguments.seconds, arguments.kill_every, arguments.every)
        return run(postgres.database(), "s3://fleet/two-servers", *how)
