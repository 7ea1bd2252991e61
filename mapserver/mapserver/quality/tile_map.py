"""Tiles as a robot has them, ready to be localised in."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import PlaceIndex, Vocabulary
from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.geometry import AnyArray, Array, se3_inverse, transform_points
from fleetmap.mapformat import Tile
from fleetmap.sensors.rectification import StereoCamera
from mapserver.quality.probes import Look

Rows = NDArray[np.int64]
_NEAREST_M = 0.2
_REACH_SHARE = 1.3  # of the distance up to which a landmark was found: detection does not end sharply
_MORE_ANGLE_RAD = np.radians(35.0)  # beyond the views that a landmark was seen from
_SAME_WAY = 0.5  # cosine between the axes of two cameras that look a similar way


class TileMap:
    """All tiles of a version: points_map (N, 3), descriptors (N, 32); its places map_from_cam (K, 4, 4), and the rows seen there."""

    def __init__(self, tiles: Sequence[Tile]) -> None:
        ids = _joined([tile.landmark_ids for tile in tiles], (0,), np.uint32)
        order = np.argsort(ids, kind="stable")
        self._ids = ids[order]
        self.points_map = _joined([tile.points_map for tile in tiles], (0, 3))[order]
        self.descriptors = _joined([tile.descriptors for tile in tiles], (0, 32), np.uint8)[order]
        self._directions_map = _joined([tile.view_directions_map for tile in tiles], (0, 3))[order]
        self._half_angles_rad = _joined([tile.view_half_angle_rad for tile in tiles], (0,))[order]
        self._reaches_m = _joined([tile.max_distance_m for tile in tiles], (0,))[order]
        self.map_from_cam = _joined([tile.map_from_cam for tile in tiles], (0, 4, 4))
        self.seen_there = [self._rows(seen) for tile in tiles for seen in tile.place_landmark_ids]

    def neighbourhood(self, map_from_cam: Array, radius_m: float) -> Rows:
        """Rows of the landmarks seen at places at most so far from a camera, that look a similar way."""
        off_m = np.linalg.norm(self.map_from_cam[:, :3, 3] - map_from_cam[:3, 3], axis=1)
        axis_map = map_from_cam[:3, 2]
        near = (off_m < radius_m) & (self.map_from_cam[:, :3, 2] @ axis_map > _SAME_WAY)
        found = [self.seen_there[place] for place in np.flatnonzero(near)]
        return np.unique(np.concatenate(found)) if found else np.zeros(0, np.int64)

    def visible(self, map_from_cam: Array, camera: StereoCamera) -> tuple[Rows, Array, Array]:
        """Rows (V,) of landmarks that a camera there should see, their pixels (V, 3) and expected octaves (V,)."""
        seen = transform_points(se3_inverse(map_from_cam), self.points_map)
        pixels = camera.pixel_from_point(seen)
        distances_m = np.linalg.norm(seen, axis=1)
        towards = (map_from_cam[:3, 3] - self.points_map) / np.maximum(distances_m, 1e-9)[:, None]
        wide_rad = np.minimum(self._half_angles_rad + _MORE_ANGLE_RAD, np.pi)
        with np.errstate(invalid="ignore"):
            inside = (
                (distances_m > _NEAREST_M)
                & (distances_m < _REACH_SHARE * self._reaches_m)
                & (np.einsum("ij,ij->i", towards, self._directions_map) > np.cos(wide_rad))
                & (pixels[:, 0] > 0)
                & (pixels[:, 0] < camera.width_px)
                & (pixels[:, 1] > 0)
                & (pixels[:, 1] < camera.height_px)
            )
        rows = np.flatnonzero(inside)
        octaves = np.log(np.maximum(self._reaches_m[rows] / distances_m[rows], 0.5)) / np.log(SCALE_FACTOR)
        return rows, pixels[rows], octaves

    def _rows(self, ids: NDArray[np.uint32]) -> Rows:
        rows = np.minimum(np.searchsorted(self._ids, ids), max(len(self._ids) - 1, 0))
        return rows[self._ids[rows] == ids] if len(self._ids) else np.zeros(0, np.int64)


class Lookalikes:
    """Which far place of a map looks most like a picture."""

    def __init__(self, tile_map: TileMap, vocabulary: Vocabulary) -> None:
        self._map, self._vocabulary = tile_map, vocabulary
        self._index = PlaceIndex(vocabulary.word_count)
        words = vocabulary.words(tile_map.descriptors) if len(tile_map.descriptors) else np.zeros(0, np.int32)
        for place, rows in enumerate(tile_map.seen_there):
            self._index.add(place, vocabulary.bow_vector(words[rows]))

    def of(self, look: Look, map_from_cam: Array, beyond_m: float) -> Array | None:
        """(4, 4) map_from_cam of the place most like the look among those beyond so far from it; None without any."""
        off_m = np.linalg.norm(self._map.map_from_cam[:, :3, 3] - map_from_cam[:3, 3], axis=1)
        far = off_m > beyond_m
        if not far.any():
            return None
        vector = self._vocabulary.bow_vector(self._vocabulary.words(look.descriptors))
        places, _ = self._index.query(vector, far, 1)
        return np.asarray(self._map.map_from_cam[places[0]]) if len(places) else None


def _joined(parts: Sequence[AnyArray], empty: tuple[int, ...], dtype: type[np.generic] = np.float64) -> Any:
    return np.concatenate([np.zeros(empty, dtype), *parts]).astype(dtype)
