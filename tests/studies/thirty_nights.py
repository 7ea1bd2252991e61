"""Thirty nights of one site: what updates do to a map, and to the robots of the next day. Every night is rendered."""

import os
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from benchmarks.common.recorded_runs import SITE, mapped, played, rendered
from fleetmap.errors import FleetmapError
from fleetmap.geometry import Array, align_points, transform_points
from fleetsim.motion import Route
from fleetsim.recorder import Order
from fleetsim.scenarios import Run, Scenario
from fleetsim.scene.layout import Layout
from fleetsim.sensors import Fault
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from locclient.replay import run_metrics
from mapserver import open_map
from mapserver.config import MapserverConfig
from mapserver.fleet.fleet import Fleet
from mapserver.plugins.nightly_builds.night import NightRequest, last_report, run_night
from mapserver.serving.bus_service import BusService
from mapserver.store import MapStore
from studies.study import PAGES, Column, Row, publish, results, study, table
from support.fleet.memory_bus import MemoryBus, MemoryHub

SEED, OTHER_SEED, NIGHTS = 547, 787, 30  # of the site, of the building that the foreign recording is from
WORK = PAGES.parents[1] / "out" / "thirty_nights"
SCENARIO = "thirty-nights"
BEFORE = Layout(aisles=6, bays=3, restock_per_day=0.06)
AFTER = Layout(aisles=6, bays=3, restock_per_day=0.06, moved_rows=((1, -0.4),))
MOVED, CLOSED, DARK, FOREIGN = 9, range(12, 16), 21, 25
THIRDS = ((0, 1), (2, 3), (4, 5))
_FLOOR_M, _RACK_M = 0.12, 0.2


def loop(layout: Layout, first: int, last: int) -> Route:
    """Up one aisle, down another, and on along the first again."""
    (y0, y1), left, right = (layout.aisle_y_m(first), layout.aisle_y_m(last)), 2.7, layout.length_m - 2.7
    return Route(((left, y0), (right, y0), (right, y1), (left, y1), (left, y0), (left + 6.0, y0)))


def snake(layout: Layout) -> Route:
    """Every aisle in turn, and back along the ends into the first one."""
    ends, points = (2.7, layout.length_m - 2.7), list[tuple[float, float]]()
    for aisle in range(layout.aisles):
        points += [(x, layout.aisle_y_m(aisle)) for x in (ends if aisle % 2 == 0 else ends[::-1])]
    return Route((*points, points[0], (ends[0] + 6.0, points[0][1])))


def tour(layout: Layout) -> Route:
    """An aisle of each third, each in the direction that surveys drive it: even ones, odd ones back, even ones."""
    y, left, right = [layout.aisle_y_m(aisle) for aisle in (0, 3, 4)], 2.7, layout.length_m - 2.7
    return Route(((left, y[0]), (right, y[0]), (right, y[1]), (left, y[1]), (left, y[2]), (right, y[2])))


def scenario(night: int) -> Scenario:
    """The site on the day after a night, with the survey of that night and the robot of the day."""
    layout = BEFORE if night < MOVED else AFTER
    surveyed = (3, 4) if night in CLOSED and night % 3 == 1 else THIRDS[night % 3]  # an aisle is closed for four nights
    route = snake(layout) if night == 0 else loop(layout, *surveyed)
    dark = (Fault("camera-dark", 4.0, 1e6),) if night == DARK else ()
    survey = Run("surveyor", (route,), rate_hz=7.5, is_sharp=True, faults=dark)
    return Scenario("", layout, {f"survey-{night}": survey, f"robot-{night}": Run("tote", (tour(layout),), 10.0)})


def record(night: int, run: str, seed: int = SEED) -> Path:
    """Path of a recording in the inbox, or beside it for robots. Light turns with the seasons."""
    folder = WORK if run == "robot" else WORK / "inbox"
    path, light = folder / f"{run}-{night}-{seed}.mcap", "evening" if 10 <= night < 20 else "day"
    day = night if run != "robot" else night + 1
    return rendered(path, Order(SCENARIO, seed, day, light, f"{run}-{night}"), scenario(night))


