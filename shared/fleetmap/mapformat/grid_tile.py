"""Encoding of one tile of the occupancy grid: place, then four layers of cells, in `container`'s envelope."""

import struct

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import MapFormatError
from fleetmap.mapformat.container import pack, unpack

_MAGIC, GRID_FORMAT = b"FMGT", 1
TILE_SIZE_M, CELL_M = 16.0, 0.05  # the size of the map's own tiles
TILE_CELLS = round(TILE_SIZE_M / CELL_M)
_HEAD = struct.Struct("<ii")
_LAYERS, _LEVEL = 4, 12
_LAYER_BYTES = TILE_CELLS**2
_TILE_BYTES = _HEAD.size + _LAYERS * _LAYER_BYTES


def encode_grid_tile(place: tuple[int, int], cells: NDArray[np.uint8]) -> bytes:
    """Encode the tile at (x, y) with cells (N, N, 4)."""
    layers = (np.ascontiguousarray(cells[..., layer]).tobytes() for layer in range(_LAYERS))
    return pack(_MAGIC, GRID_FORMAT, [_HEAD.pack(*place), *layers], level=_LEVEL)


def decode_grid_tile(data: bytes) -> tuple[tuple[int, int], NDArray[np.uint8]]:
    """Decode place and cells (N, N, 4) of a tile.

    MapFormatError or NewerFormatError for anything else; memory is bounded for any input.
    """
    payload = unpack(_MAGIC, GRID_FORMAT, data, "grid tile", _TILE_BYTES)
    if len(payload) != _TILE_BYTES:
        raise MapFormatError(f"grid tile: {len(payload)} bytes, not {_TILE_BYTES}; the bytes are damaged")
    layers = np.frombuffer(payload, np.uint8, offset=_HEAD.size).reshape(_LAYERS, TILE_CELLS, TILE_CELLS)
    x, y = _HEAD.unpack_from(payload)
    return (x, y), np.ascontiguousarray(np.moveaxis(layers, 0, -1))
