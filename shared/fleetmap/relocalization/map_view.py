"""The part of a map in a robot's memory: landmarks and places of the surrounding tiles, indexed for queries; the landmarks expected in
a camera's view, their matches among its features, and neighbouring places. Pure.

Source: Mur-Artal et al. 2015 (ORB-SLAM), section V.D: a landmark is expected where it projects into the image, within the range of
distances and close to the directions from which it was seen, at the octave that its distance predicts.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.bow.vocabulary import Vocabulary
from fleetmap.features.matching import Descriptors, Projected, match_by_projection, packed
from fleetmap.features.orb import SCALE_FACTOR, Features
from fleetmap.geometry import AnyArray, Array, Array32, Indices, Mask
from fleetmap.mapformat.tile import Tile
from fleetmap.pnp.pnp import REFINEMENT
from fleetmap.relocalization.settings import FixSettings, RelocalizerSettings
from fleetmap.sensors.rectification import StereoCamera

Rows = NDArray[np.int64]
COLUMNS, ROWS = 8, 6  # image cells over which matches must be spread


class ViewingCones(NamedTuple):
    """The directions and distances from which N landmarks were seen.

    points_map (N, 3); directions_map (N, 3) unit, from the landmark to its cameras; half_angles_rad (N,) around them;
    max_distances_m (N,) at which it appears at the finest octave, 0 for one without observations.
    """

    points_map: Array
    directions_map: Array32
    half_angles_rad: Array32
    max_distances_m: Array32


class VisibleLandmarks(NamedTuple):
    """Landmarks expected in a camera's view: rows (V,), pixels (V, 3) u_left v u_right, and expected octaves (V,)."""

    rows: Rows
    pixels: Array
    octaves: Array


def visible_landmarks(
    cones: ViewingCones,
    map_from_cam: Array,
    camera: StereoCamera,
    margin_px: float,
    max_view_angle_rad: float,
    distance_scale: float = 1.0,
) -> VisibleLandmarks:
    """Landmarks in a camera's image widened by margin_px, seen at most max_view_angle_rad outside their cones.

    distance_scale: the camera's focal length as a multiple of the survey's; a longer lens sees a corner at equal scale from farther away.
    """
    limits = distance_scale, margin_px, max_view_angle_rad, SCALE_FACTOR
    return VisibleLandmarks(
        *core.visible_landmarks(cones, np.ascontiguousarray(map_from_cam), pinhole_of(camera), *limits)
    )


def pinhole_of(camera: StereoCamera) -> Array:
    """(6,) in the core's order: focal, cx, cy, focal * baseline, width, height."""
    return np.array([*camera.lens, camera.width_px, camera.height_px])


def match_visible(
    expected: VisibleLandmarks, descriptors: Descriptors, windows_px: Array, features: Features, settings: FixSettings
) -> Rows:
    """(V,) matching feature of each expected landmark with descriptors (V, 32), -1 for none, within windows_px (V,) of its pixel."""
    octaves = np.column_stack([np.floor(expected.octaves) - 2, np.ceil(expected.octaves) + 2]).astype(np.int64)
    projected = Projected(expected.pixels[:, :2], windows_px, descriptors, octaves)
    found, _ = match_by_projection(projected, features, settings.guided_distance, settings.guided_ratio)
    return found


def cones_of_tiles(tiles: Sequence[Tile]) -> ViewingCones:
    """The cones of all landmarks of the tiles, one tile after the other."""
    return ViewingCones(
        joined([tile.points_map for tile in tiles], (0, 3), np.float64),
        np.ascontiguousarray(joined([tile.view_directions_map for tile in tiles], (0, 3), np.float32)),
        joined([tile.view_half_angle_rad for tile in tiles], (0,), np.float32),
        joined([tile.max_distance_m for tile in tiles], (0,), np.float32),
    )


def places_around(places_map_from_cam: Array, map_from_cam: Array, radius_m: float, min_cosine: float) -> Mask:
    """(K,) True for places (K, 4, 4) within a radius of a camera and of similar viewing direction, by the cosine between the axes."""
    apart_m = np.linalg.norm(places_map_from_cam[:, :3, 3] - map_from_cam[:3, 3], axis=1)
    axes_map, axis_map = places_map_from_cam[:, :3, 2], map_from_cam[:3, 2]
    return np.asarray((apart_m < radius_m) & (axes_map @ axis_map > min_cosine))


