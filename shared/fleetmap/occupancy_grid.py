"""Occupancy grids of planners: a map_server YAML file and its image. Source: nav2_map_server's documented file format."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from fleetmap.errors import disk_errors
from fleetmap.geometry import Array, so3_log

OCCUPIED, FREE, UNKNOWN = 100, 0, -1
# Thresholds of map_saver, except for free_thresh: with its 0.25 the grey of unknown cells is read as free.
_SHADES = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}
_OCCUPIED_THRESH, _FREE_THRESH = 0.65, 0.196


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """cells (H, W) int8: 0 free to 100 occupied, -1 unknown; row 0 has the lowest y. map_from_grid (4, 4): of the corner of cell (0, 0)."""

    cells: NDArray[np.int8]
    resolution_m: float
    map_from_grid: Array


def write_grid(path: Path, grid: OccupancyGrid) -> None:
    """Write NAME.yaml and NAME.pgm beside it, as of `map_server_files`. Raises StoreError if the disk refuses."""
    text, image = map_server_files(grid, path.with_suffix(".pgm").name)
    with disk_errors(f"{path} cannot be written", "check the folder, its space and rights"):
        path.with_suffix(".pgm").write_bytes(image)
        path.write_bytes(text)


def map_server_files(grid: OccupancyGrid, image_name: str) -> tuple[bytes, bytes]:
    """A map_server YAML file and its PGM image; mode trinary if all cells are free, occupied or unknown, else raw."""
    values, trinary = grid.cells[::-1], bool(np.isin(grid.cells, list(_SHADES)).all())
    shades = np.where(values < 0, 255, values).astype(np.uint8)
    if trinary:
        shades = np.select([values == value for value in _SHADES], list(_SHADES.values())).astype(np.uint8)
    height, width = shades.shape
    x, y, _ = grid.map_from_grid[:3, 3].tolist()
    entries = {
        "image": image_name,
        "mode": "trinary" if trinary else "raw",
        "resolution": grid.resolution_m,
        "origin": [x, y, float(so3_log(grid.map_from_grid[:3, :3])[2])],
        "negate": 0,
        "occupied_thresh": _OCCUPIED_THRESH,
        "free_thresh": _FREE_THRESH,
    }
    return yaml.safe_dump(entries, sort_keys=False).encode(), b"P5\n%d %d\n255\n" % (width, height) + shades.tobytes()
