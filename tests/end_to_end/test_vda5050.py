"""A fleet manager of VDA 5050, a real mosquitto, the map server over HTTP and the bus, and the robot's daemon as a process."""

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from fleetmap.mapformat.names import sha256_hex
from mapserver.store import MapStore
from mapserver.trust import init_here, update_lists
from support.fleet.dashboard_scene import serving
from support.fleet_manager.vda5050_master import Master, mosquitto, until
from support.worlds import robot_world

START_S = 120.0  # on a machine that may be busy
FRAMES, CARRIED_AT = 1100, 495  # while it stands; at 490, where the IMU leaves out a frame, its images follow it there


@contextmanager
def robot(
    folder: Path, endpoint: str, broker: int, http: str, version: str = "3.0.0"
) -> Iterator[subprocess.Popen[bytes]]:
    recording = folder / "ride"
    if not recording.exists():
        robot_world.write(recording, robot_world.carried(FRAMES, CARRIED_AT))
    config = folder / "robot.toml"
    config.write_text(
        "[run]\n"
        + f'server = "{endpoint}"\n' * bool(endpoint)
        + f'site = "room"\nrobot = "r1"\ncache = "{folder}/cache"\noutbox = "{folder}/outbox"\n'
        f'[source]\nkind = "recording"\nrecording = "{recording}"\n'
        f'[vda5050]\nbroker = "mqtt://127.0.0.1:{broker}"\nmanufacturer = "acme"\nserial_number = "0001"\n'
        f'download_from = ["{http}"]\nstate_interval_s = 0.5\ninitialize_s = 10.0\nversion = "{version}"\n'
    )
    arguments = [sys.executable, "-m", "locclient.cli", "run", "--config", str(config), "--verbose"]
    environment = {**os.environ, "PYTHONPATH": ":".join(sys.path)}
    with (folder / "log").open("wb") as log, subprocess.Popen(arguments, env=environment, stderr=log) as process:
        try:
            yield process
        finally:
            process.kill()
            print((folder / "log").read_text("utf-8", "replace")[-4000:])  # what pytest shows of a failure


@pytest.mark.timeout(600)
def test_a_fleet_manager_gives_a_robot_its_maps_and_hears_that_it_was_carried_away(tmp_path: Path) -> None:
    with mosquitto(tmp_path) as broker, MapStore.open(tmp_path / "store", create=True) as store:
        robot_world.save(store)
        init_here(store)
        with (
            closing(Master(broker)) as master,
            serving(store.folder) as served,
            robot(tmp_path, served.zenoh, broker, served.http) as process,
        ):
            _story(master, store, served.http)
            process.kill()
            until(lambda: master.connections[-1] == "CONNECTION_BROKEN")
        assert master.faults == []
        assert len(master.visualizations) > 10