def image_cells(pixels: Array, camera: StereoCamera) -> Rows:
    """(P,) number of the cell, of COLUMNS x ROWS in the image, of each pixel (P, 2)."""
    column = np.clip(pixels[:, 0] / camera.width_px * COLUMNS, 0, COLUMNS - 1).astype(np.int64)
    row = np.clip(pixels[:, 1] / camera.height_px * ROWS, 0, ROWS - 1).astype(np.int64)
    return np.asarray(column * ROWS + row)


def joined(parts: Sequence[AnyArray], empty: tuple[int, ...], dtype: type[np.generic]) -> Any:
    """Concatenate the parts; an array of shape `empty` without any."""
    return np.concatenate(parts).astype(dtype) if parts else np.zeros(empty, dtype)


_LEVEL = 2  # level of the vocabulary's tree whose nodes are the cells of descriptors
_CELLS = 4  # cells queried for each descriptor
_NEAR_BITS = 40  # of 256: descriptors of one landmark days apart; all others but look-alikes differ by more
_UNSEEN_LANDMARKS = 8.0  # added to the landmarks of every place: a place of few landmarks resembles nothing strongly
_MIN_INLIER_SHARE = 0.35  # of the matches at a fix
_NEIGHBOURHOOD_M, _NEIGHBOURHOOD_COSINE = 3.0, 0.5


ALIAS_STEP_M = 2.5
"""Distance at which places may look alike if a map's build did not measure it: bays of shelves and racks are that long and more."""


@dataclass(frozen=True, slots=True)
class CovisibleLandmarks:
    """Landmarks expected in view from a fix, because the survey saw them from nearby.

    ids (E,), points_map (E, 3), descriptors (E, 32), and found (E,), True for matched ones.
    """

    ids: NDArray[np.uint32]
    points_map: Array
    descriptors: Descriptors
    is_found: Mask


class LookAlikes(NamedTuple):
    """Similarity of places outside a map to it, measured by its build.

    recall: the landmark recall that one of them exceeds with a probability of at most max_wrong_share, 0 if none resembled the map;
    inliers: the same of a fix's inliers, infinite if not measured.
    """

    recall: float
    max_wrong_share: float = 1.0
    inliers: float = inf


class MapView:
    """Landmarks (N) and places (K) of some tiles of one version.

    Landmark arrays are as in Tile. survey_focal_px is that of the camera that made the map: a robot sees the same corner at
    the same scale from a distance proportional to its own focal length.
    """

    def __init__(self, tiles: Iterable[Tile], vocabulary: Vocabulary, survey_focal_px: float) -> None:
        held = sorted(tiles, key=lambda t: (t.tile_x, t.tile_y))
        self.vocabulary = vocabulary
        self._survey_focal_px = survey_focal_px
        self.cones = cones_of_tiles(held)
        self.points_map = self.cones.points_map
        self.landmark_ids = joined([t.landmark_ids for t in held], (0,), np.uint32)
        self.descriptors = joined([t.descriptors for t in held], (0, 32), np.uint8)
        self.sigmas_m = joined([t.sigma_m for t in held], (0,), np.float32)
        self.map_from_cam = joined([t.map_from_cam for t in held], (0, 4, 4), np.float64)
        order = np.argsort(self.landmark_ids, kind="stable")
        self.place_rows = [_rows_of(ids, self.landmark_ids, order) for t in held for ids in t.place_landmark_ids]
        words = vocabulary.words(self.descriptors) if len(self.descriptors) else np.zeros(0, np.int32)
        weights = vocabulary.idf[words].astype(np.float64)
        counts = [len(rows) for rows in self.place_rows]
        self._index = DescriptorIndex(self.descriptors, vocabulary)
        self._shown = np.concatenate([np.zeros(0, np.int64), *self.place_rows])
        self._place_of_shown = np.repeat(np.arange(len(counts)), counts)
        self._shown_weights = weights[self._shown]
        unseen = _UNSEEN_LANDMARKS * (float(weights.mean()) if len(weights) else 1.0)
        self._place_weights = np.bincount(self._place_of_shown, self._shown_weights, minlength=len(counts)) + unseen

    def similarities(self, descriptors: Descriptors) -> Array:
        """Return (K,) the share of each place's landmarks, weighted by word rarity, found among descriptors (N, 32).

        Not a symmetric similarity: a map within a budget holds a tenth of what a robot sees, and absence from it proves nothing. Each
        place counts for itself: added up over its neighbours, fewer right ones are among the first.
        """
        if not len(descriptors):
            return np.zeros(len(self.place_rows))
        weights = self._shown_weights * self._index.near(descriptors, _NEAR_BITS)[self._shown]
        shares = np.bincount(self._place_of_shown, weights, minlength=len(self.place_rows)) / self._place_weights
        return np.asarray(shares)

    def visible(
        self, map_from_cam: Array, camera: StereoCamera, margin_px: float, max_view_angle_rad: float
    ) -> VisibleLandmarks:
        """Landmarks expected in a camera's image widened by margin_px."""
        scale = camera.focal_px / self._survey_focal_px
        return visible_landmarks(self.cones, map_from_cam, camera, margin_px, max_view_angle_rad, scale)

    def fix_finder(self, camera: StereoCamera, settings: RelocalizerSettings) -> core.FixFinder:
        """Create the finder of fixes of a camera in this map."""
        return core.FixFinder(
            self.cones,
            self.sigmas_m,
            packed(self.descriptors),
            self.map_from_cam,
            self._shown,
            np.cumsum([0, *map(len, self.place_rows)]),
            pinhole_of(camera),
            camera.focal_px / self._survey_focal_px,
            SCALE_FACTOR,
            settings.fix,
            settings.stereo,
            _MIN_INLIER_SHARE,
            REFINEMENT,
            camera.clearance_px,
        )

    def neighbourhood(self, place: int) -> Rows:
        """Rows of all landmarks of places near one place with a similar viewing direction."""
        near = places_around(self.map_from_cam, self.map_from_cam[place], _NEIGHBOURHOOD_M, _NEIGHBOURHOOD_COSINE)
        return np.flatnonzero(np.bincount(self._shown[near[self._place_of_shown]]))  # `unique` hashes: ten times slower


