"""The daemon as a process: without a network, killed, started again, told to stop."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.messages import FailureAck, FailureReport, decode_message, encode_message, robot_key
from fleetmap.recordings.calibration_files import format_calibration
from locclient.delivery.outbox import Outbox
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from mapserver.fleet.fleet import Fleet
from mapserver.serving.bus_service import BusService
from mapserver.store import FailureFilter, MapStore
from mapserver.trust import init_here
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.fleet.tls_site import TlsSite
from support.recordings.recording_samples import calibration
from support.waiting import eventually
from support.worlds import robot_world

PATIENCE_S = 120.0  # on a machine that may be busy


def configuration(folder: Path, recording: Path, endpoint: str, *, speed: float) -> Path:
    path = folder / "robot.toml"
    path.write_text(
        f'[run]\nserver = "{endpoint}"\nsite = "room"\nrobot = "r1"\ncache = "{folder}/cache"\n'
        f'outbox = "{folder}/spool.sqlite3"\nfailures = "{folder}/failures"\n'
        f'[source]\nkind = "recording"\nrecording = "{recording}"\nspeed = {speed}\n'
    )
    return path


@contextmanager
def daemon(config: Path, notify: Path) -> Iterator[subprocess.Popen[str]]:
    """A running `locclient run`; killed at the end if it still lives."""
    environment = {**os.environ, "PYTHONPATH": ":".join(sys.path), "NOTIFY_SOCKET": str(notify)}
    arguments = [sys.executable, "-m", "locclient.cli", "run", "--config", str(config), "--verbose"]
    with subprocess.Popen(arguments, env=environment, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def wait_for(found: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    is_over = eventually(lambda: found() or process.poll() is not None, PATIENCE_S)
    if not (is_over and process.poll() is None):
        process.kill()
        pytest.fail(process.stderr.read() if process.stderr else "")


@pytest.mark.timeout(1200)
def test_a_failure_arrives_once_though_the_robot_was_killed_before_it_could_tell(tmp_path: Path) -> None:
    """Away from its server, on what its disk holds, the robot goes dark: blind, dark. It is killed. A later life delivers."""
    hub, table = MemoryHub(), []
    robot_world.stored(tmp_path / "store")
    with MapStore.open(tmp_path / "store") as store, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        with MemoryBus(hub) as bus, MemoryBus(hub) as robot_bus:
            service = BusService(store, Fleet(store), bus, lambda *_: None)
            link = MapClient(robot_bus, TileCache(tmp_path / "cache"), "room", "r1")
            link.bring(link.wanted())
            service.close()

        with Bus("tcp/127.0.0.1:0", is_server=True).open() as found_port:
            endpoint = found_port.endpoint  # free again in a moment, and nobody answers there
        dark_walk = robot_world.write(tmp_path / "dark", robot_world.bundles(280, dark=range(130, 280)))
        with daemon(configuration(tmp_path, dark_walk, endpoint, speed=0.0), tmp_path / "notify") as process:
            spool = tmp_path / "spool.sqlite3"
            wait_for(lambda: any((tmp_path / "failures").glob("*.json")), process)
            process.send_signal(signal.SIGKILL)
            process.wait()
        (waiting,) = Outbox(spool, max_bytes=10**8).waiting(10)
        report = decode_message(waiting.payload, FailureReport)
        assert (report.kind, report.cause, report.version) == ("blind", "dark", 1)
        assert any(note.inliers for note in report.fixes), "it had localised itself without any server"
        assert manager.recv(100) == b"READY=1"
        assert manager.recv(100).startswith(b"WATCHDOG=1\nSTATUS=")

        def take(_: str, payload: bytes) -> bytes:
            table.append(decode_message(payload, FailureReport).id)
            return encode_message(FailureAck(id=table[-1]))

        fleet = Fleet(store)
        with Bus(endpoint, is_server=True).open() as bus:
            init_here(store)
            service = BusService(store, fleet, bus, lambda *_: None)
            bus.queryable(robot_key("*", "*", "failures"), take)
            light_walk = robot_world.write(tmp_path / "light", robot_world.bundles(70))
            config = configuration(tmp_path, light_walk, endpoint, speed=0.5)
            with daemon(config, tmp_path / "notify") as process:
                told = lambda: bool(table) and fleet.robots("room") and fleet.robots("room")[0].last_health is not None  # noqa: E731
                wait_for(lambda: bool(told()), process)
                process.send_signal(signal.SIGTERM)
                assert process.wait(30) == 0
            service.close()
        assert fleet.robots("room")[0].version == 1
    assert table == [report.id]
    assert Outbox(spool, max_bytes=10**8).counts()["delivered"] == 1


@pytest.mark.timeout(900)
def test_an_enrolled_robot_drives_on_through_failures_a_new_version_and_restarts(tmp_path: Path) -> None:
    """`locclient run` in real time, over TLS, on a rig with an IMU and a Kalibr file: no thread dies, nothing stands in a log."""
    site = TlsSite(tmp_path, "room")
    with MapStore.open(site.store, create=True) as store:
        robot_world.save(store)
        site.run("mapserver", "trust", "init", "--here", "--host", "127.0.0.1", "--store", site.store)
        ride = robot_world.write(tmp_path / "ride", robot_world.bundles(900, dark=range(100, 220)))
        (tmp_path / "rig.yaml").write_text(format_calibration(calibration()))
        with site.serving():
            site.enrol("r1")
            site.configure("r1", f'kind = "recording"\nrecording = "{ride}"\ncalibration = "{tmp_path}/rig.yaml"')

            def told(name: str) -> object:
                return (site.robot("r1").get("last_health") or {}).get(name)

            with site.daemon("r1") as process:
                wait_for(lambda: told("status") == "TRACKING", process)
                wait_for(lambda: "dark" in (told("flags") or ()), process)
                assert site.stop() == 0
                site.start()
                wait_for(lambda: bool(store.fleet.failures(FailureFilter(site="room"))), process)
                robot_world.save(store)
                wait_for(lambda: (site.robot("r1").get("last_ack") or {}).get("version") == 2, process)
                process.send_signal(signal.SIGKILL)
            with site.daemon("r1") as process:
                begun_ns = time.time_ns()
                wait_for(lambda: int(told("wall_ns") or 0) > begun_ns and told("status") == "TRACKING", process)
                assert told("version") == 2, "it goes on with what its disk holds"
                process.send_signal(signal.SIGTERM)
                assert process.wait(30) == 0
        assert {row.cause for row in store.fleet.failures(FailureFilter(site="room"))} == {"dark"}
    for log in (site.log("r1"), tmp_path / "server.log"):
        assert "Traceback" not in log.read_text("utf-8", "replace")
