"""The grid of a version: encoding (an index, and one blob per tile; docs/map_format.md), and occupancy for a robot's height.

A cell is a square column of the map: ground below FLOOR_M, then SLICES voxels of SLICE_M each.
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self, TypeVar

import msgspec
import numpy as np
import yaml
from numpy.typing import NDArray

from fleetmap.encoding import decode_json, to_json
from fleetmap.errors import MapFormatError, NewerFormatError, StateError, UsageError, disk_errors
from fleetmap.geometry import Array, se3, so3_log
from fleetmap.mapformat.container import pack, unpack
from fleetmap.mapformat.manifest import Manifest, Positive, Sha256, TileEntry, manifest_entry
from fleetmap.mapformat.names import sha256_hex

_MAGIC, GRID_FORMAT = b"FMGT", 1
TILE_SIZE_M, CELL_M = 16.0, 0.05  # the size of the map's own tiles
TILE_CELLS = round(TILE_SIZE_M / CELL_M)
_HEAD = struct.Struct("<ii")
_LAYERS, _LEVEL = 4, 12
_TILE_BYTES = _HEAD.size + _LAYERS * TILE_CELLS**2


def decode_grid_tile(data: bytes) -> tuple[tuple[int, int], NDArray[np.uint8]]:
    """Decode place and cells (N, N, 4) of a tile: its place, then four layers of cells, in `container`'s envelope.

    MapFormatError or NewerFormatError for anything else; memory is bounded for any input.
    """
    payload = unpack(_MAGIC, GRID_FORMAT, data, "grid tile", _TILE_BYTES)
    if len(payload) != _TILE_BYTES:
        raise MapFormatError(f"grid tile: {len(payload)} bytes, not {_TILE_BYTES}; the bytes are damaged")
    layers = np.frombuffer(payload, np.uint8, offset=_HEAD.size).reshape(_LAYERS, TILE_CELLS, TILE_CELLS)
    x, y = _HEAD.unpack_from(payload)
    return (x, y), np.ascontiguousarray(np.moveaxis(layers, 0, -1))


OCCUPIED, FREE, UNKNOWN = 100, 0, -1
_SHADES = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """cells (H, W) int8: 0 free to 100 occupied, -1 unknown; row 0 has the lowest y. map_from_grid (4, 4): of the corner of cell (0, 0)."""

    cells: NDArray[np.int8]
    resolution_m: float
    map_from_grid: Array


FLOOR_M, SLICE_M, SLICES = 0.10, 0.25, 8  # the ground's unevenness, and the noise of its points
TOP_M = FLOOR_M + SLICES * SLICE_M
HEIGHT_STEP_M, LOWEST_M = 0.01, -0.16  # codes of heights: 0 unknown, then steps from LOWEST_M
Counts = NDArray[np.uint8]
Blobs = list[bytes]
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


class LayerReport(msgspec.Struct, frozen=True, kw_only=True):
    """Entry in a build's report of what it made beside the map's tiles. sha256: of its index, None without it; bytes: of index and tiles.

    without: by recording, the reason why it adds nothing.
    """

    sha256: Sha256 | None = None
    bytes: int = 0
    without: dict[str, str] = {}

    @classmethod
    def of(cls, blobs: Blobs, without: dict[str, str], **counts: int) -> Self:
        """Report of an index and its tiles, of no blobs for none; counts: of the layer's own fields."""
        sha256 = sha256_hex(blobs[0]) if blobs else None
        return cls(sha256=sha256, bytes=sum(map(len, blobs)), without=without, **counts)


class GridReport(LayerReport, frozen=True, kw_only=True):
    """Entry of the grid, with its number of tiles."""

    tiles: int = 0


def encode_grid(tiles: Mapping[tuple[int, int], Counts]) -> list[bytes]:
    """Encode the index and each tile; nothing for a grid without tiles. Equal grids give equal bytes."""
    blobs, entries = [], []
    for (x, y), cells in sorted(tiles.items()):
        layers = (np.ascontiguousarray(cells[..., layer]).tobytes() for layer in range(_LAYERS))
        data = pack(_MAGIC, GRID_FORMAT, [_HEAD.pack(x, y), *layers], level=_LEVEL)
        entries.append(TileEntry(x=x, y=y, sha256=sha256_hex(data), bytes=len(data), landmarks=0))
        blobs.append(data)
    return [to_json(GridIndex(tiles=tuple(entries)), order="deterministic"), *blobs] if blobs else []


