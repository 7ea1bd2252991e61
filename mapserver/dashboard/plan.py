"""The floor plan of a version: its landmarks and places from above as a picture, and its tiles. Pure."""

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, Indices
from fleetmap.mapformat.manifest import Manifest, TileEntry
from fleetmap.mapformat.tile import Tile
from mapserver.quality.directions import tile_directions
from mapserver.quality.figures import TileDirections

_LONG_SIDE_PX = 1600
_FINEST_M = 0.04  # metres per pixel: below, single landmarks are dots far apart
# Around the robots' path, and around most landmarks: those of far walls would shrink everything else.
_BEYOND_M, _MARGIN_M = 12.0, 1.0
_FEW = 1.0  # per cent
_LANDMARK_BGR, _PLACE_BGR = (140, 128, 118), (235, 120, 50)  # middle tones, to be seen on white and on black

Box = tuple[float, float, float, float]
"""Low x, low y, high x, high y."""


class Plan(NamedTuple):
    """box: in `map`, metres. png: transparent where nothing is. places: number of places.

    directions: viewing directions of each tile's places.
    """

    box: Box
    tile_size_m: float
    tiles: tuple[TileEntry, ...]
    places: int
    png: bytes
    directions: tuple[TileDirections, ...]


def make_plan(manifest: Manifest, read_tile: Callable[[TileEntry], Tile]) -> Plan:
    """The plan of a version; an empty one shows 10 m around the origin."""
    tiles = [read_tile(entry) for entry in manifest.tiles]
    landmarks = np.concatenate([np.zeros((0, 2)), *(tile.points_map[:, :2] for tile in tiles)])
    places = np.concatenate([np.zeros((0, 2)), *(tile.map_from_cam[:, :2, 3] for tile in tiles)])
    low, high = _corners(manifest, places, landmarks)
    return Plan(
        (*low.tolist(), *high.tolist()),
        manifest.tile_size_m,
        manifest.tiles,
        len(places),
        _picture(landmarks, places, low, high),
        tuple(tile_directions({(tile.tile_x, tile.tile_y): tile.map_from_cam for tile in tiles})),
    )


def _corners(manifest: Manifest, places: Array, landmarks: Array) -> tuple[Array, Array]:
    if not manifest.tiles:
        return np.array([-5.0, -5.0]), np.array([5.0, 5.0])
    cells = np.array([(entry.x, entry.y) for entry in manifest.tiles], float)
    low, high = cells.min(axis=0) * manifest.tile_size_m, (cells.max(axis=0) + 1) * manifest.tile_size_m
    if len(places):
        # As far as most landmarks lie, but with all places.
        most = np.percentile(np.concatenate([places, landmarks]), [_FEW, 100 - _FEW], axis=0)
        nearest, farthest = places.min(axis=0) - _MARGIN_M, places.max(axis=0) + _MARGIN_M
        near_low = np.maximum(low, np.maximum(nearest - _BEYOND_M, np.minimum(nearest, most[0] - _MARGIN_M)))
        near_high = np.minimum(high, np.minimum(farthest + _BEYOND_M, np.maximum(farthest, most[1] + _MARGIN_M)))
        if (near_high - near_low > 1.0).all():
            return near_low, near_high
    return low, high


def _picture(landmarks: Array, places: Array, low: Array, high: Array) -> bytes:
    """A PNG: darker where more landmarks are above each other, with a dot for each place."""
    scale_m = max(_FINEST_M, float((high - low).max()) / _LONG_SIDE_PX)
    width, height = np.maximum(np.ceil((high - low) / scale_m).astype(int), 1)
    counts = np.zeros((height, width), np.float32)
    np.add.at(counts, _pixels(landmarks, low, high, scale_m, height), 1)
    counts = cv2.dilate(counts, np.ones((3, 3), np.uint8))  # pages show it smaller than it is
    opaque = np.where(counts > 0, np.clip(110 + 70 * np.log1p(counts), 0, 255), 0)
    picture = inked(opaque, _LANDMARK_BGR)
    radius = max(1, round(0.12 / scale_m))
    for y, x in zip(*_pixels(places, low, high, scale_m, height), strict=True):
        cv2.circle(picture, (int(x), int(y)), radius, (*_PLACE_BGR, 255), -1)
    return png(picture)


def inked(opaque: NDArray[Any], ink_bgr: tuple[int, int, int]) -> NDArray[np.uint8]:
    """A picture (H, W, 4) of one ink, which is as opaque as (H, W) says, from 0 to 255."""
    return np.dstack([np.full((*opaque.shape, 3), ink_bgr, np.uint8), opaque.astype(np.uint8)])


def png(picture: NDArray[np.uint8]) -> bytes:
    """A picture as a PNG."""
    done, data = cv2.imencode(".png", picture)
    assert done
    return data.tobytes()


def _pixels(points: Array, low: Array, high: Array, scale_m: float, height: int) -> tuple[Indices, ...]:
    """Rows and columns of the points that are in the picture; y points up."""
    inside = ((points >= low) & (points < high)).all(axis=1)
    columns, rows = ((points[inside] - low) / scale_m).astype(np.int64).T
    return np.maximum(height - 1 - rows, 0), columns
