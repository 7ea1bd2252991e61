"""Enrolled robots: the bus of a thousand, a revocation, and floods: one robot floods a running server, fifty others are served.

    PYTHONPATH=tests python -m benchmarks.fleet.bench_enrolled [--seconds 60] [--others 50] [--out FILE.json]

Of a flood the server, the robot that floods and the others are three processes on loopback. Row 8 of docs/security.md.
"""

import multiprocessing
import os
import tempfile
import threading
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zenoh

from benchmarks.common.recorded_runs import parsed, write_results
from benchmarks.fleet.server_process import resident_mb, serving
from fleetmap.access import ALIVE, ORDERS, QUESTIONS, REPORTS, Holder
from fleetmap.bus import Bus, TlsFiles
from fleetmap.errors import UnreachableError
from fleetmap.messages import (
    FailureAck,
    FailureReport,
    RobotHealth,
    Thumbnail,
    WantedVersion,
    decode_message,
    robot_key,
)
from mapserver import releases
from mapserver.serving.bus_access import BusGuard
from mapserver.store import MapStore
from mapserver.trust import init_here
from mapserver.trust.enrolment import RobotRegister
from support.storage.map_samples import save_sample_draft

SITE, ENDPOINT = "lab", "tls/127.0.0.1:7447"
KINDS = {"10,000 puts a second": 10_000, "1 MB strings": 100, "1000 failures a second": 1000, "20 MB pictures": 10}
_EVERY_S = 2.0  # a robot asks this often, and delivers a failure with every third question
_BLOCK = zenoh.CongestionControl.BLOCK


def open_register(folder: Path) -> tuple[MapStore, RobotRegister]:
    """A store with one draft, keys and authorities."""
    store = MapStore.open(folder / "store", create=True)
    save_sample_draft(store)
    init_here(store)
    register = RobotRegister(store)
    register.authorities.init(["127.0.0.1"], None, None)
    return store, register


def robot_files(register: RobotRegister, holder: Holder, folder: Path) -> TlsFiles:
    """An enrolled robot's key and certificate."""
    own = folder / f"{holder.certificate}.pem"
    own.write_bytes(register.authorities.make_own(holder.certificate, "robot"))
    return TlsFiles(folder / "store" / "keys" / "servers-ca.crt", own)


def _until(condition: Callable[[], bool], within_s: float = 20.0) -> float:
    begun_s = time.perf_counter()
    while not condition():
        if time.perf_counter() - begun_s > within_s:
            return float("nan")
        time.sleep(0.01)
    return time.perf_counter() - begun_s


def opening_and_revoking(folder: Path, count: int, connected: int) -> dict[str, float]:
    """With `count` enrolled robots: seconds to open, memory (MB); seconds until a revoked one is out and all others are answered."""
    store, register = open_register(folder)
    names = [f"r{number}" for number in range(count)]
    register.enrol(SITE, names, ENDPOINT)
    holders = [Holder(entry.certificate, SITE, entry.robot) for entry in register.robots()[:connected]]
    before_mb = resident_mb(os.getpid())
    bus = Bus("tls/127.0.0.1:0", is_server=True, tls=register.tls, access=register.access())
    bus.queryable(robot_key("*", "*", "wanted"), lambda *_: b"1")
    begun_s, cpu_s = time.perf_counter(), time.process_time()
    bus.open()
    cpu_s = time.process_time() - cpu_s
    found = {"open_s": time.perf_counter() - begun_s, "open_cpu_s": cpu_s, "mb": resident_mb(os.getpid()) - before_mb}
    guard, is_over = BusGuard(register, bus), threading.Event()

    def follow() -> None:
        while not is_over.wait(1.0):  # as the server's background task
            guard.follow()

    threading.Thread(target=follow, daemon=True).start()
    robots = [Bus.connect(bus.endpoint, tls=robot_files(register, holder, folder)) for holder in holders]

    def answered(number: int) -> bool:
        try:
            return robots[number].get(robot_key(SITE, holders[number].robot, "wanted"), timeout_s=0.2) == b"1"
        except UnreachableError:
            return False

    _until(lambda: all(answered(number) for number in range(connected)))
    register.revoke(SITE, [holders[0].robot])
    found["revoked_is_out_s"] = _until(lambda: not answered(0))
    found["others_again_s"] = _until(lambda: all(answered(number) for number in range(1, connected)))
    found["revoked_stays_out"] = float(not answered(0))
    is_over.set()
    for robot in robots:
        robot.close()
    bus.close()
    store.close()
    return found


