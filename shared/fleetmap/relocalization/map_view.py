"""The part of a map that a robot holds: landmarks and places of the tiles around, ready to be looked up."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.bow import Vocabulary
from fleetmap.features.orb import SCALE_FACTOR
from fleetmap.geometry import Array
from fleetmap.mapformat import Tile
from fleetmap.relocalization import map_view_kernels
from fleetmap.sensors.rectification import StereoCamera

Rows = NDArray[np.int64]
_NEAREST_M = 0.2
_UNSEEN_WEIGHT = 5.0  # of words that no place has: a place of few words is not much like anything
_WITNESS_M, _WITNESS_COSINE = 1.0, 0.8
_REACH_SHARE = 1.3  # of the distance up to which a landmark was found: detection does not end sharply


@dataclass(frozen=True, slots=True)
class Expected:
    """What should have been seen from a fix: ids (E,), points_map (E, 3), descriptors (E, 32), and whether each was (E,)."""

    ids: NDArray[np.uint32]
    points_map: Array
    descriptors: NDArray[np.uint8]
    is_found: NDArray[np.bool_]


class MapView:
    """Landmarks (N) and places (K) of some tiles of one version.

    landmark arrays are as in Tile; survey_focal_px is that of the camera that made the map: a robot's lens sees the same corner at
    the same scale from a distance that grows with its own focal length.
    """

    def __init__(self, tiles: Iterable[Tile], vocabulary: Vocabulary, survey_focal_px: float) -> None:
        held = sorted(tiles, key=lambda t: (t.tile_x, t.tile_y))
        self.vocabulary = vocabulary
        self._survey_focal_px = survey_focal_px
        self.landmark_ids = _joined([t.landmark_ids for t in held], (0,), np.uint32)
        self.points_map = _joined([t.points_map for t in held], (0, 3), np.float64)
        self.descriptors = _joined([t.descriptors for t in held], (0, 32), np.uint8)
        self.view_directions_map = _joined([t.view_directions_map for t in held], (0, 3), np.float32)
        self.view_half_angles_rad = _joined([t.view_half_angle_rad for t in held], (0,), np.float32)
        self.max_distances_m = _joined([t.max_distance_m for t in held], (0,), np.float32)
        self.sigmas_m = _joined([t.sigma_m for t in held], (0,), np.float32)
        self.map_from_cam = _joined([t.map_from_cam for t in held], (0, 4, 4), np.float64)
        order = np.argsort(self.landmark_ids, kind="stable")
        self.place_rows = [_rows_of(ids, self.landmark_ids, order) for t in held for ids in t.place_landmark_ids]
        words = vocabulary.words(self.descriptors) if len(self.descriptors) else np.zeros(0, np.int32)
        held_words = [np.unique(words[rows]) for rows in self.place_rows]
        counts = [len(unique) for unique in held_words]
        flat, places = np.concatenate([np.zeros(0, np.int32), *held_words]), np.repeat(np.arange(len(counts)), counts)
        order = np.argsort(flat, kind="stable")
        self._place_of_posting = places[order]
        self._word_starts = np.searchsorted(flat[order], np.arange(vocabulary.word_count + 1))
        weights = vocabulary.idf[flat].astype(np.float64)
        self._place_weights = np.bincount(places, weights, minlength=len(counts)) + _UNSEEN_WEIGHT

    def __len__(self) -> int:
        return len(self.points_map)

    def similar_places(self, descriptors: NDArray[np.uint8], allowed: NDArray[np.bool_] | None, top: int) -> Rows:
        """Places of whose words the descriptors hold the largest share, best first.

        Not the likeness of the two: a map within a budget holds a tenth of what a robot sees, and what it lacks says nothing.
        """
        if not len(self.place_rows) or not len(descriptors):
            return np.zeros(0, np.int64)
        words = np.unique(self.vocabulary.words(descriptors))
        starts, ends = self._word_starts[words], self._word_starts[words + 1]
        postings = np.concatenate([np.arange(a, b) for a, b in zip(starts.tolist(), ends.tolist(), strict=True)])
        weights = np.repeat(self.vocabulary.idf[words].astype(np.float64), ends - starts)
        found = np.bincount(self._place_of_posting[postings], weights, minlength=len(self.place_rows))
        shares = found / self._place_weights
        if allowed is not None:
            shares = np.where(allowed, shares, 0.0)
        best = np.argsort(-shares, kind="stable")[:top]
        return np.asarray(best[shares[best] > 0.0], np.int64)

    def visible(
        self, map_from_cam: Array, camera: StereoCamera, margin_px: float, max_view_angle_rad: float
    ) -> tuple[Rows, Array, Array]:
        """Rows (V,) of landmarks that a camera there should see, their pixels (V, 3) and expected octaves (V,)."""
        size, reaches_m = len(self), self._reaches_m(camera.focal_px)
        rows, pixels, distances_m = np.empty(size, np.int64), np.empty((size, 3)), np.empty(size)
        pinhole = np.array(
            [camera.focal_px, camera.cx_px, camera.cy_px, camera.focal_px * camera.baseline_m, camera.width_px, camera.height_px]
        )  # fmt: skip
        count = map_view_kernels.visible(
            self.points_map, self.view_directions_map, self.view_half_angles_rad, reaches_m,
            np.ascontiguousarray(map_from_cam), pinhole, margin_px, max_view_angle_rad, _NEAREST_M, _REACH_SHARE, rows,
            pixels, distances_m,
        )  # fmt: skip
        rows, pixels = rows[:count].copy(), pixels[:count].copy()
        octaves = np.log(np.maximum(reaches_m[rows] / distances_m[:count], 0.5)) / np.log(SCALE_FACTOR)
        return rows, pixels, octaves

    def witnessed(self, map_from_cam: Array, camera: StereoCamera) -> tuple[Rows, bool]:
        """Rows of the landmarks in the picture of a camera there that the survey saw from next to it, looking the same way: what
        racks hide is not among them. All that may be visible, and False, where the survey did not pass."""
        rows, _, _ = self.visible(map_from_cam, camera, 0.0, np.pi)
        apart_m = np.linalg.norm(self.map_from_cam[:, :3, 3] - map_from_cam[:3, 3], axis=1)
        axes_map = self.map_from_cam[:, :3, 2]
        places = np.flatnonzero((apart_m < _WITNESS_M) & (axes_map @ map_from_cam[:3, 2] > _WITNESS_COSINE))
        if not len(places):
            return rows, False
        held = np.zeros(len(self), bool)
        for place in places:
            held[self.place_rows[place]] = True
        return rows[held[rows]], True

    def expected(self, rows: Rows, is_found: NDArray[np.bool_]) -> Expected:
        """Landmarks (E,) that should have been seen, and whether they were (E,)."""
        return Expected(self.landmark_ids[rows], self.points_map[rows], self.descriptors[rows], is_found)

    def _reaches_m(self, focal_px: float) -> NDArray[np.float32]:
        """(N,) up to which distance a camera of this focal length finds each landmark."""
        return np.asarray(self.max_distances_m * np.float32(focal_px / self._survey_focal_px), np.float32)

    def neighbourhood(self, place: int, reach_m: float) -> Rows:
        """Rows of all landmarks of places near one place that look a similar way."""
        positions, axes = self.map_from_cam[:, :3, 3], self.map_from_cam[:, :3, 2]
        near = np.linalg.norm(positions - positions[place], axis=1) < reach_m
        near &= axes @ axes[place] > 0.5
        held = np.zeros(len(self), bool)
        for p in np.flatnonzero(near):
            held[self.place_rows[p]] = True
        return np.flatnonzero(held)


def _rows_of(ids: NDArray[np.uint32], landmark_ids: NDArray[np.uint32], order: Rows) -> Rows:
    """Rows of landmark ids, `order` sorts all of them; those in tiles that are not held are left out."""
    if not len(order):
        return np.zeros(0, np.int64)
    at = np.searchsorted(landmark_ids, ids, sorter=order)
    rows = order[np.minimum(at, len(order) - 1)]
    return np.asarray(rows[landmark_ids[rows] == ids], np.int64)


def _joined(parts: list[NDArray[np.generic]], shape: tuple[int, ...], dtype: type) -> NDArray:  # type: ignore[type-arg]
    return np.concatenate(parts).astype(dtype) if parts else np.zeros(shape, dtype)
