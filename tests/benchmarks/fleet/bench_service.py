"""A fleet that fetches a whole site at once, then a night's delta, from one server on loopback; and a server that goes away.

    PYTHONPATH=tests python tests/benchmarks/fleet/bench_service.py [--clients 300] [--site-mb 50] [--outage-s 60] [--out FILE.json]

Robots are threads of a few processes, each with its own zenoh session, and run the robot's own `ChunkReader`. Every byte of every
robot is hashed. Meanwhile operators ask the HTTP list endpoints. Then one robot fetches through `MapClient` and a cache on the disk
while the server is killed in the middle and started again after `--outage-s`.
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
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import httpx
import msgspec
import numpy as np

from benchmarks.fleet.service_clients import SITE
from fleetmap.bus import Bus
from fleetmap.mapformat import Tile
from fleetmap.messages import robot_key
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from mapserver import releases
from mapserver.store import DraftContent, MapStore
from support.storage.map_samples import draft_details, random_tile

_TILE_LANDMARKS = 5000
_TILE_BYTES = 215_000  # such a tile, compressed
_CHANGED_SHARE = 0.05  # of the tiles, and of the landmarks of each
_LISTS = ("/v1/sites", f"/v1/sites/{SITE}/versions", "/v1/robots")
_HTTP_PER_S = 20.0
_REPOSITORY = Path(__file__).resolve().parents[3]
_SOURCES = os.pathsep.join(str(_REPOSITORY / folder) for folder in ("shared", "", "tests"))


@dataclass
class Load:
    """What the server cost while something went on."""

    cpu_s: float = 0.0
    wall_s: float = 0.0
    rss_mb: list[float] = field(default_factory=list)
    http_ms: list[float] = field(default_factory=list)

    def figures(self) -> dict[str, float]:
        """For the report. Memory of the server: at the start, the most, at the end."""
        http = np.percentile(self.http_ms, [50, 99]) if self.http_ms else [np.nan, np.nan]
        return {
            "wall_s": self.wall_s, "server_cpu_s": self.cpu_s, "server_cores": self.cpu_s / self.wall_s,
            "rss_begin_mb": self.rss_mb[0], "rss_max_mb": max(self.rss_mb), "rss_end_mb": self.rss_mb[-1],
            "http_requests": len(self.http_ms), "http_p50_ms": float(http[0]), "http_p99_ms": float(http[1]),
        }  # fmt: skip


def make_site(folder: Path, site_mb: float) -> int:
    """A published version of about so many megabytes; the number of its tiles."""
    rng = np.random.default_rng(0)
    count = max(1, round(site_mb * 1e6 / _TILE_BYTES))
    side = int(np.ceil(np.sqrt(count)))
    tiles = [random_tile(rng, landmarks=_TILE_LANDMARKS, places=12, cell=(n % side, n // side)) for n in range(count)]
    publish(folder, tiles)
    return count


def publish(folder: Path, tiles: list[Tile]) -> None:
    """Makes a version of these current, as another process than the server."""
    with MapStore.open(folder, create=True) as store:
        store.save_draft(
            SITE, DraftContent(tiles=tiles, vocabulary=bytes(range(256)) * 4000, details=draft_details(path_m=1000.0))
        )
        releases.publish(store, SITE)


def next_night(folder: Path) -> list[Tile]:
    """The current tiles; in one of twenty a twentieth of the landmarks is gone, and as many are new."""
    from fleetmap.mapformat import decode_tile

    rng = np.random.default_rng(1)
    with MapStore.open(folder) as store:
        current = store.current(SITE)
        assert current is not None
        entries = store.manifest(SITE, current.version).tiles
        tiles = [decode_tile(store.blob(entry.sha256)) for entry in entries]
        every = round(1 / _CHANGED_SHARE)
        return [tile if number % every else _changed(tile, rng) for number, tile in enumerate(tiles)]


def _changed(tile: Tile, rng: np.random.Generator) -> Tile:
    count = round(_CHANGED_SHARE * len(tile))
    gone = rng.choice(len(tile), count, replace=False)
    kept = np.setdiff1d(np.arange(len(tile)), gone)
    other = random_tile(rng, landmarks=count, places=0, cell=(tile.tile_x, tile.tile_y))
    names = ("points_map", "descriptors", "view_directions_map", "view_half_angle_rad", "max_distance_m", "sigma_m")
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(tile, name)[kept], getattr(other, name)]) for name in names
    }
    fresh = (int(tile.landmark_ids[-1]) + 1 + np.arange(count)).astype(np.uint32)
    lists = tuple(np.setdiff1d(ids, tile.landmark_ids[gone]).astype(np.uint32) for ids in tile.place_landmark_ids)
    ids = np.concatenate([tile.landmark_ids[kept], fresh])
    return replace(tile, landmark_ids=ids, place_landmark_ids=lists, **columns)


@contextmanager
def serving(folder: Path, endpoint: str = "tcp/127.0.0.1:0") -> Iterator[tuple[subprocess.Popen[str], str, str]]:
    """A running server and its HTTP and zenoh addresses."""
    program = "import sys; from mapserver.cli import main; main()"
    command = [
        sys.executable,
        "-c",
        program,
        "serve",
        "--store",
        str(folder),
        "--http",
        "127.0.0.1:0",
        "--zenoh",
        endpoint,
    ]
    process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": _SOURCES}, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        addresses = dict(process.stdout.readline().strip().split(": ", 1) for _ in range(2))
        assert process.stdout.readline() == "ready\n"
        yield process, addresses["http"], addresses["zenoh"]
    finally:
        process.terminate()
        process.wait(timeout=30)
        process.stdout.close()


@contextmanager
def measured(pid: int, http: str) -> Iterator[Load]:
    """Measures the server, and asks it for lists as an operator's page does, until the block ends."""
    load, over = Load(), threading.Event()

    def watch() -> None:
        while not over.wait(0.5):
            load.rss_mb.append(resident_mb(pid))

    def ask() -> None:
        with httpx.Client(base_url=http, timeout=30) as client:
            number = 0
            while not over.wait(1 / _HTTP_PER_S):
                begun_s = time.perf_counter()
                client.get(_LISTS[number % len(_LISTS)]).raise_for_status()
                load.http_ms.append(1e3 * (time.perf_counter() - begun_s))
                number += 1

    threads = [threading.Thread(target=work) for work in (watch, ask)]
    load.rss_mb.append(resident_mb(pid))
    begun_s, begun_cpu_s = time.monotonic(), cpu_s(pid)
    for thread in threads:
        thread.start()
    try:
        yield load
    finally:
        over.set()
        for thread in threads:
            thread.join()
        load.wall_s, load.cpu_s = time.monotonic() - begun_s, cpu_s(pid) - begun_cpu_s
        load.rss_mb.append(resident_mb(pid))


