"""The grid of planners against the truth of simulated warehouses, and what a night takes away of moved stock.

Halls are given as SCENARIO:SEED. Every so many frames of the scenario's first run are rendered and looked at from their true poses: what
dense stereo and the cells do, without a survey's error. Then those of another day. A path is planned by A* between two places of the drive,
for a robot of 0.3 m radius.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from benchmarks.common.grid_truth import GridFigures, Mask, compare, in_hall, passable, plan, truth_mask
from benchmarks.common.recorded_runs import Options, Results, benchmark
from fleetmap.features.settings import StereoSettings
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame
from fleetmap.version_grid import CELL_M, FLOOR_M, OCCUPIED, SLICE_M, TILE_CELLS, OccupancyGrid, Tiles, occupancy
from fleetsim.recorder import Order, Session, prepare
from mapserver.plugins.dense_maps.dense_stereo import dense_disparity, floor_distance_m, nearest_around
from mapserver.plugins.dense_maps.site_grid import REACH_PX, SessionViews, updated

RADIUS_M, HEIGHT_M = 0.3, 1.1
_EVERY, _NEXT_DAY = 6, 8  # frames that are looked at; day of the second session's stock


def views_from_truth(session: Session, before: Tiles) -> SessionViews:
    """What the cameras see from where they really are; before: the grid until then."""
    rectifier, seen = Rectifier(session.nominal), []
    for t in session.frame_times_s[::_EVERY]:
        left, right = session.renderer.shoot(t)
        frame = rectifier.rectify(CameraFrame(int(t * 1e9), left.image, right.image))
        place = session.motion.map_from_body(np.array([t]))[0] @ rectifier.body_from_cam
        seen.append((dense_disparity(frame, rectifier.camera, StereoSettings()), place))
    few = seen[:: max(1, len(seen) // 15)]
    floor_m = floor_distance_m([(disparity[0], place) for disparity, place in few], rectifier.camera)
    views = SessionViews(before)
    for disparity, place in seen:
        px, sigma_px = disparity
        views.add((px, nearest_around(px, REACH_PX), sigma_px), rectifier.camera, place, floor_m)
    views.add_path(np.array([place[:3, 3] for _, place in seen]), floor_m)
    return views


class Judged(NamedTuple):
    """An estimated grid's figures; path: cells of a planned path, of which crossed are occupied in truth (rows, columns)."""

    figures: GridFigures
    path: int
    crossed: int
    truth: Mask


def judge(grid: OccupancyGrid, session: Session) -> Judged:
    """Against the hall on the session's day."""
    order = session.order
    truth = truth_mask(session.world.layout, order.seed, order.day, HEIGHT_M)
    cells = in_hall(grid, truth.shape)
    way_m = session.truth.positions_m[:, :2]
    rows, columns = np.nonzero(passable(cells, RADIUS_M))
    ends = []
    for share in (0.12, 0.55):  # in two aisles of the loop
        near = way_m[int(share * len(way_m))] / CELL_M
        closest = int(np.hypot(columns - near[0], rows - near[1]).argmin())
        ends.append((int(rows[closest]), int(columns[closest])))
    path = plan(cells, ends[0], ends[1], RADIUS_M)
    return Judged(compare(grid, truth), len(path), sum(bool(truth[place]) for place in path), truth)


def judge_night(views: SessionViews, after: Tiles, truths: tuple[Mask, Mask]) -> tuple[int, int]:
    """Occupied cells whose stock was moved, one cell and more from what stands there now, and how many are occupied still.

    Of cells where the second session looked into all that a robot needs.
    """
    looked, levels = np.zeros(truths[0].shape, bool), int(np.ceil((HEIGHT_M - FLOOR_M) / SLICE_M))
    for (x, y), (hits, passes, *_) in views.tiles.items():
        rows, columns = np.nonzero((hits.astype(int) + passes >= 2)[..., :levels].all(axis=-1))
        rows, columns = rows + y * TILE_CELLS, columns + x * TILE_CELLS
        inside = (rows >= 0) & (columns >= 0) & (rows < looked.shape[0]) & (columns < looked.shape[1])
        looked[rows[inside], columns[inside]] = True
    first, second = (in_hall(occupancy(tiles, HEIGHT_M), truths[0].shape) for tiles in (views.before, after))
    around = np.ones((3, 3), bool)
    moved = (first == OCCUPIED) & binary_dilation(truths[0], around) & ~binary_dilation(truths[1], around) & looked
    return int(moved.sum()), int((moved & (second == OCCUPIED)).sum())


@benchmark(several="halls")
def main(options: Options) -> Results:
    halls = {}
    for hall in options.halls:
        scenario, _, seed = hall.partition(":")
        days = [prepare(Order(scenario, seed=int(seed), day=day)) for day in (0, _NEXT_DAY)]
        first = updated(views_from_truth(days[0], {}))
        views = views_from_truth(days[1], first)
        second = updated(views)
        grids = [occupancy(tiles, HEIGHT_M) for tiles in (first, second)]
        judged = [judge(grid, day) for grid, day in zip(grids, days, strict=True)]
        moved, left = judge_night(views, second, (judged[0].truth, judged[1].truth))
        found = [one.figures._asdict() | {"path": one.path, "crossed": one.crossed} for one in judged]
        halls[hall] = {"days": found, "moved": moved, "left": left}
    return halls
