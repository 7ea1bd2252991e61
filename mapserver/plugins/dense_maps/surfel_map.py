"""The surfels of a version: as arrays, and as bytes (an index, and one blob for each tile; docs/map_format.md)."""

import logging
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, NamedTuple, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.encoding import to_json
from fleetmap.errors import MapFormatError
from fleetmap.geometry import AnyArray, Array, Array32, Indices, Mask
from fleetmap.mapformat.container import pack, unpack
from fleetmap.mapformat.manifest import Manifest, Positive, TileEntry, manifest_entry
from fleetmap.mapformat.names import sha256_hex
from fleetmap.mapformat.tile import off_tile_m
from fleetmap.version_grid import LayerReport, decode_index, layer_address
from mapserver.plugins.dense_maps.exposure import FALLOFF

_log = logging.getLogger(__name__)
EDGE_M, LEVELS = core.SURFEL_EDGE_M, core.SURFEL_LEVELS
MIN_RANGE_M, MAX_RANGE_M = core.SURFEL_RANGE_M
TILE_SIZE_M = 16.0  # the size of the map's own tiles
SURFEL_MAGIC, SURFEL_FORMAT = b"FMSU", 1
SURFELS_KEY = "surfels"
"""Key in `report` of a manifest with the index; older readers ignore it."""

NO_FALLOFF = (0.0,) * FALLOFF
EXPOSURE = 7
_HEAD = struct.Struct("<iiiI")  # place, height of the lowest surfel in mm, count
_FLAT_M, _HEIGHT_M, _TURN = TILE_SIZE_M / 65536, 0.001, 127.0
_COLUMNS = (("<u2", 3), ("i1", 2), ("u1", 1), ("u1", 1))  # position, normal, level, grey
_BYTES_EACH = sum(np.dtype(kind).itemsize * width for kind, width in _COLUMNS)
_MOST_BYTES, _ZSTD_LEVEL, _MOST_TILES = 1 << 28, 9, 1 << 16
_MOST_EXPOSURES = 1 << 14


@dataclass(frozen=True, slots=True)
class Surfels:
    """N discs in `map`: points_map (N, 3), unit normals (N, 3) towards the camera, level (N,) of their voxels, grey (N,).

    An edge of their voxels is EDGE_M times two to the power of the level. falloff: vignetting of the lens (see exposure), removed from
    the greys. exposures (K, 7): positions, viewing directions and logarithms of the brightness of the drives' images.
    """

    points_map: Array32
    normals: Array32
    levels: NDArray[np.uint8]
    greys: NDArray[np.uint8]
    falloff: tuple[float, ...] = NO_FALLOFF
    exposures: Array = field(default_factory=lambda: np.zeros((0, EXPOSURE)))

    def __len__(self) -> int:
        return len(self.points_map)

    def __getitem__(self, chosen: Mask | Indices) -> "Surfels":
        each = (self.points_map[chosen], self.normals[chosen], self.levels[chosen], self.greys[chosen])
        return Surfels(*each, self.falloff, self.exposures)

    @property
    def edges_m(self) -> Array32:
        """(N,) edges of the voxels."""
        return np.float32(EDGE_M) * np.exp2(self.levels, dtype=np.float32)

    @classmethod
    def joined(cls, parts: Iterable["Surfels"]) -> Self:
        """Concatenate surfels, with the lens of the last part and its exposures first; empty for no parts."""
        none = Surfels(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), *np.zeros((2, 0), np.uint8))
        every = [none, *parts]
        names = ("points_map", "normals", "levels", "greys")
        columns = {name: np.concatenate([getattr(part, name) for part in every]) for name in names}
        exposures = np.concatenate([part.exposures for part in every[::-1]])[:_MOST_EXPOSURES]
        return cls(**columns, falloff=every[-1].falloff, exposures=exposures)


_Row = Annotated[tuple[float, ...], msgspec.Meta(min_length=EXPOSURE, max_length=EXPOSURE)]


