"""A tile: the part of a version that covers one square of the ground, and its bytes, magic FMTL, in the envelope of `container`.
docs/map_format.md describes every byte.

Stored by column, with integers wider than a byte as byte planes (all low bytes, then all next ones), because similar high
bytes compress well. Quantisation is idempotent: a decoded tile encodes to the same bytes.
"""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import MapFormatError
from fleetmap.geometry import Array, Array32, Indices, quat_wxyz_from_rotation
from fleetmap.mapformat.container import pack, unpack

Ids = NDArray[np.uint32]


@dataclass(frozen=True)
class Tile:
    """Landmarks and places in `map` over [tile_x, tile_x + 1) x [tile_y, tile_y + 1) times size_m, at every height.

    landmark_ids (N,) strictly increasing; points_map (N, 3) metres; descriptors (N, 32);
    view_directions_map (N, 3) unit, from the landmark towards its cameras; view_half_angle_rad (N,) half angle
    of the cone of these directions; max_distance_m (N,) distance at which it appears at the finest octave; sigma_m (N,)
    standard deviation of its position. Places are keyframes for recognition: place_ids (K,) strictly increasing,
    map_from_cam (K, 4, 4), and for each the ids of landmarks seen there, strictly increasing; they may lie in other
    tiles.
    """

    tile_x: int
    tile_y: int
    size_m: float
    landmark_ids: Ids
    points_map: Array
    descriptors: NDArray[np.uint8]
    view_directions_map: Array32
    view_half_angle_rad: Array32
    max_distance_m: Array32
    sigma_m: Array32
    place_ids: Ids
    map_from_cam: Array
    place_landmark_ids: tuple[Ids, ...]

    def __len__(self) -> int:
        return len(self.landmark_ids)

    @property
    def name(self) -> str:
        """Name for messages."""
        return f"tile ({self.tile_x}, {self.tile_y})"

    @property
    def origin_m(self) -> Array:
        """(2,) the corner with the smallest x and y, in `map`."""
        return np.array([self.tile_x * self.size_m, self.tile_y * self.size_m])


def off_tile_m(cells: Indices, size_m: float, positions_map_m: Array) -> Array:
    """Return the horizontal distances (...,) of positions (..., 2 or 3) from tiles of size_m at cells (..., 2), 0 inside."""
    off = cells * size_m - positions_map_m[..., :2]
    return np.asarray(np.linalg.norm(np.maximum(np.maximum(off, -off - size_m), 0.0), axis=-1))


def check_tile(tile: Tile) -> Tile:
    """Return `tile`; raise MapFormatError naming the first field that violates Tile's docstring."""
    count, places = len(tile.landmark_ids), len(tile.place_ids)
    for field, shape in (
        ("landmark_ids", (count,)),
        ("points_map", (count, 3)),
        ("descriptors", (count, 32)),
        ("view_directions_map", (count, 3)),
        ("view_half_angle_rad", (count,)),
        ("max_distance_m", (count,)),
        ("sigma_m", (count,)),
        ("place_ids", (places,)),
        ("map_from_cam", (places, 4, 4)),
    ):
        values = getattr(tile, field)
        if values.shape != shape:
            raise MapFormatError(f"{tile.name}: {field} has shape {values.shape} instead of {shape}")
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise MapFormatError(f"{tile.name}: {field} holds values that are not finite")
    if len(tile.place_landmark_ids) != places:
        raise MapFormatError(f"{tile.name}: {len(tile.place_landmark_ids)} landmark lists for {places} places")
    if not (np.isfinite(tile.size_m) and tile.size_m > 0):
        raise MapFormatError(f"{tile.name}: size_m is {tile.size_m}, it must be a positive number of metres")
    if max(abs(tile.tile_x), abs(tile.tile_y)) >= 1 << 31:
        raise MapFormatError(f"{tile.name} lies too far from the origin of the map; remove the outliers")
    for field, ids in (("landmark_ids", tile.landmark_ids), ("place_ids", tile.place_ids)):
        check_increasing(ids, f"{tile.name}: {field}")
    for place_id, ids in zip(tile.place_ids, tile.place_landmark_ids, strict=True):
        check_increasing(ids, f"{tile.name}: landmarks of place {place_id}")
    inside = tile.points_map[:, :2] - tile.origin_m
    if ((inside < -1e-3) | (inside > tile.size_m + 1e-3)).any():
        worst = tile.points_map[int(np.abs(inside - tile.size_m / 2).max(axis=1).argmax())]
        raise MapFormatError(f"{tile.name} of {tile.size_m} m holds a landmark at {worst.tolist()}, outside of it")
    lengths = np.linalg.norm(tile.view_directions_map, axis=1)
    if (np.abs(lengths - 1.0) > 1e-2).any():
        raise MapFormatError(
            f"{tile.name}: view_directions_map has lengths from {lengths.min()} to {lengths.max()}, not 1"
        )
    return tile


