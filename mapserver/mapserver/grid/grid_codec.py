"""The grid as bytes: an index, and one blob for each tile of it; docs/map_format.md describes them."""

import struct
from collections.abc import Callable, Mapping
from typing import Annotated

import msgspec
import numpy as np

from fleetmap.errors import MapFormatError, NewerFormatError, StateError
from fleetmap.mapformat import Manifest, pack, sha256_hex, unpack
from fleetmap.mapformat.manifest import Positive, Sha256, TileEntry
from mapserver.grid.grid_kernels import CELL_M, FLOOR_M, HEIGHT_STEP_M, LOWEST_M, SLICE_M, SLICES, Counts
from mapserver.grid.site_grid import TILE_CELLS, Tiles
from mapserver.tiles.tiling import TILE_SIZE_M

GRID_KEY = "grid"
"""In `report` of a manifest, where readers of before pass over it; it names the index."""

GRID_MAGIC, GRID_FORMAT = b"FMGT", 1
_HEAD = struct.Struct("<ii")
_LAYERS, _LEVEL, _MAX_TILES = 4, 12, 1 << 16
_TILE_BYTES = _HEAD.size + _LAYERS * TILE_CELLS**2


class GridIndex(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the tiles' numbers mean (see grid_kernels), and the tiles by place and address; landmarks are 0."""

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
    """In the report of a build. sha256: of the index, None without a grid; bytes: of it and its tiles; tiles: how many.

    without: by recording, why it adds nothing.
    """

    sha256: Sha256 | None = None
    bytes: int = 0
    tiles: int = 0
    without: dict[str, str] = {}


def encode_grid(tiles: Mapping[tuple[int, int], Counts]) -> list[bytes]:
    """The index and then each tile; nothing for a grid without tiles. The same grid gives the same bytes."""
    blobs, entries = [], []
    for (x, y), cells in sorted(tiles.items()):
        columns = [np.ascontiguousarray(cells[..., layer]).tobytes() for layer in range(_LAYERS)]
        data = pack(GRID_MAGIC, GRID_FORMAT, [_HEAD.pack(x, y), *columns], level=_LEVEL)
        entries.append(TileEntry(x=x, y=y, sha256=sha256_hex(data), bytes=len(data), landmarks=0))
        blobs.append(data)
    return [msgspec.json.encode(GridIndex(tiles=tuple(entries)), order="deterministic"), *blobs] if blobs else []


def grid_report(blobs: list[bytes], without: dict[str, str]) -> GridReport:
    """Of what `encode_grid` returned."""
    sha256 = sha256_hex(blobs[0]) if blobs else None
    return GridReport(sha256=sha256, bytes=sum(map(len, blobs)), tiles=max(0, len(blobs) - 1), without=without)


def grid_of(manifest: Manifest, blob: Callable[[str], bytes]) -> Tiles:
    """The grid of a version; blob: the verified bytes of an address.

    Raises StateError for a version without one, saying why, and MapFormatError or NewerFormatError for bytes that are none.
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
            raise MapFormatError(
                f"{where}: grid tile {place} stands in the place of {entry.x}, {entry.y}; it is damaged"
            )
        tiles[place] = cells
    return tiles


def known_grid(manifest: Manifest, blob: Callable[[str], bytes]) -> Tiles:
    """As `grid_of`; no tiles for a version without a grid."""
    report = report_of(manifest)
    return {} if report is None or report.sha256 is None else grid_of(manifest, blob)


def report_of(manifest: Manifest) -> GridReport | None:
    """What the build said of its grid, None where it was to make none. MapFormatError for words that are none of ours."""
    found = manifest.report.get(GRID_KEY)
    try:
        return None if found is None else msgspec.convert(found, GridReport)
    except msgspec.ValidationError as error:
        raise MapFormatError(f"manifest of {manifest.site} version {manifest.version}: grid: {error}") from error


def read_index(data: bytes) -> GridIndex:
    """The index of `data`; MapFormatError for anything else, NewerFormatError for one that counts otherwise."""
    try:
        index = msgspec.json.decode(data, type=GridIndex)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise MapFormatError(f"index of a grid: {error}; it is damaged or not ours") from error
    if msgspec.structs.replace(index, tiles=()) != GridIndex():
        raise NewerFormatError(
            f"index of a grid of format {index.format_version}: made by another fleetmap; update this one"
        )
    return index


def decode_grid_tile(data: bytes) -> tuple[tuple[int, int], Counts]:
    """Place and cells (N, N, 4) of a tile's bytes; errors as of `read_index`. Memory is bounded whatever the bytes say."""
    _, payload = unpack(GRID_MAGIC, GRID_FORMAT, data, "grid tile", _TILE_BYTES)
    if len(payload) != _TILE_BYTES:
        raise MapFormatError(f"grid tile: {len(payload)} bytes, not {_TILE_BYTES}; the bytes are damaged")
    layers = np.frombuffer(payload, np.uint8, offset=_HEAD.size).reshape(_LAYERS, TILE_CELLS, TILE_CELLS)
    x, y = _HEAD.unpack_from(payload)
    return (x, y), np.ascontiguousarray(np.moveaxis(layers, 0, -1))
