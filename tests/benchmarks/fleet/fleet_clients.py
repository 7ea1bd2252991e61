"""Simulated robots of `bench_fleet`: each with its own connection, many in one process. Run as a process of its own.

ENDPOINT FIRST COUNT SECONDS: prints `ready`, begins at a line on stdin, prints what was said as a line of JSON.
"""

import json
import sys
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from fleetmap.bus import Bus, Handle
from fleetmap.errors import FleetmapError
from fleetmap.messages import (
    FailureAck,
    FailureReport,
    PoseMessage,
    RobotHealth,
    decode_message,
    encode_message,
    robot_key,
)
from support.fleet.made_fleet import NS, Known, MadeRobot

SITE = "bench"
TILES = 20


class Client:
    """A robot and its connection."""

    def __init__(self, endpoint: str, name: str, seed: int, known: Known) -> None:
        self.made = MadeRobot(
            SITE, name, np.random.default_rng(seed), known, rate_per_robot_day=60.0, tiles=TILES, bad_tile=seed % TILES,
            ahead_s=(seed % 7) - 3.0, cause=("dark", "blur", "covered")[seed % 3], suspected_share=0.2,
        )  # fmt: skip
        self.bus = Bus.connect(endpoint)
        self.alive: Handle = self.bus.declare_alive(robot_key(SITE, name, "alive"))
        self.acknowledged = 0

    def say(self, message: RobotHealth | PoseMessage) -> None:
        """As a robot publishes it."""
        what = "health" if isinstance(message, RobotHealth) else "pose"
        key = robot_key(SITE, self.made.name, what)
        self.bus.publish(key, encode_message(message), may_drop=what == "pose")

    def report(self, failure: FailureReport) -> None:
        """Asks until it is acknowledged."""
        while True:
            try:
                answer = self.bus.get(
                    robot_key(SITE, failure.robot, "failures"), encode_message(failure), timeout_s=10.0
                )
            except FleetmapError:
                continue
            assert decode_message(answer, FailureAck) == FailureAck(id=failure.id)
            self.acknowledged += 1
            return


def drive(clients: list[Client], seconds: int, pool: ThreadPoolExecutor) -> float:
    """Every robot speaks twice a second, all of them spread over it; returns by how much the last word was late."""
    begun_s, late_s = time.monotonic(), 0.0
    for step in range(1, seconds + 1):
        now_ns = time.time_ns()
        later: list[tuple[Client, PoseMessage | RobotHealth]] = []
        for place, client in enumerate(clients):
            due_s = begun_s + step - 1 + 0.5 * place / len(clients)
            time.sleep(max(0.0, due_s - time.monotonic()))
            first, second, health, *failures = client.made.second(now_ns + round((due_s - begun_s - step + 1) * NS))
            client.say(first)
            later += [(client, second), (client, health)]
            for failure in failures:
                pool.submit(client.report, failure)
        for place, (client, message) in enumerate(later):
            due_s = begun_s + step - 0.5 + 0.5 * place / len(later)
            time.sleep(max(0.0, due_s - time.monotonic()))
            client.say(message)
        late_s = max(late_s, time.monotonic() - begun_s - step)
    return late_s


def main() -> None:
    """See above."""
    endpoint, first, count, seconds = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
    known = Known()
    clients = [Client(endpoint, f"robot-{first + n}", first + n, known) for n in range(count)]
    while not all(client.bus.connected() for client in clients):
        time.sleep(0.05)
    print("ready", flush=True)
    sys.stdin.readline()
    with ThreadPoolExecutor(8) as pool:
        late_s = drive(clients, seconds, pool)
    acknowledged = sum(client.acknowledged for client in clients)
    said = {
        "health": known.health, "estimates": known.estimates, "reports": known.reports, "acknowledged": acknowledged,
        "late_s": late_s, "threads": threading.active_count(), "failures": _plain(known.failures),
        "suspected": _plain(known.suspected), "driving_s": known.driving_s["site", ""],
    }  # fmt: skip
    time.sleep(1.0)  # what was published last is on its way
    print(json.dumps(said), flush=True)
    sys.stdin.readline()
    for client in clients:
        client.bus.close()


def _plain(counter: Counter[tuple[str, str]]) -> dict[str, int]:
    return {f"{axis}|{key}": count for (axis, key), count in counter.items()}


if __name__ == "__main__":
    main()
