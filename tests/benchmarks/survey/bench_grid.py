"""The grid of planners against the truth of simulated warehouses, and what a night takes away of moved stock.

    PYTHONPATH=tests python tests/benchmarks/survey/bench_grid.py SCENARIO:SEED ... [--every 6] [--height 1.1] [--picture FILE.png]
    PYTHONPATH=tests python tests/benchmarks/survey/bench_grid.py SCENARIO:SEED --store DIR --site NAME [--version N] [--day N]
    PYTHONPATH=tests python tests/benchmarks/survey/bench_grid.py SCENARIO:SEED --nights --work DIR [--next-day 8] [--frames ::2]

Without --store every so many frames of the scenario's first run are rendered and looked at from their true poses: what dense stereo
and the cells do, without a survey's error. With it the grid of a built version is judged, which must have been built with
--frame-from-ground-truth. With --nights recordings of both days go through `mapserver build`, `publish`, `nightly` and `grid export`, and
a robot fetches both versions. A path is planned by A* between two places of the drive, for a robot of 0.3 m radius.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt

from benchmarks.common.grid_truth import GridFigures, Mask, compare, in_hall, passable, plan, truth_mask
from fleetmap.bus import MemoryBus, MemoryHub
from fleetmap.features.settings import StereoSettings
from fleetmap.mapformat.grid_tile import CELL_M, TILE_CELLS
from fleetmap.messages import WantedVersion
from fleetmap.occupancy_grid import FREE, OCCUPIED, OccupancyGrid, read_grid
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame
from fleetmap.version_grid import FLOOR_M, SLICE_M, Tiles, encode_grid, grid_of, occupancy
from fleetsim.commands import record_order
from fleetsim.recorder import Order, Session, prepare
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from mapserver.fleet.fleet import Fleet
from mapserver.grid.dense_stereo import dense_disparity, floor_distance_m
from mapserver.grid.site_grid import SessionViews, updated
from mapserver.serving.bus_service import BusService
from mapserver.store import MapStore

RADIUS_M = 0.3


def views_from_truth(session: Session, every: int, before: Tiles) -> SessionViews:
    """What the cameras see from where they really are; before: the grid until then."""
    rectifier, seen = Rectifier(session.nominal), []
    shoot_s = look_s = 0.0
    for t in session.frame_times_s[::every]:
        begun_s = time.process_time()
        shot = session.renderer.shoot(t)
        drawn_s = time.process_time()
        frame = rectifier.rectify(CameraFrame(int(t * 1e9), shot.left, shot.right))
        place = session.motion.map_from_body(np.array([t]))[0] @ rectifier.body_from_cam
        seen.append((dense_disparity(frame, rectifier.camera, StereoSettings()), place))
        shoot_s, look_s = shoot_s + drawn_s - begun_s, look_s + time.process_time() - drawn_s
    few = seen[:: max(1, len(seen) // 15)]
    floor_m = floor_distance_m([(disparity[0], place) for disparity, place in few], rectifier.camera)
    assert floor_m is not None
    views, begun_s = SessionViews(before), time.process_time()
    for disparity, place in seen:
        views.add(disparity, rectifier.camera, place, floor_m)
    views.add_path(np.array([place[:3, 3] for _, place in seen]), floor_m)
    cast_s = time.process_time() - begun_s
    print(
        f"  {len(seen)} views, floor {floor_m:.3f} m below the camera; CPU a view: rendering {1e3 * shoot_s / len(seen):.0f} ms, "
        f"stereo {1e3 * look_s / len(seen):.0f} ms, cells {1e3 * cast_s / len(seen):.0f} ms",
        flush=True,
    )
    return views


@dataclass(frozen=True, slots=True)
class Judged:
    """An estimated grid's figures; path: cells of a planned path, of which crossed are occupied in truth (rows, columns)."""

    figures: GridFigures
    path: int
    crossed: int
    truth: Mask


