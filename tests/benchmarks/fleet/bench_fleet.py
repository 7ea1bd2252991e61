"""A fleet that reports: health at 1 Hz, estimates at 2 Hz and failures of many robots to one server on loopback, counted at both ends.

    PYTHONPATH=tests python tests/benchmarks/fleet/bench_fleet.py [--robots 300] [--seconds 120] [--month] [--out FILE.json]

Robots have a zenoh session each and clocks that are wrong by seconds. Meanwhile the lists and figures are asked for over HTTP as an
operator's page does. Every count is compared with what the robots know: reports, failures by site, robot, tile and cause, hours
driven. --month fills a store with 30 days of sums of so many robots and measures its size and how long figures take.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from importlib import metadata
from pathlib import Path
from typing import Any

import httpx
import msgspec
import numpy as np
from prometheus_client.parser import text_string_to_metric_families

from benchmarks.fleet.bench_service import _SOURCES, cpu_s, resident_mb, serving
from benchmarks.fleet.fleet_clients import SITE, TILES
from mapserver import releases
from mapserver.fleet_statistics.kpis import COUNTER_COLUMNS, Counters
from mapserver.store import DraftContent, FailureFilter, FleetBatch, MapStore
from support.storage.map_samples import draft_details, random_tile

_PAGES = (
    "/v1/robots?limit=1000",
    "/v1/fleet/measures?by=robot&limit=1000",
    "/v1/fleet/measures?by=tile",
    f"/v1/sites/{SITE}/hours?hours=168",
    "/v1/failures",
    f"/v1/sites/{SITE}/resurvey",
    "/metrics",
)


def make_site(folder: Path) -> None:
    """A published version with a row of tiles."""
    rng = np.random.default_rng(0)
    tiles = [random_tile(rng, cell=(x, 0)) for x in range(TILES)]
    with MapStore.open(folder, create=True) as store:
        store.save_draft(SITE, DraftContent(tiles=tiles, vocabulary=b"words" * 50, details=draft_details(path_m=100.0)))
        releases.publish(store, SITE)


class Robots:
    """Processes full of robots."""

    def __init__(self, endpoint: str, robots: int, seconds: int, processes: int) -> None:
        shares = [len(part) for part in np.array_split(np.arange(robots), processes)]
        program = "from benchmarks.fleet.fleet_clients import main; main()"
        self._processes = [
            subprocess.Popen(
                [sys.executable, "-c", program, endpoint, str(1000 * number), str(share), str(seconds)],
                env=os.environ | {"PYTHONPATH": _SOURCES}, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            )
            for number, share in enumerate(shares)
        ]  # fmt: skip
        for process in self._processes:
            assert process.stdout is not None and process.stdout.readline() == "ready\n"

    def drive(self) -> dict[str, Any]:
        """Lets them drive; what they said, added up."""
        self._tell()
        answers = [json.loads(process.stdout.readline()) for process in self._processes if process.stdout is not None]
        total: dict[str, Any] = {
            name: sum(answer[name] for answer in answers)
            for name in ("health", "estimates", "reports", "acknowledged", "driving_s")
        }
        for name in ("failures", "suspected"):
            counts: Counter[str] = Counter()
            for answer in answers:
                counts.update(answer[name])
            total[name] = dict(counts)
        return total | {"late_s": max(answer["late_s"] for answer in answers)}

    def close(self) -> None:
        """Lets them go."""
        self._tell()
        for process in self._processes:
            process.wait(timeout=60)

    def _tell(self) -> None:
        for process in self._processes:
            assert process.stdin is not None
            process.stdin.write("go\n")
            process.stdin.flush()


def measure_load(folder: Path, robots: int, seconds: int, processes: int) -> dict[str, Any]:
    """Drives, counts, compares; raises AssertionError where a count differs."""
    rss_mb: list[float] = []
    page_ms: dict[str, list[float]] = {page: [] for page in _PAGES}
    over = threading.Event()
    with ExitStack() as stack:
        process, http, endpoint = stack.enter_context(serving(folder))
        fleet = Robots(endpoint, robots, seconds, processes)

        def watch() -> None:
            with httpx.Client(base_url=http, timeout=30) as client:
                number = 0
                while not over.wait(1.0):
                    rss_mb.append(resident_mb(process.pid))
                    page = _PAGES[number % len(_PAGES)]
                    page_ms[page].append(_timed_ms(lambda page=page: client.get(page).raise_for_status()))
                    number += 1

        watcher = threading.Thread(target=watch)
        watcher.start()
        begun_s, begun_cpu_s = time.monotonic(), cpu_s(process.pid)
        said = fleet.drive()
        cores = (cpu_s(process.pid) - begun_cpu_s) / (time.monotonic() - begun_s)
        over.set()
        watcher.join()
        time.sleep(6.0)  # the last flush and the last look for robots
        text = httpx.get(f"{http}/metrics", timeout=30).text
        present = httpx.get(f"{http}/v1/robots?limit=1000", timeout=30).json()["robots"]
        fleet.close()
    heard = _bus_counts(text)
    with MapStore.open(folder) as store:
        kept = _compare(store, said)
    assert heard["health"] == said["health"], (heard, said["health"])
    assert all(robot["is_present"] for robot in present) and len(present) == robots
    tenth = max(1, len(rss_mb) // 10)
    slowest = {page: max(times) for page, times in page_ms.items() if times}
    return {
        "robots": robots, "seconds": seconds, "health_said": said["health"], "health_heard": heard["health"],
        "estimates_said": said["estimates"], "estimates_heard": heard["pose"], "failures_said": said["reports"],
        "failures_kept": kept, "server_cores": cores, "rss_begin_mb": float(np.mean(rss_mb[tenth : 2 * tenth])),
        "rss_end_mb": float(np.mean(rss_mb[-tenth:])),
        "rss_growth": float(np.mean(rss_mb[-tenth:]) / np.mean(rss_mb[tenth : 2 * tenth])),
        "robots_late_s": said["late_s"], "slowest_page_ms": slowest,
    }  # fmt: skip


def _bus_counts(text: str) -> Counter[str]:
    """Messages that the server took, by what they are."""
    counts: Counter[str] = Counter()
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            if sample.name == "fleetmap_bus_messages_total":
                assert sample.labels["result"] == "ok", sample
                counts[sample.labels["what"]] += int(sample.value)
    return counts


def _compare(store: MapStore, said: dict[str, Any]) -> int:
    """The number of failures in the store, after every marginal was compared with what the robots know."""
    for axis in ("site", "robot", "version", "tile", "cause"):
        counted = {key: counts for (_, key), counts in store.fleet.counters(SITE, axis).items()}
        for name in ("failures", "suspected"):
            mine = {key: getattr(counts, name) for key, counts in counted.items() if getattr(counts, name)}
            theirs = {key.partition("|")[2]: n for key, n in said[name].items() if key.partition("|")[0] == axis}
            assert mine == theirs, (axis, name)
    total = store.fleet.counters(SITE, "site")[SITE, ""]
    assert total.reports == said["health"], (total.reports, said["health"])
    assert abs(total.driving_ms / 1e3 / said["driving_s"] - 1) < 0.02, (total.driving_ms, said["driving_s"])
    count = len(store.fleet.failures(FailureFilter(site=SITE)))
    assert count == said["reports"] == said["acknowledged"]
    return count


def measure_month(folder: Path, robots: int) -> dict[str, float]:
    """A month of sums: 300 robots, 400 tiles, 3 versions, 6 causes, all of them every hour."""
    rng = np.random.default_rng(0)
    with MapStore.open(folder, create=True) as store:
        for hour in range(720):
            batch = FleetBatch()
            keys = [("robot", f"robot-{n}") for n in range(robots)] + [
                ("tile", f"{n % 20},{n // 20}") for n in range(400)
            ]
            keys += [("version", str(n)) for n in range(3)] + [("cause", f"c{n}") for n in range(6)] + [("site", "")]
            for axis, key in keys:
                batch.add(
                    SITE,
                    axis,
                    key,
                    hour,
                    Counters(*(int(value) for value in rng.integers(0, 3_600_000, len(COUNTER_COLUMNS)))),
                )
            store.fleet.add(batch)
        timed: dict[str, Callable[[], object]] = {
            "robots_day_ms": lambda: store.fleet.counters(SITE, "robot", since_hour=696),
            "robots_month_ms": lambda: store.fleet.counters(SITE, "robot"),
            "tiles_month_ms": lambda: store.fleet.counters(SITE, "tile"),
            "hours_month_ms": lambda: store.fleet.hours(SITE, "site"),
        }
        figures = {name: min(_timed_ms(ask) for _ in range(3)) for name, ask in timed.items()}
    return {"size_mb": sum(path.stat().st_size for path in folder.glob("store.sqlite3*")) / 1e6} | figures


def _timed_ms(act: Callable[[], object]) -> float:
    begun_s = time.perf_counter()
    act()
    return 1e3 * (time.perf_counter() - begun_s)


def show(name: str, figures: dict[str, Any]) -> None:
    """A table of two columns."""
    print(f"\n{name}")
    for key, value in figures.items():
        rows = value.items() if isinstance(value, dict) else [("", value)]
        for part, figure in rows:
            print(f"  {key:20} {part:45} {figure:12.4g}", flush=True)


def bench(robots: int, seconds: int, *, month: bool, processes: int = 2) -> dict[str, Any]:
    """All figures."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        make_site(Path(name) / "store")
        found["load"] = measure_load(Path(name) / "store", robots, seconds, processes)
        show("load", found["load"])
        if month:
            found["month"] = measure_month(Path(name) / "month", robots)
            show("month", found["month"])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=300)
    parser.add_argument("--seconds", type=int, default=120)
    parser.add_argument("--month", action="store_true")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    found = bench(options.robots, options.seconds, month=options.month, processes=options.processes)
    about = {
        "machine": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version(),
        "zenoh": metadata.version("eclipse-zenoh"), "command": sys.argv,
    }  # fmt: skip
    print(json.dumps(about | found))
    if options.out is not None:
        options.out.write_bytes(msgspec.json.format(msgspec.json.encode(about | found), indent=2) + b"\n")


if __name__ == "__main__":
    main()
