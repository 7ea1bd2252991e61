"""Areas with a mask, keep-out and speed, for nav2's costmap filters. Pure."""

import numpy as np

from fleetmap.errors import InvalidValueError
from fleetmap.geometry import se3
from fleetmap.mapformat.manifest import Manifest
from fleetmap.version_grid import CELL_M, FREE, OCCUPIED, OccupancyGrid
from mapserver.floor_plan.areas import Areas, MaskKind

_MAX_CELLS = 1 << 25
# A cell is masked if its middle or one of its corners is inside.
_WITHIN = np.array([(0.5, 0.5), (0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)]) * CELL_M


def check_masks_on_map(areas: Areas, manifest: Manifest) -> None:
    """Raise InvalidValueError for a mask that touches no tile of a version."""
    tiles, size_m = {(tile.x, tile.y) for tile in manifest.tiles}, manifest.tile_size_m
    for area in areas.areas:
        if area.mask is None:
            continue
        corners = np.concatenate(area.rings)
        low, high = (np.floor(edge / size_m).astype(int) for edge in (corners.min(axis=0), corners.max(axis=0)))
        if not any((low <= tile).all() and (high >= tile).all() for tile in tiles):
            raise InvalidValueError(
                f"mask {area.name!r} from {corners.min(axis=0).round(1).tolist()} to {corners.max(axis=0).round(1).tolist()} m lies "
                f"outside of version {manifest.version}; write metres of the frame that the file names"
            )


def mask_grid(areas: Areas, kind: MaskKind) -> OccupancyGrid:
    """Return the areas with a mask of one kind as a costmap filter's mask: 100 if forbidden, or percent of the speed; 0 elsewhere.

    Cells are those of the planner grid, cut to the masks; the lowest speed applies if masks overlap. Raises InvalidValueError if the
    site has none of this kind, or if they span more cells than a planner's map may have.
    """
    chosen = [area for area in areas.areas if area.mask is kind]
    if not chosen:
        words = (
            f'give features "mask": "{kind.value}" in their properties, and take them by `mapserver areas import FILE`'
        )
        raise InvalidValueError(f"the site has no area with a {kind.value} mask; {words}")
    corners = np.concatenate([ring for area in chosen for ring in area.rings])
    cells_of_corners = np.floor(corners / CELL_M).astype(int)
    low = cells_of_corners.min(axis=0)
    columns, rows = (cells_of_corners.max(axis=0) + 1 - low).tolist()
    if columns * rows > _MAX_CELLS:
        raise InvalidValueError(
            f"the {kind.value} masks span {columns} x {rows} cells; a planner's map has at most {_MAX_CELLS}"
        )
    cells = np.full((rows, columns), FREE, np.int8)
    across = np.stack([np.arange(columns), np.zeros(columns)], axis=1) * CELL_M + low * CELL_M
    for row in range(rows):
        for area in chosen:
            points = across + np.array([0.0, row * CELL_M])
            inside = np.any([area.holds(points + within) for within in _WITHIN], axis=0)
            value = OCCUPIED if area.percent is None else area.percent
            slower = inside & ((cells[row] == FREE) | (cells[row] > value))
            cells[row, slower] = value
    return OccupancyGrid(cells, CELL_M, se3(np.eye(3), np.array([*(low * CELL_M), 0.0])))