def _failure(robot: str, number: int, pictures: int = 0, picture_bytes: int = 60_000, cause: str = "dark") -> bytes:
    picture = Thumbnail(stamp_ns=1, kind="frame", jpeg=b"\xff\xd8" + bytes(picture_bytes) + b"\xff\xd9")
    made = FailureReport(
        site=SITE, robot=robot, id=f"{time.time_ns()}-{number}", stamp_ns=1, wall_ns=time.time_ns(), duration_s=1.0, kind="blind",
        status="LOST", cause="dark", version=1,
    )  # fmt: skip
    more = {"cause": cause, "thumbnails": (picture,) * pictures}
    return msgspec.msgpack.encode(msgspec.structs.replace(made, **more))


def _health(robot: str, words: str = "") -> bytes:
    health = RobotHealth(site=SITE, robot=robot, stamp_ns=time.time_ns(), version=1, status="TRACKING")
    return msgspec.msgpack.encode(msgspec.structs.replace(health, metrics={"words": words}))


def _sender(session: Any, robot: str, kind: str) -> Callable[[int], None]:
    """Sends one message; the attacker waits for no answer, and is not kept to the sizes of `Bus`."""

    def put(what: str, payload: bytes) -> None:
        session.put(robot_key(SITE, robot, what), payload, congestion_control=_BLOCK)

    def ask(what: str, payload: bytes) -> None:
        key = robot_key(SITE, robot, what)
        session.get(key, lambda _: None, payload=payload, timeout=10.0, congestion_control=_BLOCK)

    whats, small, text = cycle((*REPORTS, *QUESTIONS, *ORDERS, *ALIVE)), _health(robot), "x" * 1_000_000
    large, long = _health(robot, text), _failure(robot, 0, cause=text)
    huge = _failure(robot, 0, pictures=1, picture_bytes=20_000_000)
    strings = cycle([(put, "health", large), (ask, "failures", long), (ask, "wanted", text.encode())])
    pictures = cycle([(ask, "failures", huge), (put, "failures", huge)])

    def of_cycle(entries: Any) -> None:
        send, what, payload = next(entries)
        send(what, payload)

    return {
        "10,000 puts a second": lambda _: put(next(whats), small),
        "1 MB strings": lambda _: of_cycle(strings),
        "1000 failures a second": lambda number: ask("failures", _failure(robot, number, pictures=4)),
        "20 MB pictures": lambda _: of_cycle(pictures),
    }[kind]


def _flood(endpoint: str, files: TlsFiles, robot: str, kind: str, seconds: float, said: Any) -> None:
    with Bus.connect(endpoint, tls=files) as bus:
        bus.get(robot_key(SITE, robot, "wanted"), timeout_s=60.0)
        send, sent, begun_s = _sender(bus._session, robot, kind), 0, time.monotonic()
        while (elapsed_s := time.monotonic() - begun_s) < seconds:
            if sent > elapsed_s * KINDS[kind]:
                time.sleep(0.001)
                continue
            send(sent)
            sent += 1
    said.put(sent)