def most_similar(similarities: Array, allowed: Mask | None, top: int) -> Rows:
    """Return at most `top` of the allowed places (K,) with any similarity, best first."""
    shares = similarities if allowed is None else np.where(allowed, similarities, 0.0)
    best = np.argsort(-shares, kind="stable")[:top]
    return np.asarray(best[shares[best] > 0.0], np.int64)


def _rows_of(ids: NDArray[np.uint32], landmark_ids: NDArray[np.uint32], order: Rows) -> Rows:
    """Rows of landmark ids, `order` sorts all of them; ids in unloaded tiles are left out."""
    if not len(order):
        return np.zeros(0, np.int64)
    rows = order[np.minimum(np.searchsorted(landmark_ids, ids, sorter=order), len(order) - 1)]
    return np.asarray(rows[landmark_ids[rows] == ids], np.int64)


class DescriptorIndex:
    """Index of descriptors (M, 32) by their nearest cell in a vocabulary's tree.

    A word is too small a cell: half of the corners, imaged again days later, fall into a different word. Sources: Sivic and
    Zisserman 2003 on inverted files, Jegou, Douze and Schmid 2008 on querying several cells and comparing bits within them.
    """

    def __init__(self, descriptors: Descriptors, vocabulary: Vocabulary) -> None:
        self._centres = vocabulary.centres[_nodes_at(vocabulary, _LEVEL)]
        bits = packed(descriptors)
        cells = core.nearest_cells(bits, self._centres, 1)[:, 0]
        self._order = np.argsort(cells, kind="stable")
        self._held = bits[self._order]
        self._starts = np.searchsorted(cells[self._order], np.arange(len(self._centres) + 1))

    def near(self, descriptors: Descriptors, max_bits: int) -> Mask:
        """(M,) True for indexed descriptors within max_bits of any query (N, 32)."""
        found = np.zeros(len(self._held), bool)
        is_near = core.near_descriptors(packed(descriptors), self._centres, _CELLS, self._held, self._starts, max_bits)
        found[self._order] = is_near
        return found


def _nodes_at(vocabulary: Vocabulary, level: int) -> Indices:
    """The nodes of a level of the tree and the leaves above it; the root if it has no children."""
    nodes, leaves = np.zeros(1, np.int64), np.zeros(0, np.int64)
    for _ in range(level):
        counts = vocabulary.child_count[nodes]
        leaves = np.concatenate([leaves, nodes[counts == 0]])
        inner = nodes[counts > 0]
        if not len(inner):
            break
        first = vocabulary.first_child[inner]
        nodes = np.concatenate([np.arange(a, a + n) for a, n in zip(first, vocabulary.child_count[inner], strict=True)])
    return np.unique(np.concatenate([leaves, nodes]))
