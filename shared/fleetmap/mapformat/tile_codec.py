"""Tiles as bytes: format 1, magic FMTL, in the envelope of `container`.

The payload, little-endian; N landmarks, K places, R landmark references of places. Columns, not rows, and integers
wider than a byte as byte planes (all low bytes, then all next ones), because zstd then finds the high bytes alike.

    bytes   content
    4       i32 tile_x
    4       i32 tile_y
    8       f64 size_m
    4       i32 z_base
    4       u32 N
    4       u32 K
    4       u32 R
    4 N     u32 landmark ids, increasing, each less the one before it (the first as it is)
    2 N     u16 x: x_map = tile_x * size_m + code * q, with the quantum q = size_m / 65536 (1/4096 m for 16 m)
    2 N     u16 y, likewise
    3 N     u24 z: z_map = (z_base + code) * q
    32 N    descriptors, row by row
    2 N     i8 view direction, two octahedral codes: all first ones, then all second ones
    N       u8 view half angle, steps of pi / 255
    N       u8 max distance, 0.1 m * 2 ** (code / 20): steps of 3.5 %, up to 688 m
    N       u8 sigma, 0.1 mm * 2 ** (code / 16): steps of 4.4 %, up to 6.3 m
    4 K     u32 place ids, as landmark ids
    12 K    i32 x, y, z of the camera centre in `map`, steps of 1/65536 m, one after the other
    K       u8 index of the largest quaternion component (w x y z) of map_from_cam
    6 K     i16 the other three divided by it, times 32767
    4 K     u32 number of landmarks of each place; they add up to R
    4 R     u32 landmark ids of each place, increasing, each less the one before it (the first of each place as it is)

48 bytes per landmark before compression. Quantising is idempotent: what was decoded is encoded to the same bytes.
"""

import struct

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import MapFormatError
from fleetmap.geometry import Array
from fleetmap.mapformat import quantise
from fleetmap.mapformat.container import pack, unpack
from fleetmap.mapformat.tile import Ids, Tile, check_increasing, check_tile

TILE_MAGIC = b"FMTL"
TILE_FORMAT = 1
LANDMARK_BYTES = 48
PLACE_BYTES = 27
REFERENCE_BYTES = 4
MAX_TILE_PAYLOAD_BYTES = 64 << 20
_HEAD = struct.Struct("<iidiIII")
_PLACE_STEPS_PER_M = 65536.0
_MAX_DISTANCE = (0.1, 20)
_SIGMA = (1e-4, 16)


def encode_tile(tile: Tile) -> bytes:
    """The tile's bytes; raises MapFormatError for a tile that breaks its own rules or does not fit."""
    check_tile(tile)
    z_codes = np.round(tile.points_map[:, 2] / _quantum_m(tile.size_m))
    z_base = int(z_codes.min()) if len(tile) else 0
    if len(tile) and (z_codes.max() - z_base >= 1 << 24 or abs(z_base) >= 1 << 31):
        low, high = tile.points_map[:, 2].min(), tile.points_map[:, 2].max()
        raise MapFormatError(f"{tile.name}: heights from {low} to {high} m do not fit in 24 bits; remove the outliers")
    references = sum(len(ids) for ids in tile.place_landmark_ids)
    counts = (len(tile), len(tile.place_ids), references)
    head = _HEAD.pack(tile.tile_x, tile.tile_y, tile.size_m, z_base, *counts)
    payload = b"".join([head, *_landmark_columns(tile, z_codes - z_base), *_place_columns(tile)])
    if len(payload) > MAX_TILE_PAYLOAD_BYTES:
        raise MapFormatError(
            f"{tile.name} takes {len(payload)} bytes, the limit is {MAX_TILE_PAYLOAD_BYTES}; use smaller tiles"
        )
    return pack(TILE_MAGIC, TILE_FORMAT, payload)


def decode_tile(data: bytes) -> Tile:
    """The tile of `encode_tile`'s bytes.

    Raises NewerFormatError for a newer format, MapFormatError for bytes that are not a whole tile. Time and memory are
    bounded by MAX_TILE_PAYLOAD_BYTES whatever the bytes say.
    """
    _, payload = unpack(TILE_MAGIC, TILE_FORMAT, data, "tile", MAX_TILE_PAYLOAD_BYTES)
    if len(payload) < _HEAD.size:
        raise MapFormatError(f"tile: {len(payload)} bytes are too few for its header; the bytes are damaged")
    tile_x, tile_y, size_m, z_base, count, places, references = _HEAD.unpack_from(payload)
    expected = _HEAD.size + LANDMARK_BYTES * count + PLACE_BYTES * places + REFERENCE_BYTES * references
    if len(payload) != expected:
        raise MapFormatError(
            f"tile ({tile_x}, {tile_y}): {count} landmarks, {places} places and {references} references take "
            f"{expected} bytes, there are {len(payload)}; the bytes are damaged"
        )
    if not (np.isfinite(size_m) and 0 < size_m < 1e6):
        raise MapFormatError(f"tile ({tile_x}, {tile_y}): size_m is {size_m}; the bytes are damaged")
    columns = _Columns(payload, _HEAD.size)
    quantum_m = _quantum_m(size_m)
    tile = Tile(
        tile_x=tile_x,
        tile_y=tile_y,
        size_m=size_m,
        landmark_ids=columns.increasing(count),
        points_map=np.stack(
            [
                tile_x * size_m + columns.planes(count, 2) * quantum_m,
                tile_y * size_m + columns.planes(count, 2) * quantum_m,
                (columns.planes(count, 3).astype(np.int64) + z_base) * quantum_m,
            ],
            axis=1,
        ),
        descriptors=columns.bytes(count * 32).reshape(count, 32).copy(),
        view_directions_map=quantise.direction_value(columns.bytes(count * 2).view(np.int8).reshape(2, count).T),
        view_half_angle_rad=quantise.half_angle_value(columns.bytes(count)),
        max_distance_m=quantise.log_value(columns.bytes(count), *_MAX_DISTANCE),
        sigma_m=quantise.log_value(columns.bytes(count), *_SIGMA),
        place_ids=columns.increasing(places),
        map_from_cam=_map_from_cam(columns, places),
        place_landmark_ids=_references(columns, places, references),
    )
    return check_tile(tile)


