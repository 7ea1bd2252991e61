"""The grid of a version: encoding (an index, and one blob per tile; docs/map_format.md), and occupancy for a robot's height.

A cell is a square column of the map: ground below FLOOR_M, then SLICES voxels of SLICE_M each.
"""

from collections.abc import Callable, Mapping
from typing import Annotated, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.encoding import decode_json, to_json
from fleetmap.errors import MapFormatError, NewerFormatError, StateError, UsageError
from fleetmap.geometry import se3
from fleetmap.mapformat.grid_tile import (
    CELL_M,
    GRID_FORMAT,
    TILE_CELLS,
    TILE_SIZE_M,
    decode_grid_tile,
    encode_grid_tile,
)
from fleetmap.mapformat.manifest import Manifest, Positive, Sha256, TileEntry, manifest_entry
from fleetmap.mapformat.names import sha256_hex
from fleetmap.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

FLOOR_M, SLICE_M, SLICES = 0.10, 0.25, 8  # the ground's unevenness, and the noise of its points
TOP_M = FLOOR_M + SLICES * SLICE_M
HEIGHT_STEP_M, LOWEST_M = 0.01, -0.16  # codes of heights: 0 unknown, then steps from LOWEST_M
Counts = NDArray[np.uint8]
T = TypeVar("T", bound=msgspec.Struct)
Tiles = dict[tuple[int, int], Counts]
"""By (x, y) of the tile: (N, N, 4) bits of occupied voxels, bits of free ones, codes of the lowest and the highest surface."""

GRID_KEY = "grid"
"""Key in `report` of a manifest, where older readers ignore it; it names the index."""

_MAX_TILES, _MAX_CELLS = 1 << 16, 1 << 25


class GridIndex(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the tiles' numbers (see grid.cpp of the core), and the tiles by place and address; landmarks are 0."""

    format_version: Positive = GRID_FORMAT
    tile_size_m: float = TILE_SIZE_M
    cell_m: float = CELL_M
    floor_m: float = FLOOR_M
    slice_m: float = SLICE_M
    slices: int = SLICES
    height_step_m: float = HEIGHT_STEP_M
    lowest_m: float = LOWEST_M
    tiles: Annotated[tuple[TileEntry, ...], msgspec.Meta(max_length=_MAX_TILES)] = ()


class GridReport(msgspec.Struct, frozen=True, kw_only=True):
    """Grid entry in a build's report. sha256: of the index, None without a grid; bytes: of it and its tiles; tiles: number of tiles.

    without: by recording, the reason why it adds nothing.
    """

    sha256: Sha256 | None = None
    bytes: int = 0
    tiles: int = 0
    without: dict[str, str] = {}


def encode_grid(tiles: Mapping[tuple[int, int], Counts]) -> list[bytes]:
    """Encode the index and each tile; nothing for a grid without tiles. Equal grids give equal bytes."""
    blobs, entries = [], []
    for (x, y), cells in sorted(tiles.items()):
        data = encode_grid_tile((x, y), cells)
        entries.append(TileEntry(x=x, y=y, sha256=sha256_hex(data), bytes=len(data), landmarks=0))
        blobs.append(data)
    return [to_json(GridIndex(tiles=tuple(entries)), order="deterministic"), *blobs] if blobs else []


def grid_report(blobs: list[bytes], without: dict[str, str]) -> GridReport:
    """Report of the blobs that `encode_grid` returned."""
    sha256 = sha256_hex(blobs[0]) if blobs else None
    return GridReport(sha256=sha256, bytes=sum(map(len, blobs)), tiles=max(0, len(blobs) - 1), without=without)


def grid_of(manifest: Manifest, blob: Callable[[str], bytes]) -> Tiles:
    """Return the grid of a version; blob: the verified bytes of an address.

    Raises StateError, with the reason, for a version without a grid, and MapFormatError or NewerFormatError for invalid bytes.
    """
    where = f"version {manifest.version} of site {manifest.site}"
    report = report_of(manifest)
    if report is None:
        raise StateError(f"{where} has no grid: set `occupancy_grid = true` in [survey] and build the next version")
    if report.sha256 is None:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in report.without.items())
        raise StateError(f"{where} has no grid: {reasons or 'no recording showed anything near'}")
    tiles = {}
    for entry in read_index(blob(report.sha256)).tiles:
        place, cells = decode_grid_tile(blob(entry.sha256))
        if place != (entry.x, entry.y):
            fault = f"grid tile {place} stands in the place of {entry.x}, {entry.y}"
            raise MapFormatError(f"{where}: {fault}; it is damaged")
        tiles[place] = cells
    return tiles


