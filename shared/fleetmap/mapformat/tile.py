"""A tile, decoded: the part of a version that covers one square of the ground."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import MapFormatError
from fleetmap.geometry import Array

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
    view_directions_map: NDArray[np.float32]
    view_half_angle_rad: NDArray[np.float32]
    max_distance_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
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


def off_tile_m(cells: NDArray[np.int64], size_m: float, positions_map_m: Array) -> Array:
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