def _quantum_m(size_m: float) -> float:
    return size_m / 65536


def _landmark_columns(tile: Tile, z_codes: Array) -> list[bytes]:
    steps = (tile.points_map[:, :2] - tile.origin_m) / _quantum_m(tile.size_m)
    plane_codes = np.clip(np.round(steps), 0, 65535).astype(np.uint32)
    return [
        _planes(_differences(tile.landmark_ids), 4),
        _planes(plane_codes[:, 0], 2),
        _planes(plane_codes[:, 1], 2),
        _planes(z_codes.astype(np.uint32), 3),
        np.ascontiguousarray(tile.descriptors, np.uint8).tobytes(),
        quantise.direction_code(tile.view_directions_map).T.tobytes(),
        quantise.half_angle_code(tile.view_half_angle_rad).tobytes(),
        quantise.log_code(tile.max_distance_m, *_MAX_DISTANCE).tobytes(),
        quantise.log_code(tile.sigma_m, *_SIGMA).tobytes(),
    ]


def _place_columns(tile: Tile) -> list[bytes]:
    steps = np.round(tile.map_from_cam[:, :3, 3] * _PLACE_STEPS_PER_M)
    if (np.abs(steps) >= 1 << 31).any():
        raise MapFormatError(f"{tile.name}: a place lies more than 32 km from the origin of the map; check the survey")
    rotations = [quantise.rotation_code(rotation) for rotation in tile.map_from_cam[:, :3, :3]]
    counts = np.array([len(ids) for ids in tile.place_landmark_ids], np.uint32)
    differences = [_differences(ids) for ids in tile.place_landmark_ids]
    return [
        _planes(_differences(tile.place_ids), 4),
        *(_planes(steps[:, axis].astype(np.int32).view(np.uint32), 4) for axis in range(3)),
        np.array([index for index, _ in rotations], np.uint8).tobytes(),
        *(_planes(_column16(rotations, component), 2) for component in range(3)),
        _planes(counts, 4),
        _planes(np.concatenate([np.zeros(0, np.uint32), *differences]), 4),
    ]


def _column16(rotations: list[tuple[int, NDArray[np.int16]]], component: int) -> Ids:
    return np.array([ratios[component] for _, ratios in rotations], np.int16).view(np.uint16).astype(np.uint32)


def _map_from_cam(columns: "_Columns", places: int) -> Array:
    centres = [columns.planes(places, 4).view(np.int32) / _PLACE_STEPS_PER_M for _ in range(3)]
    indices = columns.bytes(places)
    if (indices > 3).any():
        raise MapFormatError(f"tile: quaternion component {indices.max()} of a place; the bytes are damaged")
    ratios = np.stack([columns.planes(places, 2).astype(np.uint16).view(np.int16) for _ in range(3)], axis=1)
    map_from_cam = np.tile(np.eye(4), (places, 1, 1))
    map_from_cam[:, :3, 3] = np.stack(centres, axis=1)
    for row, (index, three) in enumerate(zip(indices, ratios, strict=True)):
        map_from_cam[row, :3, :3] = quantise.rotation_value(int(index), three)
    return map_from_cam


def _references(columns: "_Columns", places: int, references: int) -> tuple[Ids, ...]:
    counts = columns.planes(places, 4).astype(np.int64)
    if counts.sum() != references:
        raise MapFormatError(
            f"tile: places list {counts.sum()} landmarks, the header says {references}; the bytes are damaged"
        )
    differences = np.split(columns.planes(references, 4), np.cumsum(counts)[:-1]) if places else []
    return tuple(_sums(part) for part in differences)


def _differences(ids: Ids) -> Ids:
    return np.diff(ids, prepend=np.uint32(0)) if len(ids) else ids


def _sums(differences: Ids) -> Ids:
    sums = np.cumsum(differences.astype(np.uint64))
    if len(sums) and sums[-1] >= 1 << 32:
        raise MapFormatError(f"tile: an id adds up to {sums[-1]}, more than 32 bits hold; the bytes are damaged")
    ids = sums.astype(np.uint32)
    check_increasing(ids, "tile: ids")
    return ids


def _planes(values: Ids, width: int) -> bytes:
    """The low `width` bytes of each value, as byte planes."""
    return values.astype("<u4").view(np.uint8).reshape(-1, 4)[:, :width].T.tobytes()


class _Columns:
    """Reads a payload column by column."""

    def __init__(self, payload: bytes, offset: int) -> None:
        self._data = np.frombuffer(payload, np.uint8)
        self._offset = offset

    def bytes(self, count: int) -> NDArray[np.uint8]:
        """The next `count` bytes."""
        self._offset += count
        return self._data[self._offset - count : self._offset]

    def planes(self, count: int, width: int) -> Ids:
        """The next `count` values of `width` byte planes."""
        rows = np.zeros((count, 4), np.uint8)
        rows[:, :width] = self.bytes(count * width).reshape(width, count).T
        return rows.view("<u4").reshape(count).astype(np.uint32)

    def increasing(self, count: int) -> Ids:
        """The next `count` ids."""
        return _sums(self.planes(count, 4))