def check_increasing(ids: Ids, what: str) -> None:
    """Raise MapFormatError unless the ids are uint32 and strictly increasing."""
    if ids.dtype != np.uint32 or ids.ndim != 1:
        raise MapFormatError(f"{what} are {ids.dtype} of shape {ids.shape} instead of a row of uint32")
    if (ids[1:] <= ids[:-1]).any():
        raise MapFormatError(f"{what} are not strictly increasing; sort them and remove duplicates")


_RATIO = 32767.0
# Coarse steps save bytes at no cost: a quantum of 2 mm adds 0.6 mm to the standard deviation of
# landmarks that are known to a few millimetres at best, and robots tolerate 75 degrees beyond the directions.
_SIDE_STEPS = 8192  # quanta of a tile's side
_DIRECTION_STEPS = 42
_HALF_ANGLE_STEPS = 60
_DISTANCE_M = (0.1, 8)  # smallest value, codes per octave
_SIGMA_M = (1e-4, 4)


def log_code(values: Array32, smallest: float, steps_per_octave: int) -> NDArray[np.uint8]:
    """Codes c of values ~ smallest * 2 ** (c / steps_per_octave), clipped to 0..255."""
    octaves = np.log2(np.maximum(values.astype(np.float64), smallest) / smallest)
    return np.minimum(np.round(octaves * steps_per_octave), 255).astype(np.uint8)


def log_value(codes: NDArray[np.uint8], smallest: float, steps_per_octave: int) -> Array32:
    """Values of `log_code`'s codes."""
    return (smallest * np.exp2(codes.astype(np.float64) / steps_per_octave)).astype(np.float32)


def half_angle_code(angles_rad: Array32) -> NDArray[np.uint8]:
    """Codes of angles from 0 to pi."""
    steps = np.round(angles_rad.astype(np.float64) * (_HALF_ANGLE_STEPS / np.pi))
    return np.clip(steps, 0, _HALF_ANGLE_STEPS).astype(np.uint8)


def half_angle_value(codes: NDArray[np.uint8]) -> Array32:
    """Angles in radians of codes; those above the last one mean pi."""
    return (np.minimum(codes, _HALF_ANGLE_STEPS) * (np.pi / _HALF_ANGLE_STEPS)).astype(np.float32)


def direction_code(directions: Array32) -> NDArray[np.int8]:
    """(N, 2) octahedral codes, about 2.9 degrees apart, of directions (N, 3). Source: Meyer et al. 2010."""
    # Twice, because directions on the folded edge of the octahedron have two codes: the second pass picks one.
    for _ in range(2):
        vectors = directions.astype(np.float64)
        vectors = vectors / np.abs(vectors).sum(axis=1, keepdims=True)
        upper = vectors[:, :2]
        plane = np.where(vectors[:, 2:] < 0, _folded(upper), upper)
        steps = np.clip(np.round(plane * _DIRECTION_STEPS), -_DIRECTION_STEPS, _DIRECTION_STEPS)
        codes = np.asarray(steps, np.int8)
        directions = direction_value(codes)
    return codes


def _folded(plane: Array) -> Array:
    """The other half of the octahedron, folded outwards."""
    return np.asarray((1.0 - np.abs(plane[:, ::-1])) * np.where(plane >= 0, 1.0, -1.0))


def direction_value(codes: NDArray[np.int8]) -> Array32:
    """(N, 3) unit directions of octahedral codes (N, 2)."""
    plane = np.clip(codes.astype(np.float64), -_DIRECTION_STEPS, _DIRECTION_STEPS) / _DIRECTION_STEPS
    z = 1.0 - np.abs(plane).sum(axis=1, keepdims=True)
    vectors = np.concatenate([np.where(z < 0, _folded(plane), plane), z], axis=1)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), np.float32)


def rotation_code(rotation: Array) -> tuple[int, NDArray[np.int16]]:
    """Index of the quaternion's largest component and the other three divided by it (3,), good to about 5e-5 rad.

    Among components that round to the largest one the first wins, so that decoded rotations encode to the same code.
    """
    quat = quat_wxyz_from_rotation(rotation)
    ratios = np.round(quat / np.abs(quat).max() * _RATIO)
    index = int(np.argmax(np.abs(ratios) == _RATIO))
    return index, (np.delete(ratios, index) * np.sign(ratios[index])).astype(np.int16)


