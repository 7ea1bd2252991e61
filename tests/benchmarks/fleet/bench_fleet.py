"""A fleet that reports: health at 1 Hz, estimates at 2 Hz and failures of many robots to one server on loopback, counted at both ends.

Robots have a zenoh session each and clocks that are wrong by seconds. Meanwhile lists and figures are asked for over HTTP. Every count is
compared with what the robots know: reports, failures by site, robot, tile and cause, hours driven. A store is filled with 30 days of sums
of so many robots, and its size is measured.
"""

import multiprocessing
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from prometheus_client.parser import text_string_to_metric_families

from benchmarks.common.recorded_runs import Options, Results, benchmark
from benchmarks.fleet.server_process import SITE, measured
from fleetmap import messages
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import FleetmapError
from mapserver import releases
from mapserver.fleet_statistics.kpis import COUNTER_COLUMNS, Counters
from mapserver.store import DraftContent, FailureFilter, FleetBatch, MapStore
from support.fleet.dashboard_scene import serving
from support.fleet.made_fleet import NS, Known, MadeRobot
from support.storage.map_samples import draft_details, random_tile

_TILES, _PROCESSES = 20, 2
_PAGES = (
    "/v1/robots?limit=1000",
    "/v1/fleet/measures?by=robot&limit=1000",
    "/v1/fleet/measures?by=tile",
    f"/v1/sites/{SITE}/hours?hours=168",
    "/v1/failures",
    f"/v1/sites/{SITE}/resurvey",
    "/metrics",
)


class _Robot:
    """A robot and its connection."""

    def __init__(self, endpoint: str, number: int, known: Known) -> None:
        self.made = MadeRobot(
            SITE, f"robot-{number}", np.random.default_rng(number), known, rate_per_robot_day=60.0, tiles=_TILES,
            bad_tile=number % _TILES, ahead_s=(number % 7) - 3.0, cause=("dark", "blur", "covered")[number % 3], suspected_share=0.2,
        )  # fmt: skip
        self.bus = Bus(endpoint).open()
        self.alive = self.bus.declare_alive(messages.robot_key(SITE, self.made.name, "alive"))

    def say(self, message: messages.RobotHealth | messages.PoseMessage) -> None:
        what = "health" if isinstance(message, messages.RobotHealth) else "pose"
        self.bus.publish(
            messages.robot_key(SITE, self.made.name, what), messages.encode_message(message), may_drop=what == "pose"
        )

    def report(self, failure: messages.FailureReport) -> None:
        """Asks until it is acknowledged."""
        key = messages.robot_key(SITE, failure.robot, "failures")
        while True:
            try:
                answer = self.bus.get(key, messages.encode_message(failure), timeout_s=10.0)
            except FleetmapError:
                continue
            assert messages.decode_message(answer, messages.FailureAck) == messages.FailureAck(id=failure.id)
            return


def _drive(robots: list[_Robot], seconds: int, pool: ThreadPoolExecutor) -> float:
    """Every robot speaks twice a second, all of them spread over it; returns by how much the last word was late."""
    begun_s, late_s = time.monotonic(), 0.0
    for step in range(1, seconds + 1):
        now_ns = time.time_ns()
        later: list[tuple[_Robot, messages.PoseMessage | messages.RobotHealth]] = []
        for place, robot in enumerate(robots):
            offset_s = 0.5 * place / len(robots)
            time.sleep(max(0.0, begun_s + step - 1 + offset_s - time.monotonic()))
            first, second, health, *failures = robot.made.second(now_ns + round(offset_s * NS))
            robot.say(first)
            later += [(robot, second), (robot, health)]
            for failure in failures:
                pool.submit(robot.report, failure)
        for place, (robot, message) in enumerate(later):
            time.sleep(max(0.0, begun_s + step - 0.5 + 0.5 * place / len(later) - time.monotonic()))
            robot.say(message)
        late_s = max(late_s, time.monotonic() - begun_s - step)
    return late_s


def _robots(endpoint: str, numbers: range, seconds: int, said: Any, begin: Any, end: Any) -> None:
    """A process of robots: connects, drives at `begin`, puts what was said, stays until `end`."""
    known = Known()
    robots = [_Robot(endpoint, number, known) for number in numbers]
    while not all(robot.bus.connected() for robot in robots):
        time.sleep(0.05)
    said.put("ready")
    begin.wait()
    with ThreadPoolExecutor(8) as pool:
        late_s = _drive(robots, seconds, pool)
    time.sleep(1.0)  # what was published last is on its way
    said.put((known, late_s))
    end.wait()
    for robot in robots:
        robot.bus.close()


