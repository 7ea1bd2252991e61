"""`locclient run` for ten minutes, and killed again and again, while its site goes on: TLS, server restarts, a new version, failures.

`PYTHONPATH=tests python tests/benchmarks/robot/bench_daemon_drive.py [--demo out/demo] [--minutes M] [--kills N] [--out FILE.json]`,
after `make demo`, whose store and recordings it takes (the store as a copy). Both robots' recordings come as ROS 2 topics over zenoh,
lap after lap, with stamps of now; in every second lap the cameras are silent for four seconds, which is a failure. One robot drives
through; the other is killed by SIGKILL, up to four seconds after each first pose. Meanwhile the server is stopped, killed and started
again, and a second version of the map is built and published. Measured: memory of the robot that drives through, seconds from a start
to a pose, tracebacks in any log, and reports of failures that are neither on the server nor in the robot's spool.
"""

import argparse
import json
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import psutil
from mcap.reader import make_reader

from fleetmap.bus import Bus
from fleetmap.recordings import open_recording
from fleetmap.recordings.calibration_files import format_calibration
from fleetmap.recordings.ros2.graph import key_layout
from fleetmap.threads import ended_by_threads
from locclient.delivery.outbox import Outbox
from mapserver.fleet.exports import failures_oldest_first
from mapserver.store import FailureFilter, MapStore
from support.fleet.tls_site import TlsSite

ROBOTS = ("tote-1", "tote-2")
SILENT_S = (8.0, 12.0)  # of every second lap
SETTLED_S = 120.0  # before it, libraries are loaded and queues fill
POSE_WITHIN_S = 180.0


