"""Cost of signed lists: of a robot's questions in bytes and CPU, of its memory, and of the server's start and releases."""

import json
import subprocess
import sys
import time
from pathlib import Path

from fleetmap.bus import Bus, ZenohBus
from fleetmap.messages import WantedVersion
from fleetmap.trust import TrustedMap, ask_over
from mapserver import releases
from mapserver.fleet.fleet import Fleet
from mapserver.serving.bus_service import BusService
from mapserver.store import MapStore
from mapserver.trust import prepare_lists
from mapserver.trust.ceremonies import admit, init_with_people
from mapserver.trust.keys import load_key
from support.storage.map_samples import publish_samples, save_sample_draft

SITE = "lab"
QUESTIONS = 50


def _counted(bus: Bus, counts: dict[str, int]):  # type: ignore[no-untyped-def]
    ask = ask_over(bus, SITE)

    def counting(name: str) -> bytes | None:
        data = ask(name)
        counts["questions"] += 1
        counts["bytes"] += len(data or b"")
        return data

    return counting


def robot_costs(folder: Path) -> dict[str, dict[str, float]]:
    """Of a robot over zenoh, with three root keys: questions, bytes and CPU (ms) of first contact, no news and a new version."""
    costs: dict[str, dict[str, float]] = {}
    with MapStore.open(folder / "store", create=True) as store, ZenohBus.listen("tcp/127.0.0.1:0") as bus:
        publish_samples(store, 2)
        passphrases = init_with_people(store, [folder / name for name in ("ada", "bob", "cy")], 2)
        people = [load_key(path, words) for path, words in passphrases.items()]
        admit(store, SITE, [], people[:2], threshold=1, previous=1)
        service = BusService(store, Fleet(store), bus, lambda *_: None)
        root = (store.folder / "trust" / "1.root.json").read_bytes()
        with ZenohBus.connect(bus.endpoint) as robot_bus:
            for attempt in range(5):
                counts = {"questions": 0, "bytes": 0}
                trust = TrustedMap(folder / f"robot-{attempt}", SITE, root, _counted(robot_bus, counts))
                _measure(
                    costs, "first contact", counts, trust.refresh
                )  # the first one imports tuf, the last one counts
                _measure(costs, "no news", counts, trust.refresh, QUESTIONS)
                save_sample_draft(store, seed=10 + attempt)
                releases.publish(store, SITE)
                _measure(costs, "new version", counts, trust.refresh)
                info = store.current(SITE)
                assert info is not None
                address = info.manifest_sha256
                trust.admitted(WantedVersion(site=SITE, version=info.version, manifest_sha256=address))
        service.close()
    return costs


def _measure(costs, words, counts, act, times: int = 1) -> None:  # type: ignore[no-untyped-def]
    """CPU of this thread, in which the robot's client works; the server answers on others."""
    counts.update(questions=0, bytes=0)
    begun_s, cpu_s = time.perf_counter(), time.thread_time()
    for _ in range(times):
        act()
    costs[words] = {
        "questions": counts["questions"] / times,
        "bytes": counts["bytes"] / times,
        "cpu_ms": 1e3 * (time.thread_time() - cpu_s) / times,
        "wall_ms": 1e3 * (time.perf_counter() - begun_s) / times,
    }


_MEMORY = """
import os, time, zenoh
import fleetmap.trust.trusted_map, locclient.daemon.daemon
def resident(): return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
before, begun = resident(), time.process_time()
import fleetmap.trust.tuf_client
print(time.process_time() - begun, resident() - before)
"""


def import_cost() -> dict[str, float]:
    """CPU (s) and memory (MiB) of tuf in a process that has everything else of a robot."""
    words = subprocess.run([sys.executable, "-c", _MEMORY], capture_output=True, text=True, check=True).stdout.split()
    return {"cpu_s": float(words[0]), "mib": float(words[1])}


def server_costs(folder: Path) -> dict[str, float]:
    """CPU (ms) of making all keys, of a start with nothing to sign, of a publication with and without lists."""
    found = {}
    with MapStore.open(folder / "signed", create=True) as store:
        publish_samples(store, 2)
        found["publish, unsigned"] = _publish_ms(store, 20)
        found["keys and first lists"] = _cpu_ms(lambda: prepare_lists(store, "tcp/127.0.0.1:0"))
        found["start, nothing to sign"] = _cpu_ms(lambda: prepare_lists(store, "tcp/127.0.0.1:0"))
        found["publish, signed"] = _publish_ms(store, 30)
    return found


def _publish_ms(store: MapStore, seed: int) -> float:
    numbers = [save_sample_draft(store, seed=seed + n) for n in range(5)]
    return _cpu_ms(lambda: [releases.publish(store, SITE, number) for number in numbers]) / len(numbers)


def _cpu_ms(act) -> float:  # type: ignore[no-untyped-def]
    begun_s = time.process_time()
    act()
    return 1e3 * (time.process_time() - begun_s)


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as name:
        memory = import_cost()
        costs = {"robot": robot_costs(Path(name)), "import": memory, "server": server_costs(Path(name))}
        print(json.dumps(costs, indent=1))
