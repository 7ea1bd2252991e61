"""The grid of planners against the truth of simulated warehouses, and what a night takes away of moved stock.

    PYTHONPATH=tests python tests/benchmarks/survey/bench_grid.py SCENARIO:SEED ... [--every 6] [--height 1.1] [--next-day 8]
        [--picture FILE.png] [--out FILE.json]

Every so many frames of the scenario's first run are rendered and looked at from their true poses: what dense stereo and the cells do,
without a survey's error. Then those of another day. A path is planned by A* between two places of the drive, for a robot of 0.3 m radius.
"""

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import binary_dilation

from benchmarks.common.grid_truth import GridFigures, Mask, compare, in_hall, passable, plan, truth_mask
from fleetmap.features.settings import StereoSettings
from fleetmap.mapformat.grid_tile import CELL_M, TILE_CELLS
from fleetmap.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame
from fleetmap.version_grid import FLOOR_M, SLICE_M, Tiles, occupancy
from fleetsim.recorder import Order, Session, prepare
from mapserver.grid.dense_stereo import dense_disparity, floor_distance_m, nearest_around
from mapserver.grid.site_grid import REACH_PX, SessionViews, updated

RADIUS_M = 0.3


def views_from_truth(session: Session, every: int, before: Tiles) -> SessionViews:
    """What the cameras see from where they really are; before: the grid until then."""
    rectifier, seen = Rectifier(session.nominal), []
    for t in session.frame_times_s[::every]:
        shot = session.renderer.shoot(t)
        frame = rectifier.rectify(CameraFrame(int(t * 1e9), shot.left, shot.right))
        place = session.motion.map_from_body(np.array([t]))[0] @ rectifier.body_from_cam
        seen.append((dense_disparity(frame, rectifier.camera, StereoSettings()), place))
    few = seen[:: max(1, len(seen) // 15)]
    floor_m = floor_distance_m([(disparity[0], place) for disparity, place in few], rectifier.camera)
    assert floor_m is not None
    views = SessionViews(before)
    for disparity, place in seen:
        px, sigma_px = disparity
        views.add((px, nearest_around(px, REACH_PX), sigma_px), rectifier.camera, place, floor_m)
    views.add_path(np.array([place[:3, 3] for _, place in seen]), floor_m)
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
    crossed = sum(bool(truth[place]) for place in path)
    print(f"  path of {len(path)} cells: {crossed} where something stands", flush=True)
    return Judged(figures, len(path), crossed, truth)


def judge_night(views: SessionViews, after: Tiles, truths: tuple[Mask, Mask], height_m: float) -> tuple[int, int]:
    """As `judge_moved`, where the second session looked into all that a robot needs."""
    before, looked, levels = views.before, np.zeros(truths[0].shape, bool), int(np.ceil((height_m - FLOOR_M) / SLICE_M))
    for (x, y), (hits, passes, *_) in views.tiles.items():
        rows, columns = np.nonzero((hits.astype(int) + passes >= 2)[..., :levels].all(axis=-1))
        rows, columns = rows + y * TILE_CELLS, columns + x * TILE_CELLS
        inside = (rows >= 0) & (columns >= 0) & (rows < looked.shape[0]) & (columns < looked.shape[1])
        looked[rows[inside], columns[inside]] = True
    return judge_moved((occupancy(before, height_m), occupancy(after, height_m)), truths, looked)


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
    parser.add_argument("--next-day", type=int, default=8, help="day of the second session's stock")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    halls = {}
    for hall in options.halls:
        scenario, _, seed = hall.partition(":")
        print(f"{hall}, robots of {options.height} m", flush=True)
        days = [prepare(Order(scenario, seed=int(seed), day=day)) for day in (0, options.next_day)]
        first = updated(views_from_truth(days[0], options.every, {}))
        views = views_from_truth(days[1], options.every, first)
        second = updated(views)
        grids = [occupancy(tiles, options.height) for tiles in (first, second)]
        judged = [judge(grid, day, options.height) for grid, day in zip(grids, days, strict=True)]
        moved, left = judge_night(views, second, (judged[0].truth, judged[1].truth), options.height)
        if options.picture is not None:
            draw(options.picture, grids[0], judged[0].truth)
        found = [asdict(one.figures) | {"path": one.path, "crossed": one.crossed} for one in judged]
        halls[hall] = {"days": found, "moved": moved, "left": left}
    if options.out is not None:
        options.out.write_text(json.dumps(halls, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
