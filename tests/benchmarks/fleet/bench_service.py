"""A fleet that fetches a whole site at once, then a night's delta, and the whole again, from one server on loopback.

Robots are threads of a few processes, each with its own zenoh session, and run the robot's own `ChunkReader`. Every byte of every robot is
hashed. Meanwhile operators ask the HTTP list endpoints. The last round shows whether the server's memory grows once its caches are full.
"""

import multiprocessing
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.recorded_runs import Options, Results, benchmark
from benchmarks.fleet.server_process import SITE, measured
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.mapformat.manifest import Manifest, decode_manifest
from fleetmap.mapformat.names import verified
from fleetmap.mapformat.tile import Tile, decode_tile
from fleetmap.messages import WantedVersion, decode_message, robot_key
from locclient.maps.map_client import ChunkReader
from mapserver import releases
from mapserver.store import DraftContent, MapStore
from support.fleet.dashboard_scene import serving
from support.storage.map_samples import draft_details, random_tile

_TILE_LANDMARKS = 5000
_TILE_BYTES = 215_000  # such a tile, compressed
_CHANGED_SHARE = 0.05  # of the tiles, and of the landmarks of each
_LISTS = ("/v1/sites", f"/v1/sites/{SITE}/versions", "/v1/robots")
_PROCESSES, _TIMEOUT_S, _PATIENCE_S = 2, 20.0, 120.0


def publish(folder: Path, tiles: list[Tile]) -> None:
    """Makes a version of these current, as another process than the server."""
    content = DraftContent(tiles=tiles, vocabulary=bytes(range(256)) * 4000, details=draft_details(path_m=1000.0))
    with MapStore.open(folder, create=True) as store:
        store.save(SITE, content)
        releases.publish(store, SITE)


def next_night(folder: Path, *, is_changed: bool) -> list[Tile]:
    """The current tiles; where the night changed something, in one of twenty a twentieth of the landmarks is gone, and as many are new."""
    rng, every = np.random.default_rng(1), round(1 / _CHANGED_SHARE)
    with MapStore.open(folder) as store:
        entries = store.manifest(SITE, store.current(SITE).version).tiles
        tiles = [decode_tile(store.blob(entry.sha256)) for entry in entries]
    return [_changed(tile, rng) if is_changed and n % every == 0 else tile for n, tile in enumerate(tiles)]


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


class _Robot:
    """One client: its connection, its manifest, what it received."""

    def __init__(self, endpoint: str, name: str) -> None:
        self.bus, self._name = Bus(endpoint).open(), name
        self._parts = ChunkReader(self.bus, timeout_s=_TIMEOUT_S, patience_s=_PATIENCE_S)
        self.manifest: Manifest | None = None

    def fetch(self) -> tuple[float, int]:
        """The wanted version, every byte of it verified: all at first, later the tiles that changed. Seconds and bytes."""
        begun_s, begun_bytes = time.monotonic(), self._parts.received_bytes
        question = robot_key(SITE, self._name, "wanted")
        wanted = decode_message(self.bus.get(question, timeout_s=_PATIENCE_S), WantedVersion)
        key = robot_key(SITE, self._name, f"manifests/{wanted.version}")
        old, new = (
            self.manifest,
            decode_manifest(verified(self._parts.read(key, max_bytes=1 << 24), wanted.manifest_sha256)),
        )
        known = set() if old is None else {old.vocabulary.sha256, *(tile.sha256 for tile in old.tiles)}
        for blob in (new.vocabulary, *new.tiles):
            if blob.sha256 not in known:
                key = robot_key(SITE, self._name, f"blobs/{blob.sha256}")
                verified(self._parts.read(key, max_bytes=blob.bytes), blob.sha256)
        self.manifest = new
        return time.monotonic() - begun_s, self._parts.received_bytes - begun_bytes


def _robots(endpoint: str, numbers: range, orders: Any, said: Any) -> None:
    """A process of robots: all fetch at once for every order, "anew" as if they had nothing; ends at "end"."""
    robots = [_Robot(endpoint, f"robot-{number}") for number in numbers]
    said.put("ready")
    while (order := orders.get()) != "end":
        for robot in robots:
            robot.manifest = None if order == "anew" else robot.manifest
        with ThreadPoolExecutor(len(robots)) as pool:
            said.put(list(pool.map(_Robot.fetch, robots)))
    for robot in robots:
        robot.bus.close()


@contextmanager
def announced(endpoint: str) -> Iterator[None]:
    """Waits until a robot is told of what the block publishes, as robots do before they fetch."""
    heard = threading.Event()
    with Bus(endpoint).open() as bus:
        bus.subscribe(robot_key(SITE, "robot-0", "wanted"), lambda *_: heard.set())
        while not bus.connected():
            time.sleep(0.05)
        yield
        assert heard.wait(120), "nobody was told of the new version"
        time.sleep(2.0)  # the other robots are told too


def bench(folder: Path, clients: int, site_mb: float) -> dict[str, dict[str, float]]:
    """Everybody fetches the whole site, the delta of a night, a night in which nothing moved, and the whole site again."""
    rng, count = np.random.default_rng(0), max(1, round(site_mb * 1e6 / _TILE_BYTES))
    side = int(np.ceil(np.sqrt(count)))
    cells = [(n % side, n // side) for n in range(count)]
    publish(folder, [random_tile(rng, landmarks=_TILE_LANDMARKS, places=12, cell=cell) for cell in cells])
    context, rows = multiprocessing.get_context("spawn"), dict[str, dict[str, float]]()
    said = context.Queue()
    with serving(folder) as served:
        orders = [context.Queue() for _ in range(_PROCESSES)]
        fleets = [
            context.Process(target=_robots, args=(served.zenoh, range(n, clients, _PROCESSES), queue, said))
            for n, queue in enumerate(orders)
        ]
        for fleet in fleets:
            fleet.start()
        assert [said.get() for _ in fleets] == ["ready"] * len(fleets)
        for name in ("whole", "delta", "nothing moved", "whole again"):
            if name in ("delta", "nothing moved"):
                with announced(served.zenoh):
                    publish(folder, next_night(folder, is_changed=name == "delta"))
            with measured(served.process, served.http, _LISTS, 0.05) as load:
                for queue in orders:
                    queue.put("anew" if name == "whole again" else "go")
                seconds, sizes = zip(*(row for _ in fleets for row in said.get()), strict=True)
            http_ms = [ms for times in load.page_ms.values() for ms in times] or [np.nan]
            rows[name] = {
                "robots": len(sizes), "bytes_per_robot": sizes[0], "robot_median_s": float(np.median(seconds)),
                "robot_max_s": max(seconds), "server_cores": load.cores, "rss_max_mb": max(load.rss_mb),
                "http_p99_ms": float(np.percentile(http_ms, 99)),
            }  # fmt: skip
            rows[name]["share_of_whole"] = sizes[0] / rows["whole"]["bytes_per_robot"]
        for queue in orders:
            queue.put("end")
        for fleet in fleets:
            fleet.join()
    return rows


@benchmark(clients=300, site_mb=50)
def main(options: Options) -> Results:
    with tempfile.TemporaryDirectory() as name:
        return bench(Path(name) / "store", options.clients, options.site_mb)