def judge(grid: OccupancyGrid, session: Session, height_m: float) -> Judged:
    """Against the hall on the session's day; prints what it finds."""
    order = session.order
    truth = truth_mask(session.world.layout, order.seed, order.day, height_m)
    figures = compare(grid, truth)
    print("  " + ", ".join(f"{name} {value:.4f}" for name, value in asdict(figures).items()), flush=True)
    cells = in_hall(grid, truth.shape)
    way_m = session.truth.positions_m[:, :2]
    rows, columns = np.nonzero(passable(cells, RADIUS_M))
    ends = []
    for share in (0.12, 0.55):  # in two aisles of the loop
        near = way_m[int(share * len(way_m))] / CELL_M
        closest = int(np.hypot(columns - near[0], rows - near[1]).argmin())
        ends.append((int(rows[closest]), int(columns[closest])))
    path = plan(cells, ends[0], ends[1], RADIUS_M)
    clear_m = distance_transform_edt(~truth)[tuple(np.array(path).T)].min() * CELL_M if path else np.nan
    crossed = sum(bool(truth[place]) for place in path)
    print(
        f"  path from {ends[0]} to {ends[1]} of {len(path)} cells: {crossed} where something stands, clear by {clear_m:.2f} m",
        flush=True,
    )
    return Judged(figures, len(path), crossed, truth)


def judge_night(views: SessionViews, after: Tiles, truths: tuple[Mask, Mask], height_m: float) -> tuple[int, int]:
    """As `judge_moved`, where the second session looked into all that a robot needs; prints how much of the grid changed."""
    before, looked, levels = views.before, np.zeros(truths[0].shape, bool), int(np.ceil((height_m - FLOOR_M) / SLICE_M))
    for (x, y), (hits, passes, *_) in views.tiles.items():
        rows, columns = np.nonzero((hits.astype(int) + passes >= 2)[..., :levels].all(axis=-1))
        rows, columns = rows + y * TILE_CELLS, columns + x * TILE_CELLS
        inside = (rows >= 0) & (columns >= 0) & (rows < looked.shape[0]) & (columns < looked.shape[1])
        looked[rows[inside], columns[inside]] = True
    moved = judge_moved((occupancy(before, height_m), occupancy(after, height_m)), truths, looked)
    sizes = [len(blob) for tiles in (before, after) for blob in encode_grid(tiles)]
    none = np.zeros((TILE_CELLS, TILE_CELLS, 4), np.uint8)
    pairs = [(before.get(place, none), cells) for place, cells in after.items()]
    changed = sum(int((old[..., :2] != new[..., :2]).any(axis=-1).sum()) for old, new in pairs)
    known_cells = sum(int(cells[..., :2].any(axis=-1).sum()) for cells in after.values())
    print(f"  {changed / known_cells:.1%} of the known cells changed; grid of {sum(sizes) // 2} bytes", flush=True)
    return moved


def judge_moved(
    grids: tuple[OccupancyGrid, OccupancyGrid], truths: tuple[Mask, Mask], looked: Mask | None = None
) -> tuple[int, int]:
    """Occupied cells whose stock was moved, one cell and more from what stands there now, and how many are occupied still."""
    first, second = (in_hall(grid, truths[0].shape) for grid in grids)
    around = np.ones((3, 3), bool)
    moved = (first == OCCUPIED) & binary_dilation(truths[0], around) & ~binary_dilation(truths[1], around)
    every = int(moved.sum())
    moved &= True if looked is None else looked
    fresh = truths[1] & ~binary_dilation(truths[0], around) & binary_dilation(second == OCCUPIED, around)
    count, left = int(moved.sum()), int((moved & (second == OCCUPIED)).sum())
    print(
        f"  night: of {count} occupied cells whose stock is gone ({every} with those that were not looked into) {left} are still "
        f"occupied, {int((moved & (second == FREE)).sum())} are free; {int(fresh.sum())} cells of new stock found",
        flush=True,
    )
    return count, left


def exported_nights(orders: tuple[Order, Order], work: Path, frames: str, height_m: float) -> list[OccupancyGrid]:
    """The grids that `mapserver grid export` writes after a build of the first order and a night with the second."""
    store, inbox, config = work / "store", work / "inbox", work / "mapserver.toml"
    config.write_text("[survey]\noccupancy_grid = true\n")
    inbox.mkdir(exist_ok=True)
    where, grids = ("--site", "hall", "--store", str(store)), []
    given = ("--config", str(config), "--frames", frames)
    for number, order in enumerate(orders):
        recording = work / f"{order.scenario}-{order.seed}-{order.day}.mcap"
        if not recording.exists():
            record_order(order, recording.with_suffix(".part"), "mcap")
            recording.with_suffix(".part").rename(recording)
        if number == 0:
            mapserver("build", str(recording), *where, *given, "--frame-from-ground-truth")
            mapserver("publish", *where)
        else:
            (inbox / recording.name).symlink_to(recording)
            if not mapserver("nightly", *where, *given, "--inbox", str(inbox), "--settle-s", "0", may_fail=True):
                mapserver(
                    "publish", *where, "--force", "--reason", "the bench moves more stock than the gate lets pass"
                )
        path = work / f"night-{number}.yaml"
        mapserver("grid", "export", *where, str(path), "--robot-height", str(height_m))
        grids.append(read_grid(path))
    for takes_grids in (False, True):
        print(
            f"  a robot fetches {robot_bytes(store, work, takes_grids=takes_grids)} bytes, {takes_grids=}", flush=True
        )
    return grids


