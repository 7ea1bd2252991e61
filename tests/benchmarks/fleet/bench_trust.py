"""What trust costs, without and with it: a robot's questions in bytes and CPU, its memory, enrolment, the server's start and releases.

    PYTHONPATH=tests python -m benchmarks.fleet.bench_trust

The robot is a process of its own, so that its CPU is that of all its threads, TLS among them. What maps cost on their way is measured
by `bench_delivery`, and a thousand robots by `bench_bus_access`.
"""

import json
import multiprocessing
import os
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.fleet.bench_bus_access import open_register, robot_files
from fleetmap.access import Holder
from fleetmap.bus import TlsFiles, ZenohBus
from fleetmap.messages import robot_key
from fleetmap.trust import TrustedMap, ask_over
from locclient.identity import RobotIdentity
from mapserver import releases
from mapserver.fleet.fleet import Fleet
from mapserver.serving.bus_access import BusGuard
from mapserver.serving.bus_service import BusService
from mapserver.store import MapStore
from mapserver.trust import prepare_lists
from mapserver.trust.ceremonies import admit, init_with_people
from mapserver.trust.enrolment import RobotRegister
from mapserver.trust.keys import load_key
from support.storage.map_samples import publish_samples, save_sample_draft

SITE, ROBOT = "lab", "r1"
QUESTIONS, ATTEMPTS = 50, 9


def _robot(endpoint: str, files: TlsFiles | None, root: bytes, orders: Any, said: Any) -> None:
    """Does what it is told, `wanted` or a folder of lists to refresh, so many times; answers with the cost of one."""
    import locclient.daemon.daemon  # noqa: F401  # everything else of a robot is in its memory

    counts = {"questions": 0, "bytes": 0}
    with ZenohBus.connect(endpoint, tls=files) as bus:
        ask = ask_over(bus, SITE)

        def counting(name: str) -> bytes | None:
            data = ask(name)
            counts["questions"] += 1
            counts["bytes"] += len(data or b"")
            return data

        def wanted() -> None:
            counts["questions"] += 1
            counts["bytes"] += len(bus.get(robot_key(SITE, ROBOT, "wanted"), timeout_s=20.0))

        acts: dict[str, Callable[[], None]] = {"wanted": wanted}
        wanted()
        for what, times in iter(orders.get, None):
            if what not in acts:
                acts[what] = TrustedMap(Path(what), SITE, root, counting).refresh
            counts.update(questions=0, bytes=0)
            begun_s, cpu_s = time.perf_counter(), time.process_time()
            for _ in range(times):
                acts[what]()
            cost = {"cpu_ms": 1e3 * (time.process_time() - cpu_s), "wall_ms": 1e3 * (time.perf_counter() - begun_s)}
            said.put({name: value / times for name, value in (counts | cost).items()})
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        said.put({"mib": pages * os.sysconf("SC_PAGE_SIZE") / 2**20})


class _Robot:
    """The process of a robot, which connects at once."""

    def __init__(self, endpoint: str, files: TlsFiles | None, root: bytes) -> None:
        context = multiprocessing.get_context("spawn")
        self._orders, self._said = context.Queue(), context.Queue()
        self._process = context.Process(target=_robot, args=(endpoint, files, root, self._orders, self._said))
        self._process.start()

    def does(self, what: Path | str, times: int = 1) -> dict[str, float]:
        self._orders.put((str(what), times))
        return self._said.get(timeout=120)

    def end(self) -> float:
        """Its memory (MiB)."""
        self._orders.put(None)
        mib = self._said.get(timeout=60)["mib"]
        self._process.join()
        return mib


def _people(store: MapStore, folder: Path) -> None:
    """Three root keys, of which two are needed."""
    passphrases = init_with_people(store, [folder / name for name in ("ada", "bob", "cy")], 2)
    people = [load_key(path, words) for path, words in passphrases.items()]
    admit(store, SITE, [], people[:2], threshold=1, previous=1)


def _publish(store: MapStore, seed: int) -> None:
    save_sample_draft(store, seed=seed)
    releases.publish(store, SITE)


def robot_costs(folder: Path) -> dict[str, Any]:
    """Of a robot over plain TCP without lists (`without`), and over mutual TLS with them: one question of each kind, memory."""
    found: dict[str, Any] = {"without": {}, "with": {}}
    with MapStore.open(folder / "store", create=True) as store:
        publish_samples(store, 2)
        with ZenohBus.listen("tcp/127.0.0.1:0") as bus:
            service = BusService(store, Fleet(store), bus, lambda *_: None)
            robot = _Robot(bus.endpoint, None, b"")
            found["without"] = {"question": robot.does("wanted", QUESTIONS), "mib": robot.end()}
            service.close()
        _people(store, folder)
        register = RobotRegister(store)
        register.authorities.init(["127.0.0.1"], None, None)
        register.enrol(SITE, [ROBOT], "tls/127.0.0.1:7447")
        (entry,) = register.robots()
        files = robot_files(register, Holder(entry.certificate, SITE, ROBOT), folder)
        with ZenohBus.listen("tls/127.0.0.1:0", tls=register.tls, access=register.access()) as bus:
            service = BusService(store, Fleet(store), bus, lambda *_: None, BusGuard(register, bus))
            robot = _Robot(bus.endpoint, files, (store.folder / "trust" / "1.root.json").read_bytes())
            robot.does(folder / "lists")  # the first one imports tuf
            costs: dict[str, list[dict[str, float]]] = {"first contact": [], "no news": [], "new version": []}
            for attempt in range(ATTEMPTS):
                lists = folder / f"lists-{attempt}"
                costs["first contact"].append(robot.does(lists))
                costs["no news"].append(robot.does(lists, QUESTIONS))
                _publish(store, 10 + attempt)
                costs["new version"].append(robot.does(lists))
            typical = {
                what: {name: median(cost[name] for cost in all_) for name in all_[0]} for what, all_ in costs.items()
            }
            found["with"] = {"question": robot.does("wanted", QUESTIONS), **typical, "mib": robot.end()}
            service.close()
    return found