def rotation_values(indices: NDArray[np.uint8], ratios: NDArray[np.int16]) -> Array:
    """(K, 3, 3) rotations of `rotation_code`'s codes (K,) and (K, 3)."""
    quats = np.ones((len(indices), 4))
    quats[np.arange(4)[None] != indices[:, None]] = (ratios.astype(np.float64) / _RATIO).ravel()
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.asarray(np.moveaxis(np.array(rows), -1, 0))


def differences(ids: Ids) -> Ids:
    """Differences of successive ids, beginning with the first id."""
    return np.diff(ids, prepend=np.uint32(0)) if len(ids) else ids


def planes(values: Ids, width: int) -> bytes:
    """Encode the low `width` bytes of each value as byte planes: all low bytes, then all next ones."""
    return values.astype("<u4").view(np.uint8).reshape(-1, 4)[:, :width].T.tobytes()


class Columns:
    """Reads a tile's payload column by column; the caller has checked its length."""

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
        """The next `count` ids; raises MapFormatError unless they are strictly increasing."""
        return self.sums(self.planes(count, 4))

    def sums(self, steps: Ids) -> Ids:
        """The ids that these steps give; errors as of `increasing`."""
        sums = np.cumsum(steps.astype(np.uint64))
        if len(sums) and sums[-1] >= 1 << 32:
            raise MapFormatError(f"tile: an id adds up to {sums[-1]}, more than 32 bits hold; the bytes are damaged")
        ids = sums.astype(np.uint32)
        check_increasing(ids, "tile: ids")
        return ids


_MAGIC = b"FMTL"
TILE_FORMAT = 2
LANDMARK_BYTES = 48
PLACE_BYTES = 27
REFERENCE_BYTES = 4
MAX_TILE_PAYLOAD_BYTES = 16 << 20
MAX_TILE_PLACES = 1 << 14
_HEAD = struct.Struct("<iidiIII")
_PLACE_STEPS_PER_M = 65536.0


def encode_tile(tile: Tile) -> bytes:
    """Encode a tile; raises MapFormatError for a tile that is invalid or does not fit."""
    check_tile(tile)
    z_codes = np.round(tile.points_map[:, 2] / (tile.size_m / _SIDE_STEPS))
    z_base = int(z_codes.min()) if len(tile) else 0
    if len(tile) and (z_codes.max() - z_base >= 1 << 24 or abs(z_base) >= 1 << 31):
        low, high = tile.points_map[:, 2].min(), tile.points_map[:, 2].max()
        raise MapFormatError(f"{tile.name}: heights from {low} to {high} m do not fit in 24 bits; remove the outliers")
    references = sum(len(ids) for ids in tile.place_landmark_ids)
    head = _HEAD.pack(tile.tile_x, tile.tile_y, tile.size_m, z_base, len(tile), len(tile.place_ids), references)
    steps = (tile.points_map[:, :2] - tile.origin_m) / (tile.size_m / _SIDE_STEPS)
    plane_codes = np.clip(np.round(steps), 0, _SIDE_STEPS - 1).astype(np.uint32)
    parts = [
        head,
        planes(differences(tile.landmark_ids), 4),
        planes(plane_codes[:, 0], 2),
        planes(plane_codes[:, 1], 2),
        planes((z_codes - z_base).astype(np.uint32), 3),
        np.ascontiguousarray(tile.descriptors, np.uint8).tobytes(),
        direction_code(tile.view_directions_map).T.tobytes(),
        half_angle_code(tile.view_half_angle_rad).tobytes(),
        log_code(tile.max_distance_m, *_DISTANCE_M).tobytes(),
        log_code(tile.sigma_m, *_SIGMA_M).tobytes(),
        *_place_columns(tile),
    ]
    size = sum(len(part) for part in parts)
    if size > MAX_TILE_PAYLOAD_BYTES or len(tile.place_ids) > MAX_TILE_PLACES:
        raise MapFormatError(
            f"{tile.name} takes {size} bytes and has {len(tile.place_ids)} places, the limits are "
            f"{MAX_TILE_PAYLOAD_BYTES} and {MAX_TILE_PLACES}; use smaller tiles"
        )
    return pack(_MAGIC, TILE_FORMAT, parts)