def robot_bytes(folder: Path, work: Path, *, takes_grids: bool) -> list[int]:
    """What a robot with an empty cache fetches for version 1, and then for version 2."""
    hub, received = MemoryHub(), [0]
    with (
        tempfile.TemporaryDirectory(dir=work) as cache,
        MapStore.open(folder) as store,
        MemoryBus(hub) as bus,
        MemoryBus(hub) as own,
    ):
        service = BusService(store, Fleet(store), bus, lambda *_: None)
        client = MapClient(own, TileCache(Path(cache)), "hall", "r1")
        client.takes_grids = takes_grids
        for version in (1, 2):
            sha256 = store.version("hall", version).manifest_sha256
            client.bring(WantedVersion(site="hall", version=version, manifest_sha256=sha256))
            received.append(client.received_bytes)
        service.close()
    return [after - before for before, after in pairwise(received)]


def mapserver(*words: str, may_fail: bool = False) -> bool:
    """Runs the command, in a process of its own; whether it succeeded, which it must unless it may fail."""
    begun_s = time.monotonic()
    done = subprocess.run([sys.executable, "-m", "mapserver.cli", *words], capture_output=True, text=True, check=False)
    print(f"  mapserver {words[0]}: {time.monotonic() - begun_s:.0f} s; {done.stdout.strip()}", flush=True)
    assert may_fail or done.returncode == 0, done.stderr
    print(f"    {done.stderr.strip()[-300:]}" if done.returncode else "", flush=True)
    return done.returncode == 0


def draw(path: Path, grid: OccupancyGrid, truth: Mask) -> None:
    """The grid, and under it the truth, as map_server shades."""
    cells = in_hall(grid, truth.shape)
    shown = np.where(cells == FREE, 254, np.where(cells == OCCUPIED, 0, 205))
    both = [shown[::-1], np.full((6, truth.shape[1]), 120), np.where(truth, 0, 254)[::-1]]
    cv2.imwrite(str(path), np.concatenate(both).astype(np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 9])


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("halls", nargs="+", metavar="SCENARIO:SEED")
    parser.add_argument("--every", type=int, default=6)
    parser.add_argument("--height", type=float, default=1.1)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--store", type=Path)
    parser.add_argument("--site", default="hall")
    parser.add_argument("--version", type=int)
    parser.add_argument("--day", type=int, default=0)
    parser.add_argument("--next-day", type=int, default=1, help="day of the second session's stock")
    parser.add_argument("--nights", action="store_true", help="through the commands of the map server")
    parser.add_argument("--frames", default="::2", help="of the recordings")
    parser.add_argument("--work", type=Path, help="empty folder for recordings and store")
    options = parser.parse_args()
    for hall in options.halls:
        scenario, _, seed = hall.partition(":")
        print(f"{hall}, robots of {options.height} m", flush=True)
        session = prepare(Order(scenario, seed=int(seed), day=options.day))
        night = prepare(Order(scenario, seed=int(seed), day=options.next_day))
        if options.nights:
            orders = session.order, night.order
            grids = exported_nights(orders, options.work, options.frames, options.height)
            judged_nights = [
                judge(grid, one, options.height) for grid, one in zip(grids, (session, night), strict=True)
            ]
            judge_moved((grids[0], grids[1]), (judged_nights[0].truth, judged_nights[1].truth))
            continue
        if options.store is not None:
            with MapStore.open(options.store, read_only=True) as maps:
                tiles = grid_of(maps.manifest(options.site, options.version or 1), maps.blob)
        else:
            tiles = updated(views_from_truth(session, options.every, {}))
        grid = occupancy(tiles, options.height)
        judged = judge(grid, session, options.height)
        if options.picture is not None:
            draw(options.picture, grid, judged.truth)
        if options.store is None:
            views = views_from_truth(night, options.every, tiles)
            after = updated(views)
            judged_after = judge(occupancy(after, options.height), night, options.height)
            judge_night(views, after, (judged.truth, judged_after.truth), options.height)


if __name__ == "__main__":
    main()