class SurfelIndex(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Units of the tiles' numbers, the lens, and the tiles by place and address; `landmarks` of each is its number of surfels."""

    format_version: Positive = SURFEL_FORMAT
    tile_size_m: float = TILE_SIZE_M
    edge_m: float = EDGE_M
    falloff: Annotated[tuple[float, ...], msgspec.Meta(min_length=FALLOFF, max_length=FALLOFF)] = NO_FALLOFF
    exposures: Annotated[tuple[_Row, ...], msgspec.Meta(max_length=_MOST_EXPOSURES)] = ()
    tiles: Annotated[tuple[TileEntry, ...], msgspec.Meta(max_length=_MOST_TILES)] = ()


class SurfelReport(LayerReport, frozen=True, kw_only=True):
    """Entry of the surfels, with their number."""

    surfels: int = 0


class SurfelTile(NamedTuple):
    """The bytes of a tile, and its number of surfels."""

    data: bytes
    surfels: int


@dataclass(frozen=True, slots=True)
class SurfelTiles:
    """The encoded surfels of a site by place of their tile, with the lens and the exposures of its drives as of `Surfels`."""

    tiles: Mapping[tuple[int, int], SurfelTile] = field(default_factory=dict)
    falloff: tuple[float, ...] = NO_FALLOFF
    exposures: Array = field(default_factory=lambda: np.zeros((0, EXPOSURE)))

    def __len__(self) -> int:
        return sum(tile.surfels for tile in self.tiles.values())

    def surfels(self, place: tuple[int, int]) -> Surfels:
        """Return the surfels of a tile, none for one that is not there. MapFormatError or NewerFormatError for invalid bytes."""
        if place not in self.tiles:
            return Surfels.joined([])
        found, surfels = _decode_tile(self.tiles[place].data)
        if found != place or len(surfels) != self.tiles[place].surfels:
            raise MapFormatError(f"surfel tile {found} is at the place of {place[0]}, {place[1]}; it is damaged")
        return surfels

    def joined(self) -> Surfels:
        """Return all surfels."""
        return replace(Surfels.joined(map(self.surfels, self.tiles)), falloff=self.falloff, exposures=self.exposures)

    def blobs(self) -> list[bytes]:
        """Return the index and then each tile; empty for no surfels."""
        entries = [
            TileEntry(x=x, y=y, sha256=sha256_hex(tile.data), bytes=len(tile.data), landmarks=tile.surfels)
            for (x, y), tile in sorted(self.tiles.items())
        ]
        images = tuple(tuple(row) for row in self.exposures[:_MOST_EXPOSURES].round(4).tolist())
        index = SurfelIndex(falloff=self.falloff, exposures=images, tiles=tuple(entries))
        blobs = [self.tiles[place].data for place in sorted(self.tiles)]
        return [to_json(index, order="deterministic"), *blobs] if blobs else []


def index_address(manifest: Manifest) -> str:
    """Return the SHA-256 of the index of a version's surfels; StateError with the reason if it has none."""
    return layer_address(manifest, report_of(manifest), "surfels", "surfel_map", "no recording has near surfaces")


def surfels_of(
    manifest: Manifest, blob: Callable[[str], bytes], near: tuple[float, float, float] | None = None
) -> Surfels:
    """Return the surfels of a version; near: x, y and a distance in m that limits the tiles. blob: verified bytes of an address.

    Raises StateError with the reason for a version without any, and MapFormatError or NewerFormatError for invalid bytes.
    """
    index_address(manifest)
    return known_surfels(manifest, blob, near).joined()


def known_surfels(
    manifest: Manifest, blob: Callable[[str], bytes], near: tuple[float, float, float] | None = None
) -> SurfelTiles:
    """Return the encoded surfels of a version; empty for a version without any. Arguments and errors as of `surfels_of`."""
    report = report_of(manifest)
    if report is None or report.sha256 is None:
        return SurfelTiles()
    own = {"tiles": (), "falloff": NO_FALLOFF, "exposures": ()}
    index = decode_index(blob(report.sha256), SurfelIndex, "surfels", **own)
    tiles = {
        (entry.x, entry.y): SurfelTile(blob(entry.sha256), entry.landmarks)
        for entry in index.tiles
        if near is None or off_tile_m(np.array([entry.x, entry.y]), TILE_SIZE_M, np.array(near[:2])) <= near[2]
    }
    return SurfelTiles(tiles, index.falloff, np.array(index.exposures, np.float64).reshape(-1, EXPOSURE))


def report_of(manifest: Manifest) -> SurfelReport | None:
    """Return the build's report on its surfels, None if they were not enabled. MapFormatError for an invalid entry."""
    return manifest_entry(manifest, "report", SURFELS_KEY, SurfelReport)


def encode_tile(place: tuple[int, int], surfels: Surfels) -> SurfelTile:
    """Return the bytes of the surfels of a tile; they do not depend on the order of the surfels.

    Two bytes of height span 65.5 m, from the lowest surfel or from 32.8 m under the median, whichever is higher. Surfels outside, whose
    depths are wrong, are left out.
    """
    height = np.round(surfels.points_map[:, 2].astype(np.float64) / _HEIGHT_M).astype(np.int64)
    lowest = max(int(height.min()), int(np.median(height)) - 32768)
    is_within = (height >= lowest) & (height <= lowest + 65535)
    if not is_within.all():
        count = int((~is_within).sum())
        _log.warning("surfel tile %d, %d: %d surfels outside 65.5 m of height are left out", *place, count)
        surfels, height = surfels[is_within], height[is_within]
    corner = np.array(place) * TILE_SIZE_M
    flat = np.clip((surfels.points_map[:, :2] - corner) / _FLAT_M, 0, 65535)
    position = np.column_stack([flat, height - lowest]).astype(np.uint16)
    columns: list[AnyArray] = [position, _octahedron(surfels.normals), surfels.levels[:, None], surfels.greys[:, None]]
    # Sorted by place in centimetres and then all values: the bytes do not depend on the order.
    near = [position[:, axis] // step for axis, step in ((0, 256), (1, 256), (2, 64), (0, 32), (1, 32), (2, 8))]
    every = [column[:, i] for column in columns for i in range(column.shape[1])]
    order = np.lexsort([*every[::-1], *near[::-1]])
    parts = [_HEAD.pack(*place, lowest, len(surfels))]
    for column, (kind, width) in zip(columns, _COLUMNS, strict=True):
        for i in range(width):
            data = np.ascontiguousarray(column[order, i], np.dtype(kind))
            parts += [np.ascontiguousarray(b).tobytes() for b in data.view(np.uint8).reshape(len(data), -1).T]
    return SurfelTile(pack(SURFEL_MAGIC, SURFEL_FORMAT, parts, level=_ZSTD_LEVEL), len(surfels))


def _decode_tile(data: bytes) -> tuple[tuple[int, int], Surfels]:
    payload = unpack(SURFEL_MAGIC, SURFEL_FORMAT, data, "surfel tile", _MOST_BYTES)
    count = _HEAD.unpack_from(payload)[3] if len(payload) >= _HEAD.size else -1
    if len(payload) != _HEAD.size + _BYTES_EACH * count:
        raise MapFormatError(f"surfel tile: {len(payload)} bytes for {count} surfels; the bytes are damaged")
    x, y, lowest, _ = _HEAD.unpack_from(payload)
    columns, start = [], _HEAD.size
    for kind, width in _COLUMNS:
        size = np.dtype(kind).itemsize
        part = np.frombuffer(payload, np.uint8, width * size * count, start).reshape(width, size, count)
        columns.append(np.ascontiguousarray(np.moveaxis(part, 1, 2)).view(kind)[..., 0])
        start += width * size * count
    position, turned, levels, greys = columns
    if count and int(levels.max()) >= LEVELS:
        raise MapFormatError(f"surfel tile {x}, {y}: a level of {int(levels.max())}; the bytes are damaged")
    points = np.empty((count, 3))
    points[:, :2] = (position[:2].T + 0.5) * _FLAT_M + np.array([x, y]) * TILE_SIZE_M
    points[:, 2] = (position[2].astype(np.int64) + lowest) * _HEIGHT_M
    return (x, y), Surfels(points.astype(np.float32), _normals(turned.T), levels[0].copy(), greys[0].copy())


def _octahedron(normals: Array32) -> NDArray[np.int8]:
    """Return (N, 2) octahedral codes of unit vectors (N, 3). Source: Meyer et al. 2010, on floating-point normal vectors."""
    flat = normals[:, :2] / np.abs(normals).sum(axis=1, keepdims=True)
    folded = (1.0 - np.abs(flat[:, ::-1])) * np.where(flat >= 0, 1.0, -1.0)
    return np.asarray(np.round(np.where(normals[:, 2:] < 0, folded, flat) * _TURN), np.int8)


def _normals(turned: NDArray[np.int8]) -> Array32:
    flat = turned.astype(np.float32) / np.float32(_TURN)
    height = 1.0 - np.abs(flat).sum(axis=1)
    folded = (1.0 - np.abs(flat[:, ::-1])) * np.where(flat >= 0, 1.0, -1.0)
    normals = np.column_stack([np.where(height[:, None] < 0, folded, flat), height])
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6), np.float32)