def resident_mb(pid: int) -> float:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024 / 1e6
    return float("nan")


def cpu_s(pid: int) -> float:
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


class Fleet:
    """Processes full of robots."""

    def __init__(self, endpoint: str, clients: int, processes: int, identities: Path | None = None) -> None:
        """identities: folder with the certificates of all robots, where the bus asks for them."""
        shares = [len(part) for part in np.array_split(np.arange(clients), processes)]
        program = "from benchmarks.fleet.service_clients import main; main()"
        self._processes = [
            subprocess.Popen(
                [sys.executable, "-c", program, endpoint, str(number), str(share), *([str(identities)] if identities else [])],
                env=os.environ | {"PYTHONPATH": _SOURCES}, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            )
            for number, share in enumerate(shares)
        ]  # fmt: skip
        for process in self._processes:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"

    def fetch(self, *, anew: bool) -> dict[str, float]:
        """All robots fetch the wanted version at once, as if they had none where `anew`; fails where a single byte is wrong."""
        for process in self._processes:
            assert process.stdin is not None
            process.stdin.write("anew\n" if anew else "go\n")
            process.stdin.flush()
        phases = []
        for process in self._processes:
            assert process.stdout is not None
            phases += json.loads(process.stdout.readline())
        seconds = np.array([phase["seconds"] for phase in phases])
        return {
            "robots": len(phases), "bytes_per_robot": phases[0]["bytes"], "bytes": sum(phase["bytes"] for phase in phases),
            "robot_median_s": float(np.median(seconds)), "robot_max_s": float(seconds.max()),
        }  # fmt: skip

    def cpu_s(self) -> float:
        """Of all robots until now."""
        return sum(cpu_s(process.pid) for process in self._processes)

    def close(self) -> None:
        for process in self._processes:
            assert process.stdin is not None and process.stdout is not None
            process.stdin.close()
            process.wait(timeout=60)
            process.stdout.close()