def night(number: int) -> Row:
    """A night's drive, the update, what a robot fetches, and its drive on the next day."""
    store = WORK / "store"
    if number == 0:
        shutil.rmtree(WORK, ignore_errors=True)
        (WORK / "inbox").mkdir(parents=True)
        mapped(store, record(0, "survey"), WORK / "survey.json")
        said = {"state": "done", "version": 1, "recordings": [], "message": ""}
    else:
        if not store.exists():
            raise FileNotFoundError(f"{store} holds the nights before; without it begin anew: FRESH=1")
        record(number, "survey")
        if number == FOREIGN:
            record(number, "survey", OTHER_SEED)
        said = updated(number)
    new = fetched(store, WORK / "nothing")
    shutil.rmtree(WORK / "nothing")
    held = [r for r in said["recordings"] if r["fate"] != "done"]
    row = {
        "night": number, "version": said["version"], "state": said["state"], "message": said["message"],
        "held": [f"{r['name']}: {r['reason']}" for r in held], "map_bytes": new,
        "fetched_bytes": fetched(store, WORK / "cache"),
    }  # fmt: skip
    return row | landmarks() | robot(number)


def fetched(folder: Path, cache: Path) -> int:
    """Bytes that a robot with this cache fetches over the bus until it has the current version."""
    hub = MemoryHub()
    with MapStore.open(folder) as store, MemoryBus(hub) as bus, MemoryBus(hub) as robot:
        service = BusService(store, Fleet(store), bus, lambda *_: None)
        link = MapClient(robot, TileCache(cache), SITE, "r1")
        link.bring(link.wanted())
        service.close()
        return link.chunks.received_bytes


def updated(number: int) -> Row:
    """The night's own report, also of one that failed."""
    store = WORK / "store"
    request = NightRequest(SITE, WORK / "inbox", store, now_ns=time.time_ns(), settle_s=0.0)
    try:
        run_night(request, MapserverConfig().gate, Console(stderr=True))
    except FleetmapError as error:
        print(f"night {number}: {error}")
    return last_report(store, SITE)


def landmarks() -> Row:
    """Those of the first map that are left, by what they sit on, and how far they have gone together."""
    arrays = open_map(WORK / "store", SITE)
    kept = WORK / "first.npz"
    if not kept.exists():
        np.savez(kept, ids=arrays.landmark_ids, points=arrays.points_map)
    first = np.load(kept)
    _, then, now = np.intersect1d(first["ids"], arrays.landmark_ids, return_indices=True)
    before, after = first["points"][then], arrays.points_map[now]
    moved, _ = align_points(after, before)
    corners = np.array([[x, y, 0.5] for x in (0.0, BEFORE.length_m) for y in (0.0, BEFORE.width_m)])
    return {
        "landmarks": len(arrays.landmark_ids),
        "left": {name: int(sits.sum()) for name, sits in sits_on(before).items()},
        "frame_moved_mm": 1e3 * float(np.linalg.norm(transform_points(moved, corners) - corners, axis=1).max()),
    }


def sits_on(points_map: Array) -> dict[str, Array]:
    """(N,) masks: the floor, racks with what stands in them, the building."""
    x, y, z = points_map.T
    floor = z < _FLOOR_M
    racks = np.zeros(len(x), bool)
    for x0, y0, x1, y1 in BEFORE.solid_rectangles()[: BEFORE.rows]:
        racks |= (x > x0 - _RACK_M) & (x < x1 + _RACK_M) & (y > y0 - _RACK_M) & (y < y1 + _RACK_M)
    racks &= (z < BEFORE.rack_top_m) & ~floor
    return {"floor": floor, "racks": racks, "building": ~floor & ~racks}


