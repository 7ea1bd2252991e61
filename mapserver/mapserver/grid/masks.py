"""Masks that people draw over the map, keep-out and speed, as nav2's costmap filters take them. Pure.

They belong to the site and to no version, in the file format of areas: each feature says in `properties.mask` what it is.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import msgspec
import numpy as np

from fleetmap.errors import UsageError
from fleetmap.geometry import se3
from fleetmap.mapformat import Manifest
from fleetmap.mapformat.building import BuildingFrame
from fleetmap.mapformat.grid_tile import CELL_M
from fleetmap.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from mapserver.floor_plan.areas import Area, read_areas

_MAX_CELLS = 1 << 25
# A cell is masked where its middle or one of its corners is.
_WITHIN = np.array([(0.5, 0.5), (0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)]) * CELL_M


class MaskKind(StrEnum):
    """What a mask does to a robot in it: must not be there, or drives at a share of its speed."""

    KEEP_OUT = "keep-out"
    SPEED = "speed"


class _Properties(msgspec.Struct):
    mask: MaskKind
    percent: Annotated[int, msgspec.Meta(ge=1, le=99)] | None = None


class _Feature(msgspec.Struct):
    properties: _Properties


class _Collection(msgspec.Struct):
    features: list[_Feature]


@dataclass(frozen=True, slots=True)
class Mask:
    """One area with its kind; percent of the robot's largest speed for a speed mask."""

    area: Area
    kind: MaskKind
    percent: int | None


def read_masks(data: bytes, building: BuildingFrame | None) -> list[Mask]:
    """The masks of a file, by name. Raises UsageError as `read_areas`, and for features that do not say what they mask."""
    areas = {area.name: area for area in read_areas(data, building).areas}
    words = 'write "mask": "keep-out", or "mask": "speed" and "percent": 1 to 99, in each feature\'s properties'
    try:
        collection = msgspec.json.decode(data, type=_Collection)
        names = msgspec.json.decode(data)["features"]
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise UsageError(f"masks: {error}; {words}") from error
    masks = []
    for feature, named in zip(collection.features, names, strict=True):
        name, given = named["properties"]["name"].strip(), feature.properties
        if (given.percent is None) == (given.mask is MaskKind.SPEED):
            raise UsageError(f"mask {name!r}: {given.mask.value} with percent {given.percent}; {words}")
        masks.append(Mask(areas[name], given.mask, given.percent))
    return sorted(masks, key=lambda mask: mask.area.name)


def check_on_map(masks: list[Mask], manifest: Manifest) -> None:
    """Raises UsageError for a mask that touches no tile of a version."""
    tiles, size_m = {(tile.x, tile.y) for tile in manifest.tiles}, manifest.tile_size_m
    for mask in masks:
        corners = np.concatenate(mask.area.rings)
        low, high = (np.floor(edge / size_m).astype(int) for edge in (corners.min(axis=0), corners.max(axis=0)))
        if not any((low <= tile).all() and (high >= tile).all() for tile in tiles):
            raise UsageError(
                f"mask {mask.area.name!r} from {corners.min(axis=0).round(1).tolist()} to {corners.max(axis=0).round(1).tolist()} m lies "
                f"outside of version {manifest.version}; write metres of the frame that the file names"
            )


def mask_grid(masks: list[Mask], kind: MaskKind) -> OccupancyGrid:
    """The masks of one kind as a costmap filter's mask: 100 where none may be, or percent of the speed; 0 elsewhere.

    Cells are those of the grid of planners, cut to the masks; the lowest speed counts where masks overlap. Raises UsageError where the
    site has none of this kind, and where they span more cells than a planner's map may have.
    """
    chosen = [mask for mask in masks if mask.kind is kind]
    if not chosen:
        raise UsageError(f"the site has no {kind.value} mask; `mapserver masks import FILE` takes them")
    corners = np.concatenate([ring for mask in chosen for ring in mask.area.rings])
    low, high = (
        np.floor(corners.min(axis=0) / CELL_M).astype(int),
        np.floor(corners.max(axis=0) / CELL_M).astype(int) + 1,
    )
    columns, rows = (high - low).tolist()
    if columns * rows > _MAX_CELLS:
        raise UsageError(
            f"the {kind.value} masks span {columns} x {rows} cells; a planner's map has at most {_MAX_CELLS}"
        )
    cells = np.full((rows, columns), FREE, np.int8)
    across = np.stack([np.arange(columns), np.zeros(columns)], axis=1) * CELL_M + low * CELL_M
    for row in range(rows):
        for mask in chosen:
            points = across + np.array([0.0, row * CELL_M])
            inside = np.any([mask.area.holds(points + within) for within in _WITHIN], axis=0)
            value = OCCUPIED if mask.percent is None else mask.percent
            slower = inside & ((cells[row] == FREE) | (cells[row] > value))
            cells[row, slower] = value
    return OccupancyGrid(cells, CELL_M, se3(np.eye(3), np.array([*(low * CELL_M), 0.0])))
