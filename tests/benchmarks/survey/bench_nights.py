"""What a night costs a robot that has the version before: nothing moved, then some of the stock, through `mapserver nightly`.

    PYTHONPATH=tests python tests/benchmarks/survey/bench_nights.py [--scenario small-loop] [--frames ::2] [--rate 0.05] [--work FOLDER]
        [--out FILE.json]

Each night a survey robot drives the scenario's first route, with noise and shaking of its own, and its recording is checked, built
on the current version, judged and published. After each a robot fetches the new version over the bus, through its cache and with
patches of what it has; another one, which has nothing, fetches all of it. Recordings stay in the work folder and serve again.
"""

import argparse
import json
import os
import platform
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console

from fleetmap.bus import MemoryBus, MemoryHub
from fleetsim.commands import record_order
from fleetsim.recorder import Order
from fleetsim.scenarios import SCENARIOS, Scenario, find_scenario
from fleetsim.scene.stock import Slot, last_restock_day
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from mapserver.config import MapserverConfig
from mapserver.fleet.fleet import Fleet
from mapserver.nightly import NightRequest, last_report, run_night
from mapserver.serving.bus_service import BusService
from mapserver.store import MapStore

SITE = "hall"
SEED = 1
_SESSION = (
    "landmarks_kept", "landmarks_moved", "landmarks_faded", "landmarks_added", "keyframes_moved", "keyframes_added", "seen_rate",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Night:
    """Day of the stock, and the name of the run, from which its noise follows."""

    name: str
    day: int
    run: str


NIGHTS = (
    Night("first map", 0, "survey"),
    Night("nothing moved", 0, "second"),
    Night("stock moved", 1, "third"),
    Night("stock moved again", 2, "fourth"),
)


def scenario_of_nights(name: str, rate: float) -> str:
    """A scenario like `name`, where `rate` of the stock moves each day, with the first run once for every night; its name."""
    base = find_scenario(name)
    run = next(iter(base.runs.values()))

    def make() -> Scenario:
        layout = msgspec.structs.replace(base.layout, restock_per_day=rate)
        return replace(base, layout=layout, runs={night.run: run for night in NIGHTS})

    own = f"{name}-nights-{rate:g}"
    SCENARIOS[own] = make
    return own


def stock_moved(own: str, before: int, after: int) -> float:
    """Share of the slots whose goods are others on day `after` than on day `before`."""
    layout = find_scenario(own).layout
    slots = [Slot(*place) for place in product(range(layout.rows), range(layout.bays), range(layout.levels))]
    moved = sum(
        last_restock_day(layout, SEED, after, slot) != last_restock_day(layout, SEED, before, slot) for slot in slots
    )
    return moved / len(slots)


def fetched(folder: Path, cache: Path) -> dict[str, int]:
    """Bytes that a robot with this cache fetches until it has the current version: all, of the manifest, of tiles."""
    told: list[tuple[str, str, int]] = []
    hub = MemoryHub()
    with MapStore.open(folder) as store, MemoryBus(hub) as bus, MemoryBus(hub) as robot:
        service = BusService(store, Fleet(store), bus, lambda *event: told.append(event))
        link = MapClient(robot, TileCache(cache), SITE, "r1")
        wanted = link.wanted()
        manifest = link.fetch(wanted)
        link.activate(manifest, wanted)
        received = link.received_bytes
        # The manifest comes first, by a patch or whole; what follows are tiles. Nothing comes where nothing was published.
        first = next((size for what, result, size in told if what in {"manifest", "patch"} and result == "ok"), 0)
        refused = sum(what == "patch" and result != "ok" for what, result, _ in told)
        service.close()
    return {"bytes": received, "manifest": first, "tiles": received - first, "without_patch": refused}


def measure(work: Path, scenario: str, frames: str, rate: float) -> list[dict[str, Any]]:
    """One row for each night."""
    own, rows = scenario_of_nights(scenario, rate), []
    settings = MapserverConfig()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        store, inbox = folder / "store", folder / "inbox"
        inbox.mkdir()
        for night in NIGHTS:
            kept = work / f"{own}-{night.run}-day{night.day}.mcap"
            if not kept.exists():
                record_order(
                    Order(own, seed=SEED, day=night.day, robot=night.run), kept.with_suffix(".part"), "mcap", "png"
                )
                kept.with_suffix(".part").rename(kept)
            (inbox / f"{night.run}.mcap").symlink_to(kept)
            begun_s = time.monotonic()
            order = NightRequest(SITE, inbox, store, time.time_ns(), 0.0, frames)
            run_night(order, settings.gate, Console(stderr=True))
            seconds = time.monotonic() - begun_s
            full, delta = fetched(store, folder / f"new-{night.run}"), fetched(store, folder / "cache")
            said = last_report(store, SITE)
            assert said is not None
            session = said["builds"][-1]["sessions"][0]
            row = {
                "night": night.name, "stock_moved": stock_moved(own, NIGHTS[max(len(rows) - 1, 0)].day, night.day),
                "version": said["version"], "full_bytes": full["bytes"], "fetched_bytes": delta["bytes"],
                "share": delta["bytes"] / full["bytes"], "manifest_bytes": delta["manifest"], "tile_bytes": delta["tiles"],
                "full_manifest_bytes": full["manifest"], "seconds": seconds,
            }  # fmt: skip
            rows.append(row | {key: session[key] for key in _SESSION if key in session})
            show(rows[-1:])
    return rows


def show(rows: Sequence[dict[str, Any]]) -> None:
    """The table."""
    print(
        f"{'night':18} {'stock':>6} {'full':>8} {'fetched':>8} {'share':>7} {'manifest':>8} {'tiles':>8} {'kept':>6} moved faded added"
    )
    for row in rows:
        counts = [row.get(f"landmarks_{what}", "-") for what in ("kept", "moved", "faded", "added")]
        print(
            f"{row['night']:18} {100 * row['stock_moved']:5.1f}% {row['full_bytes']:8} {row['fetched_bytes']:8} {100 * row['share']:6.2f}% "
            f"{row['manifest_bytes']:8} {row['tile_bytes']:8} {counts[0]:>6} {counts[1]:>5} {counts[2]:>5} {counts[3]:>5}",
            flush=True,
        )


def main() -> None:
    """Prints the table; writes JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="small-loop", choices=list(SCENARIOS))
    parser.add_argument("--frames", default="::2")
    parser.add_argument("--rate", type=float, default=0.05)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "fleetmap-bench")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    rows = measure(options.work, options.scenario, options.frames, options.rate)
    print()
    show(rows)
    about = {
        "machine": platform.machine(), "cores": os.cpu_count(), "python": platform.python_version(),
        "zstandard": metadata.version("zstandard"), "scenario": options.scenario, "frames": options.frames, "rate": options.rate,
    }  # fmt: skip
    print(json.dumps(about | {"nights": rows}))
    if options.out is not None:
        options.out.write_bytes(msgspec.json.format(msgspec.json.encode(about | {"nights": rows}), indent=2) + b"\n")


if __name__ == "__main__":
    main()