class Driver:
    """A recording's topics on a zenoh router, again and again, each lap's stamps behind those of the lap before."""

    def __init__(self, recording: Path) -> None:
        self.bus = Bus.listen("tcp/127.0.0.1:0")
        self.recording, self.stop = recording, threading.Event()
        self._thread = threading.Thread(target=self._run, name="driver", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self.stop.set()
        self._thread.join()
        self.bus.close()

    def _run(self) -> None:
        layout, lap = key_layout("rmw_zenoh", 0), 0
        while not self.stop.is_set():
            begun_ns = time.time_ns()
            with self.recording.open("rb") as file:
                reader = make_reader(file)
                first_ns = reader.get_summary().statistics.message_start_time
                for schema, channel, message in reader.iter_messages():
                    topic, at_s = channel.topic, (message.log_time - first_ns) * 1e-9
                    is_image = topic.startswith("/cam") and "image" in topic
                    if topic not in {"/imu0", "/odom"} and not is_image:
                        continue
                    if is_image and lap % 2 and SILENT_S[0] < at_s < SILENT_S[1]:
                        continue
                    if self.stop.wait(max(0.0, at_s - (time.time_ns() - begun_ns) * 1e-9)):
                        return
                    stamp_ns = begun_ns + message.log_time - first_ns
                    head = np.array([stamp_ns // 10**9, stamp_ns % 10**9], "<u4").tobytes()
                    key = layout.key(topic, schema.name.replace("/msg/", "/"))
                    self.bus.publish(key, message.data[:4] + head + message.data[12:], may_drop=True)
            lap += 1


def wait_for_pose(site: TlsSite, robot: str, process: "subprocess.Popen[bytes]", since_ns: int) -> float:
    """Seconds from a daemon's start to its first pose at the server, by the frame's stamp."""
    begun_s = time.monotonic()
    while time.monotonic() - begun_s < POSE_WITHIN_S:
        assert process.poll() is None, f"{robot} ended with status {process.returncode}: see {site.log(robot)}"
        last = site.robot(robot).get("last_pose") or {}
        if int(last.get("stamp_ns") or 0) > since_ns:
            return time.monotonic() - begun_s
        time.sleep(0.1)
    raise SystemExit(f"{robot} had no pose within {POSE_WITHIN_S:.0f} s")


def kill_again_and_again(site: TlsSite, robot: str, kills: int, until_s: float, found: dict[str, Any]) -> None:
    chance = random.Random(1)
    while len(found["seconds_to_pose"]) < kills and time.monotonic() < until_s:
        since_ns = time.time_ns()
        with site.daemon(robot) as process:
            found["seconds_to_pose"].append(wait_for_pose(site, robot, process, since_ns))
            time.sleep(chance.uniform(0.0, 4.0))
            process.send_signal(signal.SIGKILL)
    with site.daemon(robot) as process:  # a last life, in which it delivers
        wait_for_pose(site, robot, process, time.time_ns())
        deadline_s = time.monotonic() + 60
        while Outbox(site.spool(robot), max_bytes=10**9).waiting(1) and time.monotonic() < deadline_s:
            time.sleep(0.5)
        process.send_signal(signal.SIGTERM)
        found["last_status"] = process.wait(60)


def lost_reports(site: TlsSite) -> list[str]:
    """Reports that a robot has made, and that are neither on the server nor in its spool."""
    with MapStore.open(site.store, read_only=True) as store:
        kept = {one.failure.failure_id for one in failures_oldest_first(store, FailureFilter(site=site.name))}
    lost = []
    for robot in ROBOTS:
        waiting = {report.id for report in Outbox(site.spool(robot), max_bytes=10**9).waiting(1000)}
        made = {json.loads(path.read_text())["id"] for path in site.failures(robot).glob("*.json")}
        lost += sorted(made - kept - waiting)
    return lost


def tracebacks(site: TlsSite) -> dict[str, int]:
    return {path.name: path.read_text("utf-8", "replace").count("Traceback") for path in site.folder.glob("*.log")}


def resident_mb(process: "subprocess.Popen[bytes]") -> float:
    return psutil.Process(process.pid).memory_info().rss / 1e6


def drive(site: TlsSite, demo: Path, minutes: float, kills: int) -> dict[str, Any]:
    drivers = {robot: Driver(demo / f"{robot}.mcap") for robot in ROBOTS}
    for robot, driver in drivers.items():
        with open_recording(demo / f"{robot}.mcap") as recording:
            (site.folder / f"{robot}.yaml").write_text(format_calibration(recording.calibration))
        site.enrol(robot)
        lines = f'kind = "ros2"\nendpoint = "{driver.bus.endpoint}"\ncalibration = "{site.folder / robot}.yaml"'
        site.configure(robot, lines)
    build = ("build", demo / "survey.mcap", "--site", site.name, "--store", site.store)
    build_log = (site.folder / "build.log").open("wb")
    building = subprocess.Popen(
        site.command("mapserver", *build), env=site.environment, stdout=build_log, stderr=build_log
    )
    killed: dict[str, Any] = {"seconds_to_pose": []}
    steady_mb, begun_s, restarts = [], time.monotonic(), 0
    events = [
        (begun_s + share * 60 * minutes, number) for share, number in ((0.25, signal.SIGTERM), (0.6, signal.SIGKILL))
    ]
    is_published = False
    with site.daemon(ROBOTS[0]) as process:
        killer = threading.Thread(
            target=kill_again_and_again, args=(site, ROBOTS[1], kills, begun_s + 60 * minutes, killed), daemon=True
        )
        killer.start()
        while time.monotonic() < begun_s + 60 * minutes or killer.is_alive():
            assert process.poll() is None, f"the daemon ended with status {process.returncode}"
            steady_mb.append((time.monotonic() - begun_s, resident_mb(process)))
            if events and time.monotonic() > events[0][0]:
                site.stop(events.pop(0)[1])
                restarts += 1
                time.sleep(3)
                site.start()
            assert not building.poll(), f"the second build failed: see {build_log.name}"
            if not is_published and building.poll() == 0:
                site.run("mapserver", "publish", "--site", site.name, "--store", site.store)
                is_published = True
            time.sleep(1)
        known = site.robot(ROBOTS[0])
        process.send_signal(signal.SIGTERM)
        status = process.wait(60)
    for driver in drivers.values():
        driver.close()
    settled = [mb for at_s, mb in steady_mb if at_s > min(SETTLED_S, 20 * minutes)]
    third = max(1, len(settled) // 3)
    seconds = np.array(killed["seconds_to_pose"])
    return {
        "minutes": (steady_mb[-1][0]) / 60,
        "exit_status": status,
        "resident_mb_settled": float(np.median(settled[:third])),
        "resident_mb_end": float(np.median(settled[-third:])),
        "server_restarts": restarts,
        "version": known.get("version"),
        "wanted_version": known.get("wanted_version"),
        "kills": len(seconds),
        "pose_after_s": {"median": float(np.median(seconds)), "p95": float(np.percentile(seconds, 95)), "max": float(seconds.max())}
        if len(seconds)
        else None,
        "last_life_status": killed.get("last_status"),
        "failures_made": {robot: len(list(site.failures(robot).glob("*.json"))) for robot in ROBOTS},
        "reports_lost": lost_reports(site),
        "tracebacks": tracebacks(site),
    }  # fmt: skip


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--demo", type=Path, default=Path("out/demo"))
    options.add_argument("--minutes", type=float, default=10.0)
    options.add_argument("--kills", type=int, default=60)
    options.add_argument("--out", type=Path)
    options.add_argument("--keep", type=Path, help="Folder to work in, kept; default: one that is removed.")
    chosen = options.parse_args()
    with TemporaryDirectory() as folder:
        work = chosen.keep or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        site = TlsSite(work, "demo")
        shutil.copytree(chosen.demo / "store", site.store)
        site.run("mapserver", "trust", "init", "--here", "--host", "127.0.0.1", "--store", site.store)
        with site.serving(), ended_by_threads(lambda: None):
            found = drive(site, chosen.demo, chosen.minutes, chosen.kills)
    print(json.dumps(found, indent=2))
    if chosen.out is not None:
        chosen.out.write_text(json.dumps(found, indent=2) + "\n")
    if found["reports_lost"] or any(found["tracebacks"].values()) or found["exit_status"] or found["last_life_status"]:
        sys.exit("the drive did not end well")


if __name__ == "__main__":
    main()