def measure_load(folder: Path, robots: int, seconds: int) -> dict[str, Any]:
    """Drives, counts, compares; raises AssertionError where a count differs."""
    context = multiprocessing.get_context("spawn")
    said, begin, end = context.Queue(), context.Event(), context.Event()
    with serving(folder) as served:
        shares = [range(n, robots, _PROCESSES) for n in range(_PROCESSES)]
        fleets = [context.Process(target=_robots, args=(served.zenoh, s, seconds, said, begin, end)) for s in shares]
        for fleet in fleets:
            fleet.start()
        assert [said.get() for _ in fleets] == ["ready"] * len(fleets)
        with measured(served.process, served.http, _PAGES, 1.0) as load:
            begin.set()
            answers = [said.get() for _ in fleets]
        time.sleep(6.0)  # the last flush and the last look for robots
        text = httpx.get(f"{served.http}/metrics", timeout=30).text
        present = httpx.get(f"{served.http}/v1/robots?limit=1000", timeout=30).json()["items"]
        end.set()
        for fleet in fleets:
            fleet.join()
    known = [answer[0] for answer in answers]
    heard = _bus_counts(text)
    with MapStore.open(folder) as store:
        kept = _compare(store, known)
    health = sum(each.health for each in known)
    assert heard["health"] == health, (heard, health)
    assert all(robot["is_present"] for robot in present)
    assert len(present) == robots
    tenth = max(1, len(load.rss_mb) // 10)
    rss_begin_mb, rss_end_mb = np.mean(load.rss_mb[tenth : 2 * tenth]), np.mean(load.rss_mb[-tenth:])
    return {
        "robots": robots, "seconds": seconds, "health": health, "estimates_said": sum(each.estimates for each in known),
        "estimates_heard": heard["pose"], "failures_kept": kept, "server_cores": load.cores, "rss_begin_mb": float(rss_begin_mb),
        "rss_end_mb": float(rss_end_mb), "rss_growth": float(rss_end_mb / rss_begin_mb),
        "robots_late_s": max(answer[1] for answer in answers), "slowest_page_ms": {p: max(ms) for p, ms in load.page_ms.items()},
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


def _compare(store: MapStore, known: list[Known]) -> int:
    """The number of failures in the store, after every marginal was compared with what the robots know."""
    for axis in ("site", "robot", "version", "tile", "cause"):
        counted = {key: counts for (_, key), counts in store.fleet.counters(SITE, axis).items()}
        for name in ("failures", "suspected"):
            mine = {key: getattr(counts, name) for key, counts in counted.items() if getattr(counts, name)}
            theirs: Counter[str] = Counter()
            for each in known:
                theirs.update({key: n for (of, key), n in getattr(each, name).items() if of == axis})
            assert mine == dict(theirs), (axis, name)
    total, driving_s = store.fleet.counters(SITE, "site")[SITE, ""], sum(each.driving_s["site", ""] for each in known)
    assert abs(total.driving_ms / 1e3 / driving_s - 1) < 0.02, (total.driving_ms, driving_s)
    count = len(store.fleet.failures(FailureFilter(site=SITE)))
    assert count == sum(each.reports for each in known)
    return count


def measure_month(folder: Path, robots: int) -> dict[str, float]:
    """A month of sums: so many robots, 400 tiles, 3 versions, 6 causes, all of them every hour."""
    rng = np.random.default_rng(0)
    keys = [("robot", f"robot-{n}") for n in range(robots)] + [("tile", f"{n % 20},{n // 20}") for n in range(400)]
    keys += [("version", str(n)) for n in range(3)] + [("cause", f"c{n}") for n in range(6)] + [("site", "")]
    with MapStore.open(folder, create=True) as store:
        for hour in range(720):
            batch = FleetBatch()
            for axis, key in keys:
                values = rng.integers(0, 3_600_000, len(COUNTER_COLUMNS)).tolist()
                batch.add(SITE, axis, key, hour, Counters(*values))
            store.fleet.add(batch)
    return {"size_mb": sum(path.stat().st_size for path in folder.glob("store.sqlite3*")) / 1e6}


@benchmark(robots=300, seconds=120)
def main(options: Options) -> Results:
    with tempfile.TemporaryDirectory() as name:
        store = Path(name) / "store"
        rng = np.random.default_rng(0)
        tiles = [random_tile(rng, cell=(x, 0)) for x in range(_TILES)]
        content = DraftContent(tiles=tiles, vocabulary=b"words" * 50, details=draft_details(path_m=100.0))
        with MapStore.open(store, create=True) as maps:
            maps.save(SITE, content)
            releases.publish(maps, SITE)
        found = {"load": measure_load(store, options.robots, options.seconds)}
        found["month"] = measure_month(Path(name) / "month", options.robots)
    return found