def measure_fleet(folder: Path, clients: int, processes: int) -> dict[str, dict[str, float]]:
    """Everybody fetches the whole site, the delta of a night, a night in which nothing moved, and the whole site again.

    The first row is the server alone. The last one shows whether the server's memory grows once its caches are full.
    """
    rows = {}
    with serving(folder) as (process, http, endpoint):
        with measured(process.pid, http) as load:
            time.sleep(10.0)
        rows["idle"] = load.figures()
        show("idle", rows["idle"])
        fleet = Fleet(endpoint, clients, processes)
        try:
            for name in ("whole", "delta", "nothing moved", "whole again"):
                if name in {"delta", "nothing moved"}:
                    with announced(endpoint):
                        if name == "delta":
                            publish(folder, next_night(folder))
                        else:
                            with MapStore.open(folder) as store:
                                republish(store)
                with measured(process.pid, http) as load:
                    found = fleet.fetch(anew=name == "whole again")
                rows[name] = found | load.figures()
                rows[name]["http_p99_over_idle"] = rows[name]["http_p99_ms"] / rows["idle"]["http_p99_ms"]
                rows[name]["share_of_whole"] = rows[name]["bytes_per_robot"] / rows["whole"]["bytes_per_robot"]
                show(name, rows[name])
        finally:
            fleet.close()
    return rows


@contextmanager
def announced(endpoint: str) -> Iterator[None]:
    """Waits until a robot is told of what the block publishes, as robots do before they fetch."""
    heard = threading.Event()
    with Bus.connect(endpoint) as bus:
        bus.subscribe(robot_key(SITE, "robot-0", "wanted"), lambda *_: heard.set())
        while not bus.connected():
            time.sleep(0.05)
        yield
        assert heard.wait(120), "nobody was told of the new version"
        time.sleep(2.0)  # the other robots are told too


def republish(store: MapStore) -> None:
    """The same tiles as a new version."""
    from fleetmap.mapformat import decode_tile

    current = store.current(SITE)
    assert current is not None
    tiles = [decode_tile(store.blob(entry.sha256)) for entry in store.manifest(SITE, current.version).tiles]
    store.save_draft(
        SITE, DraftContent(tiles=tiles, vocabulary=bytes(range(256)) * 4000, details=draft_details(path_m=1000.0))
    )
    releases.publish(store, SITE)


def measure_outage(folder: Path, cache_folder: Path, outage_s: float) -> dict[str, float]:
    """A robot's fetch over a server that is killed in the middle and comes back."""
    with serving(folder) as (process, _, endpoint), Bus.connect(endpoint) as bus:
        cache = TileCache(cache_folder)
        link = MapClient(bus, cache, SITE, "patient", timeout_s=2.0, patience_s=outage_s + 60)
        wanted = link.wanted()
        finished: list[float] = []
        thread = threading.Thread(target=lambda: (link.bring(wanted), finished.append(time.monotonic())))
        begun_s = time.monotonic()
        thread.start()
        while link.received_bytes < 2_000_000:
            time.sleep(0.005)
        process.kill()
        process.wait()
        before = link.received_bytes
        time.sleep(outage_s)
        assert cache.active(SITE) is None, "a version that is not whole became active"
        with serving(folder, endpoint):
            thread.join(timeout=120)
        active = cache.active(SITE)
        assert finished and active is not None, "the fetch was not completed"
        sizes = [len(cache.get(sha256) or b"") for sha256 in active.blobs]
        assert link.received_bytes == sum(sizes), "something was fetched twice"
        return {"outage_s": outage_s, "bytes_before": before, "bytes": sum(sizes), "seconds": finished[0] - begun_s}


def show(name: str, figures: dict[str, float]) -> None:
    """One row."""
    print(f"\n{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in figures.items()), flush=True)


def bench(clients: int, site_mb: float, outage_s: float, processes: int = 2) -> dict[str, dict[str, float]]:
    """All figures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_site(folder / "store", site_mb)
        rows = measure_fleet(folder / "store", clients, processes)
        rows["outage"] = measure_outage(folder / "store", folder / "cache", outage_s)
        show("outage", rows["outage"])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clients", type=int, default=300)
    parser.add_argument("--site-mb", type=float, default=50.0)
    parser.add_argument("--outage-s", type=float, default=60.0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = bench(options.clients, options.site_mb, options.outage_s, options.processes)
    if options.out is not None:
        about = {"machine": platform.machine(), "cores": os.cpu_count(), "command": sys.argv}
        options.out.write_bytes(msgspec.json.format(msgspec.json.encode(about | rows), indent=2) + b"\n")


if __name__ == "__main__":
    main()