def enrolment_costs(folder: Path, count: int = 5) -> dict[str, float]:
    """Wall (ms) of a robot: its bundle, rules that let it in, its own key and certificate over TLS; bytes of the bundle."""
    store, register = open_register(folder)
    found = {"bundle_ms": 0.0, "rules_ms": 0.0, "robot_ms": 0.0, "bundle_bytes": 0.0}
    with store, ZenohBus.listen("tls/127.0.0.1:0", tls=register.tls, access=register.access()) as bus:
        guard = BusGuard(register, bus)
        service = BusService(store, Fleet(store), bus, lambda *_: None, guard)
        for number in range(count):
            name, begun_s = f"tug-{number}", time.perf_counter()
            bundle = register.enrol(SITE, [name], bus.endpoint)[name]
            let_in_s = time.perf_counter()
            guard.follow()
            asks_s = time.perf_counter()
            RobotIdentity.enrol(folder / name, bundle)
            times = {
                "bundle_ms": let_in_s - begun_s,
                "rules_ms": asks_s - let_in_s,
                "robot_ms": time.perf_counter() - asks_s,
            }
            for what, seconds in times.items():
                found[what] += 1e3 * seconds / count
            found["bundle_bytes"] = len(bundle)
        service.close()
    return found


def server_costs(folder: Path) -> dict[str, float]:
    """CPU (ms) of opening store and bus without and with signed lists, the first time and later, and of a publication."""
    found = {}
    with MapStore.open(folder / "signed", create=True) as store:
        publish_samples(store, 2)
        found["start without"] = _cpu_ms(lambda: _start(folder / "signed"))
        found["publish without"] = _publish_ms(store, 20)
        found["first start"] = _cpu_ms(lambda: prepare_lists(store, "tcp/127.0.0.1:0")) + found["start without"]
        found["start with"] = _cpu_ms(lambda: _start(folder / "signed", signs=True))
        found["publish with"] = _publish_ms(store, 30)
    return found


def _start(folder: Path, *, signs: bool = False) -> None:
    with MapStore.open(folder) as store, ZenohBus.listen("tcp/127.0.0.1:0") as bus:
        if signs:
            prepare_lists(store, bus.endpoint)
        BusService(store, Fleet(store), bus, lambda *_: None).close()


def _publish_ms(store: MapStore, seed: int) -> float:
    numbers = [save_sample_draft(store, seed=seed + n) for n in range(5)]
    return _cpu_ms(lambda: [releases.publish(store, SITE, number) for number in numbers]) / len(numbers)


def _cpu_ms(act: Callable[[], object]) -> float:
    begun_s = time.process_time()
    act()
    return 1e3 * (time.process_time() - begun_s)


def bench(folder: Path) -> dict[str, Any]:
    """All figures."""
    parts = {name: folder / name for name in ("robot", "enrolment", "server")}
    for part in parts.values():
        part.mkdir()
    return {
        "robot": robot_costs(parts["robot"]),
        "enrolment": enrolment_costs(parts["enrolment"]),
        "server": server_costs(parts["server"]),
    }


def table(found: dict[str, Any], delivery: dict[str, float]) -> str:
    """Before and after, in Markdown. delivery: wall and CPU of the same maps over TCP and over TLS (s)."""
    without, having, server = found["robot"]["without"], found["robot"]["with"], found["server"]
    entry = found["enrolment"]
    rows = [
        ("maps to a fleet, s", f"{delivery['tcp_wall_s']:.2f}", f"{delivery['tls_wall_s']:.2f}"),
        ("maps to a fleet, server's CPU, s", f"{delivery['tcp_server_cpu_s']:.2f}", f"{delivery['tls_server_cpu_s']:.2f}"),
        ("robot: a question, CPU, ms", *(f"{side['question']['cpu_ms']:.1f}" for side in (without, having))),
        *(
            (f"robot: {what}, CPU, ms; bytes", "-", f"{having[what]['cpu_ms']:.1f}; {having[what]['bytes']:.0f}")
            for what in ("first contact", "no news", "new version")
        ),
        ("robot: memory, MiB", f"{without['mib']:.1f}", f"{having['mib']:.1f}"),
        ("enrolment: server, robot, ms", "-", f"{entry['bundle_ms'] + entry['rules_ms']:.0f}, {entry['robot_ms']:.0f}"),
        ("server: start, CPU, ms", f"{server['start without']:.0f}", f"{server['start with']:.0f} (first: {server['first start']:.0f})"),
        ("server: publication, CPU, ms", f"{server['publish without']:.1f}", f"{server['publish with']:.1f}"),
    ]  # fmt: skip
    return "\n".join(f"| {' | '.join(row)} |" for row in [("", "without trust", "with"), ("---",) * 3, *rows])


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        print(json.dumps(bench(Path(name)), indent=1))