def grid_index(manifest: Manifest) -> str | None:
    """Address of the index of a version's grid, None if absent; errors as of `report_of`."""
    report = report_of(manifest)
    return None if report is None else report.sha256


def grid_blobs(manifest: Manifest, blob: Callable[[str, int], bytes]) -> list[TileEntry]:
    """The tiles of a version's grid, none if absent. blob: the verified bytes of an address, up to a given size.

    Raises MapFormatError if they exceed the size in the manifest; errors as of `read_index`.
    """
    report = report_of(manifest)
    if report is None or report.sha256 is None:
        return []
    index = read_index(blob(report.sha256, report.bytes))
    if sum(entry.bytes for entry in index.tiles) > report.bytes:
        raise MapFormatError(f"grid of version {manifest.version}: more than the {report.bytes} bytes of its manifest")
    return list(index.tiles)


def known_grid(manifest: Manifest, blob: Callable[[str], bytes]) -> Tiles:
    """As `grid_of`; no tiles for a version without a grid."""
    return {} if grid_index(manifest) is None else grid_of(manifest, blob)


def report_of(manifest: Manifest) -> GridReport | None:
    """The build's report of its grid, None if the build had to make none. MapFormatError for invalid content."""
    return manifest_entry(manifest, "report", GRID_KEY, GridReport)


def read_index(data: bytes) -> GridIndex:
    """Decode the index in `data`; errors as of `decode_index`."""
    return decode_index(data, GridIndex, "a grid", tiles=())


def decode_index(data: bytes, kind: type[T], what: str, **own: object) -> T:
    """Decode an index of tiles; MapFormatError for anything else, NewerFormatError unless all but its `own` values are the defaults."""
    index = decode_json(data, kind, f"index of {what}: {{}}; it is damaged or of another program")
    if msgspec.structs.replace(index, **own) != kind():
        number = getattr(index, "format_version", None)
        raise NewerFormatError(f"index of {what} of format {number}: made by another fleetmap; update this one")
    return index


def occupancy(tiles: Mapping[tuple[int, int], Counts], robot_height_m: float) -> OccupancyGrid:
    """Occupancy in `map` for a robot of this height, cropped to known cells.

    A cell is occupied if anything is between the ground and the robot's top, free if all of that was seen empty, else unknown.
    Raises UsageError for a height outside the grid, and for a grid with more cells than a planner's map may have.
    """
    levels = np.ceil((robot_height_m - FLOOR_M) / SLICE_M - 1e-9)
    if not 1 <= levels <= SLICES:
        covered = f"the grid covers heights above {FLOOR_M} m and up to {TOP_M:.2f} m"
        raise UsageError(f"a robot of {robot_height_m} m; {covered}")
    below = np.uint8((1 << int(levels)) - 1)

    def states(cells: Counts) -> NDArray[np.int8]:
        is_free = (cells[..., 1] & below) == below
        return np.where(cells[..., 0] & below, OCCUPIED, np.where(is_free, FREE, UNKNOWN)).astype(np.int8)

    return whole_grid({place: states(cells) for place, cells in tiles.items()}, UNKNOWN)


def whole_grid(parts: Mapping[tuple[int, int], NDArray[np.int8]], empty: int, *, is_cut: bool = True) -> OccupancyGrid:
    """Join tiles (N, N) in `map`; empty: value of missing tiles, cropped at the edges. UsageError for too many cells."""
    places = np.array(list(parts))
    first, last = places.min(axis=0), places.max(axis=0) + 1
    columns, rows = ((last - first) * TILE_CELLS).tolist()
    if columns * rows > _MAX_CELLS:
        raise UsageError(f"the grid has {columns} x {rows} cells; planners' maps have at most {_MAX_CELLS}")
    cells = np.full((rows, columns), empty, np.int8)
    for (x, y), part in parts.items():
        row, column = (y - first[1]) * TILE_CELLS, (x - first[0]) * TILE_CELLS
        cells[row : row + TILE_CELLS, column : column + TILE_CELLS] = part
    low = np.zeros(2, np.int64)
    if is_cut and (cells != empty).any():
        seen = np.argwhere(cells != empty)
        low, high = seen.min(axis=0), seen.max(axis=0) + 1
        cells = np.ascontiguousarray(cells[low[0] : high[0], low[1] : high[1]])
    corner = first * TILE_SIZE_M + low[::-1] * CELL_M
    return OccupancyGrid(cells, CELL_M, se3(np.eye(3), np.array([*corner, 0.0])))