def _others(endpoint: str, robots: dict[str, TlsFiles], orders: Any, said: Any) -> None:
    """Answers each order, a number of seconds, with the waits (s) of every question and failure in that time."""
    buses = {name: Bus.connect(endpoint, tls=files) for name, files in robots.items()}
    for name, bus in buses.items():
        decode_message(bus.get(robot_key(SITE, name, "wanted"), timeout_s=60.0), WantedVersion)
    said.put([])
    while seconds := orders.get():
        waits: list[float] = []
        faults: list[str] = []
        until_s = time.monotonic() + seconds

        def work(place: int, name: str, until_s: float = until_s, waits: Any = waits, faults: Any = faults) -> None:
            time.sleep(_EVERY_S * place / len(buses))
            for number in range(10**6):
                begun_s = time.monotonic()
                if begun_s > until_s:
                    return
                try:
                    decode_message(buses[name].get(robot_key(SITE, name, "wanted"), timeout_s=20.0), WantedVersion)
                    waits.append(time.monotonic() - begun_s)
                    if number % 3 == 2:
                        asked_s = time.monotonic()
                        answer = buses[name].get(
                            robot_key(SITE, name, "failures"), _failure(name, number), timeout_s=20.0
                        )
                        assert decode_message(answer, FailureAck).refused == ""
                        waits.append(time.monotonic() - asked_s)
                except Exception as error:
                    faults.append(f"{name}: {error!r}")
                time.sleep(max(0.0, begun_s + _EVERY_S - time.monotonic()))

        threads = [threading.Thread(target=work, args=entry) for entry in enumerate(buses)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        said.put(faults or waits)
    for bus in buses.values():
        bus.close()


def _disk_mb(folder: Path) -> float:
    sizes = []
    for path in folder.rglob("*"):
        try:
            sizes.append(path.stat().st_size)
        except FileNotFoundError:  # gone meanwhile
            continue
    return sum(sizes) / 1e6


def flooded(folder: Path, seconds: float = 60.0, others: int = 50) -> dict[str, dict[str, float]]:
    """For a quiet time and each kind of flood: messages sent, the others' waits (s), growth of the server's memory and folder (MB)."""
    evil = {kind: f"flood-{number}" for number, kind in enumerate(KINDS)}  # each with a fresh allowance of failures
    store, register = open_register(folder)
    with store:
        releases.publish(store, SITE)
        register.enrol(SITE, [*evil.values(), *(f"r{number}" for number in range(others))], ENDPOINT)
        entries = register.robots()
        files = {e.robot: robot_files(register, Holder(e.certificate, SITE, e.robot), folder) for e in entries}
    context, found = multiprocessing.get_context("spawn"), {}
    orders, said, sent = context.Queue(), context.Queue(), context.Queue()
    with serving(folder / "store", "tls/127.0.0.1:0") as (server, _, endpoint):
        calm = {name: own for name, own in files.items() if name not in evil.values()}
        process = context.Process(target=_others, args=(endpoint, calm, orders, said))
        process.start()
        assert said.get(timeout=120) == []
        for kind in ("nobody floods", *KINDS):
            before_mb, before_disk_mb = resident_mb(server.pid), _disk_mb(folder / "store")
            memory_mb, over = [before_mb], threading.Event()

            def watch(memory_mb: list[float] = memory_mb, over: threading.Event = over) -> None:
                while not over.wait(0.25):
                    memory_mb.append(resident_mb(server.pid))

            watcher = threading.Thread(target=watch)
            watcher.start()
            orders.put(seconds if kind in KINDS else min(seconds, 20.0))
            if kind in KINDS:
                robot = evil[kind]
                context.Process(target=_flood, args=(endpoint, files[robot], robot, kind, seconds, sent)).start()
            waits = said.get(timeout=10 * seconds + 120)
            number = sent.get(timeout=10 * seconds + 120) if kind in KINDS else 0
            over.set()
            watcher.join()
            assert waits and not isinstance(waits[0], str), f"{kind}: others were not served: {waits[:5]}"
            found[kind] = {
                "sent": number, "others_asked": len(waits), "longest_wait_s": max(waits), "p99_wait_s": float(np.quantile(waits, 0.99)),
                "memory_mb": max(memory_mb) - before_mb, "disk_mb": _disk_mb(folder / "store") - before_disk_mb,
                "load": os.getloadavg()[0],
            }  # fmt: skip
        orders.put(0)
        process.join()
    return found


def main() -> None:
    options = parsed(__doc__, seconds=60, others=50)
    with tempfile.TemporaryDirectory() as name:
        found: dict[str, Any] = {"thousand": opening_and_revoking(Path(name) / "many", 1000, 12)}
        found["floods"] = flooded(Path(name) / "flood", options.seconds, options.others)
    write_results(options.out, found)


if __name__ == "__main__":
    main()