def robot(number: int) -> Row:
    """A robot that wakes in the site on the next day and drives through all thirds of it."""
    path = record(number, "robot")
    frames = played(path, WORK / "store").frames
    path.unlink()
    errors = run_metrics.error_m(frames)
    return {
        "localised_share": run_metrics.localised_share_of_all(frames),
        "median_mm": None if errors is None else 1e3 * errors["median"],
        "p95_mm": None if errors is None else 1e3 * errors["p95"],
        "failures": run_metrics.position_failures(frames),
        "silent": run_metrics.silent_failures(frames),
    }


CASES: dict[str, Callable[[], Row]] = {f"night {number}": partial(night, number) for number in range(NIGHTS + 1)}
COLUMNS = [
    Column("night", "night"), Column("version", "version"), Column("map_kb", "map, kB", "{:.0f}"),
    Column("fetched_kb", "fetched, kB", "{:.1f}"), Column("frame_moved_mm", "frame moved, mm", "{:.1f}"),
    Column("share", "localised", "{:.1%}"), Column("median_mm", "median, mm", "{:.1f}"), Column("p95_mm", "p95, mm", "{:.1f}"),
    Column("failures", "failures"), Column("silent", "silent"), Column("said", "the night said"),
]  # fmt: skip


def shown(row: Row) -> Row:
    """With its figures in the table's units."""
    said = "; ".join(row["held"]) or ("" if row["state"] == "done" else row["message"])
    return row | {
        "map_kb": row["map_bytes"] / 1e3, "fetched_kb": row["fetched_bytes"] / 1e3, "share": row["localised_share"],
        "said": said.replace("|", "/")[:160],
    }  # fmt: skip


def half_lives(rows: list[Row]) -> list[Row]:
    """Of the first map's landmarks, in nights, by an exponential through the shares that are left."""
    out = []
    for name in ("floor", "racks", "building"):
        left = np.array([row["left"][name] for row in rows], float)
        nights = np.array([row["night"] for row in rows], float)[left > 0]
        share = left[left > 0] / left[0]
        rate = -float((nights @ np.log(share)) / (nights @ nights)) if len(rows) > 1 else 0.0
        half = f"{np.log(2) / rate:.0f}" if rate > 1e-4 else "longer than can be told"
        out.append({"sits": name, "first": int(left[0]), "last": int(left[-1]), "half": half})
    return out


def draw(rows: list[Row]) -> Figure:
    """The map's size, what is left of the first one, and the next day's robots."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    size, left, day = figure.subplots(1, 3)
    nights = [row["night"] for row in rows]
    size.plot(nights, [row["map_bytes"] / 1e3 for row in rows], label="map")
    size.plot(nights, [row["fetched_bytes"] / 1e3 for row in rows], label="fetched by a robot")
    size.set_ylabel("kB")
    for name in ("floor", "racks", "building"):
        left.plot(nights, [row["left"][name] / max(rows[0]["left"][name], 1) for row in rows], label=name)
    left.set_ylabel("of the first map's landmarks")
    day.plot(nights, [row["median_mm"] for row in rows], label="median error")
    day.plot(nights, [row["p95_mm"] for row in rows], label="p95")
    day.plot(nights, [row["frame_moved_mm"] for row in rows], label="frame moved")
    day.set_ylabel("mm")
    for axes in (size, left, day):
        axes.set_xlabel("night")
        axes.set_ylim(0)
        axes.legend(frameon=False, fontsize=8)
    return figure


@study
def main() -> None:
    """Rows, tables and picture of docs/studies/thirty_nights.md."""
    if os.environ.get("FRESH"):
        shutil.rmtree(WORK, ignore_errors=True)
    rows = results("thirty_nights", CASES, [SEED, OTHER_SEED])
    sits = [
        Column("sits", "landmarks on"),
        Column("first", "first map"),
        Column("last", "left"),
        Column("half", "half-life, nights"),
    ]
    publish("thirty_nights", [table([shown(row) for row in rows], COLUMNS), table(half_lives(rows), sits)], draw(rows))
