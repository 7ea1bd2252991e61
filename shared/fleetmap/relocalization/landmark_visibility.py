"""Landmarks expected in a camera's view, their matches among its features, and neighbouring places. Pure.

Source: Mur-Artal et al. 2015 (ORB-SLAM), section V.D: a landmark is expected where it projects into the image, within the range of
distances and close to the directions from which it was seen, at the octave that its distance predicts.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.features.matching import Projected, match_by_projection
from fleetmap.features.orb import SCALE_FACTOR, Features
from fleetmap.geometry import AnyArray, Array
from fleetmap.mapformat.tile import Tile
from fleetmap.relocalization.settings import FixSettings
from fleetmap.sensors.rectification import StereoCamera

Rows = NDArray[np.int64]
COLUMNS, ROWS = 8, 6  # image cells over which matches must be spread


class ViewingCones(NamedTuple):
    """The directions and distances from which N landmarks were seen.

    points_map (N, 3); directions_map (N, 3) unit, from the landmark to its cameras; half_angles_rad (N,) around them;
    max_distances_m (N,) at which it appears at the finest octave, 0 for one without observations.
    """

    points_map: Array
    directions_map: NDArray[np.float32]
    half_angles_rad: NDArray[np.float32]
    max_distances_m: NDArray[np.float32]


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
    expected: VisibleLandmarks,
    descriptors: NDArray[np.uint8],
    windows_px: Array,
    features: Features,
    settings: FixSettings,
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


def places_around(
    places_map_from_cam: Array, map_from_cam: Array, radius_m: float, min_cosine: float
) -> NDArray[np.bool_]:
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
