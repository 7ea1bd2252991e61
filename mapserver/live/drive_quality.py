"""Directions from which a survey under way has seen nothing, and how much it covers."""

from collections import Counter
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array
from fleetmap.live_survey import COVERAGE_CELL_M, LiveMissing
from mapserver.quality.directions import tile_directions

_FEW = 10  # landmarks below which a cell is not covered
_MOST = 64


class _Cell(NamedTuple):
    """Keyframes of a square, as `tile_directions` takes a tile."""

    tile_x: int
    tile_y: int
    map_from_cam: Array


def missing_directions(map_from_cam: Array) -> list[LiveMissing]:
    """Headings that nothing looks at, where keyframes (K, 4, 4) passed the other way; by square, as `quality.directions` has it."""
    cells_of = np.floor(map_from_cam[:, :2, 3] / COVERAGE_CELL_M).astype(np.int64)
    cells = [
        _Cell(int(x), int(y), map_from_cam[(cells_of == (x, y)).all(axis=1)])
        for x, y in np.unique(cells_of, axis=0).tolist()
    ]
    middles = {(cell.tile_x, cell.tile_y): cell.map_from_cam[:, :2, 3].mean(axis=0).tolist() for cell in cells}
    found = []
    for directions in tile_directions(cells):
        x_m, y_m = middles[directions.tile]
        for heading, count in directions.missing.items():
            found.append(LiveMissing(x_m=x_m, y_m=y_m, heading=heading, places=count))
    return sorted(found, key=lambda each: -each.places)[:_MOST]


def covered_cells(points_map: Array, most: int) -> Array:
    """(T, 3) x and y of squares that hold landmarks (N, 3), and how many; those with most of them."""
    counts = Counter(map(tuple, np.floor(points_map[:, :2] / COVERAGE_CELL_M).astype(np.int64).tolist()))
    rows = [(x, y, count) for (x, y), count in counts.most_common(most) if count >= _FEW]
    return np.array(sorted(rows), np.float64).reshape(-1, 3)