def grid_report(blobs: list[bytes], without: dict[str, str]) -> GridReport:
    """Report of the blobs that `encode_grid` returned."""
    return GridReport.of(blobs, without, tiles=max(0, len(blobs) - 1))


def grid_of(manifest: Manifest, blob: Callable[[str], bytes]) -> Tiles:
    """Return the grid of a version; blob: the verified bytes of an address.

    Raises StateError, with the reason, for a version without a grid, and MapFormatError or NewerFormatError for invalid bytes.
    """
    nothing = "no recording showed anything near"
    tiles, address = {}, layer_address(manifest, report_of(manifest), "grid", "occupancy_grid", nothing)
    for entry in decode_index(blob(address), GridIndex, "a grid", tiles=()).tiles:
        place, cells = decode_grid_tile(blob(entry.sha256))
        if place != (entry.x, entry.y):
            fault = f"grid tile {place} stands in the place of {entry.x}, {entry.y}"
            raise MapFormatError(f"version {manifest.version} of site {manifest.site}: {fault}; it is damaged")
        tiles[place] = cells
    return tiles


def grid_blobs(manifest: Manifest, blob: Callable[[str, int], bytes]) -> dict[str, int]:
    """Addresses and sizes of a version's grid, of its index and its tiles; none if absent. blob: the verified bytes of an address, up to
    a given size.

    Raises MapFormatError if they exceed the size in the manifest; errors as of `decode_index`.
    """
    report = report_of(manifest)
    if report is None or report.sha256 is None:
        return {}
    index = decode_index(blob(report.sha256, report.bytes), GridIndex, "a grid", tiles=())
    if sum(entry.bytes for entry in index.tiles) > report.bytes:
        raise MapFormatError(f"grid of version {manifest.version}: more than the {report.bytes} bytes of its manifest")
    return {report.sha256: report.bytes} | {entry.sha256: entry.bytes for entry in index.tiles}


def known_grid(manifest: Manifest, blob: Callable[[str], bytes]) -> Tiles:
    """As `grid_of`; no tiles for a version without a grid."""
    report = report_of(manifest)
    return {} if report is None or report.sha256 is None else grid_of(manifest, blob)


def report_of(manifest: Manifest) -> GridReport | None:
    """The build's report of its grid, None if the build had to make none. MapFormatError for invalid content."""
    return manifest_entry(manifest, "report", GRID_KEY, GridReport)


def layer_address(manifest: Manifest, report: LayerReport | None, what: str, setting: str, otherwise: str) -> str:
    """Return the SHA-256 of a layer's index; StateError for a version without it, with the setting or the reasons."""
    where = f"version {manifest.version} of site {manifest.site} has no {what}"
    if report is None:
        raise StateError(f"{where}: set `{setting} = true` in [survey] and build the next version")
    if report.sha256 is None:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in report.without.items())
        raise StateError(f"{where}: {reasons or otherwise}")
    return report.sha256


def decode_index(data: bytes, kind: type[T], what: str, **own: object) -> T:
    """Decode a layer's index; MapFormatError for anything else, NewerFormatError unless all but its `own` values are the defaults."""
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


def write_grid(path: Path, grid: OccupancyGrid) -> None:
    """Write NAME.yaml and NAME.pgm beside it, as of `map_server_files`. Raises StoreError if the disk refuses."""
    text, image = map_server_files(grid, path.with_suffix(".pgm").name)
    with disk_errors(f"{path} cannot be written", "check the folder, its space and rights"):
        path.with_suffix(".pgm").write_bytes(image)
        path.write_bytes(text)


def map_server_files(grid: OccupancyGrid, image_name: str) -> tuple[bytes, bytes]:
    """A map_server YAML file and its PGM image; mode trinary if all cells are free, occupied or unknown, else raw.

    Source: nav2_map_server's documented file format.
    """
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
        # Those of map_saver, but for free_thresh: with its 0.25 the grey of unknown cells is read as free.
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    return yaml.safe_dump(entries, sort_keys=False).encode(), b"P5\n%d %d\n255\n" % (width, height) + shades.tobytes()