def decode_tile(data: bytes) -> Tile:
    """Decode the bytes of `encode_tile`.

    Raises NewerFormatError for a newer format, MapFormatError for bytes that are not a complete tile. Time and memory are
    bounded by MAX_TILE_PAYLOAD_BYTES and MAX_TILE_PLACES for any input.
    """
    payload = unpack(_MAGIC, TILE_FORMAT, data, "tile", MAX_TILE_PAYLOAD_BYTES)
    if len(payload) < _HEAD.size:
        raise MapFormatError(f"tile: {len(payload)} bytes are too few for its header; the bytes are damaged")
    tile_x, tile_y, size_m, z_base, count, places, references = _HEAD.unpack_from(payload)
    expected = _HEAD.size + LANDMARK_BYTES * count + PLACE_BYTES * places + REFERENCE_BYTES * references
    if len(payload) != expected:
        raise MapFormatError(
            f"tile ({tile_x}, {tile_y}): {count} landmarks, {places} places and {references} references take "
            f"{expected} bytes, there are {len(payload)}; the bytes are damaged"
        )
    if places > MAX_TILE_PLACES:
        raise MapFormatError(f"tile ({tile_x}, {tile_y}): {places} places, the limit is {MAX_TILE_PLACES}")
    if not (np.isfinite(size_m) and 0 < size_m < 1e6):
        raise MapFormatError(f"tile ({tile_x}, {tile_y}): size_m is {size_m}; the bytes are damaged")
    columns = Columns(payload, _HEAD.size)
    quantum_m = size_m / _SIDE_STEPS
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
        view_directions_map=direction_value(columns.bytes(count * 2).view(np.int8).reshape(2, count).T),
        view_half_angle_rad=half_angle_value(columns.bytes(count)),
        max_distance_m=log_value(columns.bytes(count), *_DISTANCE_M),
        sigma_m=log_value(columns.bytes(count), *_SIGMA_M),
        place_ids=columns.increasing(places),
        map_from_cam=_map_from_cam(columns, places),
        place_landmark_ids=_references(columns, places, references),
    )
    return check_tile(tile)


def _place_columns(tile: Tile) -> list[bytes]:
    steps = np.round(tile.map_from_cam[:, :3, 3] * _PLACE_STEPS_PER_M)
    if (np.abs(steps) >= 1 << 31).any():
        raise MapFormatError(f"{tile.name}: a place lies more than 32 km from the origin of the map; check the survey")
    rotations = [rotation_code(rotation) for rotation in tile.map_from_cam[:, :3, :3]]
    ratios = np.array([ratios for _, ratios in rotations], np.int16).reshape(-1, 3).view(np.uint16).astype(np.uint32)
    counts = np.array([len(ids) for ids in tile.place_landmark_ids], np.uint32)
    lists = [differences(ids) for ids in tile.place_landmark_ids]
    places = [
        planes(differences(tile.place_ids), 4),
        *(planes(steps[:, axis].astype(np.int32).view(np.uint32), 4) for axis in range(3)),
        np.array([index for index, _ in rotations], np.uint8).tobytes(),
        *(planes(column, 2) for column in ratios.T),
        planes(counts, 4),
    ]
    return [b"".join(places), planes(np.concatenate([np.zeros(0, np.uint32), *lists]), 4)]


def _map_from_cam(columns: Columns, places: int) -> Array:
    centres = [columns.planes(places, 4).view(np.int32) / _PLACE_STEPS_PER_M for _ in range(3)]
    indices = columns.bytes(places)
    if (indices > 3).any():
        raise MapFormatError(f"tile: quaternion component {indices.max()} of a place; the bytes are damaged")
    ratios = np.stack([columns.planes(places, 2).astype(np.uint16).view(np.int16) for _ in range(3)], axis=1)
    map_from_cam = np.tile(np.eye(4), (places, 1, 1))
    map_from_cam[:, :3, 3] = np.stack(centres, axis=1)
    map_from_cam[:, :3, :3] = rotation_values(indices, ratios)
    return map_from_cam


def _references(columns: Columns, places: int, references: int) -> tuple[Ids, ...]:
    counts = columns.planes(places, 4).astype(np.int64)
    if counts.sum() != references:
        raise MapFormatError(
            f"tile: places list {counts.sum()} landmarks, the header says {references}; the bytes are damaged"
        )
    values = columns.planes(references, 4)
    return tuple(columns.sums(part) for part in np.split(values, np.cumsum(counts)[:-1])) if places else ()