@contextmanager
def files(folder: Path) -> Iterator[str]:
    """A web server that knows nothing of maps."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.mark.timeout(600)
def test_an_older_fleet_manager_and_a_broker_are_enough(tmp_path: Path) -> None:
    """Without a map server; also for a robot that was killed, and after messages that nobody can read."""
    with (
        mosquitto(tmp_path) as broker,
        MapStore.open(tmp_path / "store", create=True) as store,
        files(tmp_path) as http,
    ):
        robot_world.save(store)
        store.export_version("room", 1, tmp_path / "room-1", archive=False)
        link = {"mapId": "room", "mapVersion": "1", "mapDownloadLink": f"{http}/room-1"}
        named = link | {"mapHash": sha256_hex((tmp_path / "room-1").read_bytes())}
        with closing(Master(broker, "2.1.0")) as master:

            def is_placed() -> bool:
                return bool(master.state.get("agvPosition", {}).get("positionInitialized"))

            with robot(tmp_path, "", broker, http, "2.1.0") as process:
                until(lambda: bool(master.states), "no state", START_S)
                assert (master.connections[-1], master.state["operatingMode"]) == ("ONLINE", "MANUAL")
                master.begin_robot_part()
                until(lambda: "the fleet manager must send enableMap" in str(master.errors("LOCALIZATION_ERROR")))
                assert "mapHash" in str(master.done(master.act("downloadMap", **link), "FAILED")["errors"])
                master.done(master.act("downloadMap", **named))
                master.done(master.act("enableMap", mapId="room", mapVersion="1"))
                assert master.maps() == {"1": "ENABLED"}
                until(is_placed)
                master.send("instantActions", b" " * 3_000_000)
                until(lambda: master.connections[-2:] == ["CONNECTIONBROKEN", "ONLINE"], lambda: master.connections)
                there = {key: master.state["agvPosition"][key] for key in ("x", "y", "theta")}
                master.done(master.act("initPosition", **there, mapId="room", lastNodeId=""))
                assert master.state["lastNodeId"] == ""
                assert master.state["batteryState"]["batteryCharge"] == 71.5
                until(lambda: bool(master.visualizations))
                process.kill()
                until(lambda: master.connections[-1] == "CONNECTIONBROKEN")
            assert master.connections == ["ONLINE", "CONNECTIONBROKEN"] * 2
            assert master.header_ids["connection"] == [0, 1, 2, 3]
            before = len(master.states)
            with robot(tmp_path, "", broker, http, "2.1.0"):
                until(lambda: len(master.states) > before and is_placed(), "", START_S)
                assert (master.connections[-1], master.maps()) == ("ONLINE", {"1": "ENABLED"})
            ids = master.header_ids["state"]
            assert ids == [*range(before), *range(len(ids) - before)]
        assert master.faults == []


def _is_lost(state: dict[str, Any]) -> bool:
    return any(error["errorType"] == "LOCALIZATION_ERROR" and error["errorHint"] for error in state["errors"])


def _story(master: Master, store: MapStore, http: str) -> None:
    until(lambda: bool(master.states), "no state", START_S)
    assert master.connections[-1] == "ONLINE"
    assert master.state["operatingMode"] == "STARTUP"
    assert master.errors("ROBOT_PART_MISSING")
    assert master.errors("LOCALIZATION_ERROR")[0]["errorLevel"] == "FATAL"
    assert master.maps() == {}
    master.begin_robot_part()

    offered = httpx.get(f"{http}/v1/sites/room/versions/1/vda5050").json()
    first = master.act("downloadMap", **offered)
    master.done(first)
    assert master.maps() == {"1": "DISABLED"}, "downloading enables nothing"
    until(lambda: master.state["operatingMode"] == "AUTOMATIC")
    assert "no map" in master.errors("LOCALIZATION_ERROR")[0]["errorHint"]

    again = master.done(master.act("downloadMap", **offered), "FAILED")
    assert [error["errorLevel"] for error in again["errors"] if error["errorType"] == "DUPLICATE_MAP"] == ["WARNING"]

    master.done(master.act("enableMap", mapId="room", mapVersion="1"))
    assert master.maps() == {"1": "ENABLED"}
    assert not master.errors("DUPLICATE_MAP"), "it ends when another action on maps is accepted"
    until(lambda: master.state["mobileRobotPosition"]["localized"] if "mobileRobotPosition" in master.state else False)
    assert not master.errors("LOCALIZATION_ERROR")
    until(lambda: 0 < master.state["mobileRobotPosition"].get("deviationRange", 9.0) < 1.0, lambda: master.state)
    place = master.state["mobileRobotPosition"]
    assert place["localizationScore"] == pytest.approx(1.0 - place["deviationRange"] / 3.0)  # lost_radius_m
    assert place["mapId"] == "room"

    before = len(master.states)
    until(lambda: any(map(_is_lost, master.states[before:])), "the kidnapping was not told", 150.0)
    told = next(state for state in master.states[before:] if _is_lost(state))
    assert told["mobileRobotPosition"]["localized"] is False
    assert [error["errorLevel"] for error in told["errors"] if error["errorType"] == "LOCALIZATION_ERROR"] == ["FATAL"]

    truth = robot_world.truth(40)
    yaw_rad = float(np.arctan2(truth[1, 0], truth[0, 0]))
    x_m, y_m = (float(value) for value in truth[:2, 3])
    until(lambda: not master.errors("LOCALIZATION_ERROR"), "it finds itself where it was carried to")
    there = master.act("initializePosition", x=x_m + 0.1, y=y_m - 0.1, theta=yaw_rad, mapId="room", lastNodeId="n-9")
    master.done(there)
    assert master.state["lastNodeId"] == "n-9"
    until(lambda: not master.errors("LOCALIZATION_ERROR"))
    until(lambda: abs(master.state["mobileRobotPosition"]["x"] - x_m) < 0.1, lambda: master.state)
    assert abs(master.state["mobileRobotPosition"]["y"] - y_m) < 0.1
    elsewhere = master.act("initializePosition", x=x_m + 9, y=y_m, theta=yaw_rad, mapId="room", lastNodeId="n-3")
    assert "the robot is localized" in str(master.done(elsewhere, "FAILED")["errors"])

    robot_world.save(store)
    update_lists(store)
    offered = httpx.get(f"{http}/v1/sites/room/versions/2/vda5050").json()
    master.done(master.act("downloadMap", **offered))
    assert master.maps() == {"1": "ENABLED", "2": "DISABLED"}
    change = master.act("enableMap", mapId="room", mapVersion="2")
    master.done(change)
    assert "RUNNING" in master.seen(change), "a version is tried before it replaces another one"
    assert master.maps() == {"1": "DISABLED", "2": "ENABLED"}
    assert "in use" in str(master.done(master.act("deleteMap", mapId="room", mapVersion="2"), "FAILED")["errors"])
    master.done(master.act("deleteMap", mapId="room", mapVersion="1"))
    assert master.maps() == {"2": "ENABLED"}
    again = master.done(master.act("deleteMap", mapId="room", mapVersion="1"), "FAILED")
    assert "not on the robot" in str(again["errors"])
