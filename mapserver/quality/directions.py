"""Headings of the places of a map, and missing ones: a robot that drives the other way cannot localize there. Pure."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
import scipy

from fleetmap.geometry import Array, Indices, Mask
from mapserver.quality.figures import TileDirections, first_of

HEADINGS = ("E", "NE", "N", "NW", "W", "SW", "S", "SE")  # E along x of `map`, N along y
_NEAR_M = 2.0  # includes the other lane of an aisle, but not the next aisle
_OTHER_WAY = -0.5  # cosine between the headings of two places, below which they look in opposite directions
_UPRIGHT = 0.3  # horizontal part of an axis below which a camera looks at the ceiling or the ground
_LEAST_M = 3.0  # one-way places within a smaller extent are a turn, not an aisle


def headings_of(map_from_cam: Array) -> tuple[Indices, Mask, Mask]:
    """Return the numbers of the HEADINGS of places (K, 4, 4), which of them look neither up nor down, and which of those are one-way: no
    place near them looks the other way."""
    axes_map = map_from_cam[:, :2, 2]
    lengths = np.linalg.norm(axes_map, axis=1)
    level = lengths > _UPRIGHT
    headings = axes_map / np.maximum(lengths, 1e-9)[:, None]
    sectors = np.round(np.arctan2(headings[:, 1], headings[:, 0]) / (np.pi / 4)).astype(int) % len(HEADINGS)
    positions_map = map_from_cam[:, :3, 3]
    met = np.zeros(len(positions_map), bool)  # places that have another near them that looks the other way
    if len(positions_map):
        pairs = scipy.spatial.cKDTree(positions_map).query_pairs(_NEAR_M, output_type="ndarray")
        first, second = pairs.reshape(-1, 2).T
        opposed = level[first] & level[second] & ((headings[first] * headings[second]).sum(axis=1) < _OTHER_WAY)
        met[first[opposed]] = met[second[opposed]] = True
    return sectors, level, level & ~met


def opposite(sector: int) -> str:
    """Return the heading opposite to the one of a number."""
    return HEADINGS[(sector + len(HEADINGS) // 2) % len(HEADINGS)]


def tile_directions(places: Mapping[tuple[int, int], Array]) -> list[TileDirections]:
    """Return the seen headings of each tile with places, map_from_cam (K, 4, 4), in their order; places that look up or down are left out.

    One-way is judged for every place by its neighbours, across the borders of tiles: in a tile with two aisles, driven in
    opposite directions, both are one-way.
    """
    map_from_cam = np.concatenate([np.zeros((0, 4, 4)), *places.values()])
    sectors, level, one_way = headings_of(map_from_cam)
    owners = np.repeat(np.arange(len(places)), [len(of_tile) for of_tile in places.values()])
    found = []
    for number, tile in enumerate(places):
        mine = owners == number
        seen = Counter(sectors[mine & level].tolist())
        if not seen:
            continue
        missing = {}
        for sector in sorted(seen):
            alone = mine & one_way & (sectors == sector)
            if alone.any() and np.linalg.norm(np.ptp(map_from_cam[alone, :2, 3], axis=0)) >= _LEAST_M:
                missing[opposite(sector)] = int(alone.sum())
        found.append(TileDirections(tile, {HEADINGS[sector]: seen[sector] for sector in sorted(seen)}, missing))
    return found


def one_way_words(found: Sequence[TileDirections]) -> str:
    """Return the number of one-way tiles and the missing headings in the first ones, as text; empty if none are missing."""
    named = [f"tile {tile.tile[0]},{tile.tile[1]}: {missing_words(tile)}" for tile in found if tile.missing]
    one_way = f"{len(named)} of {len(found)} tiles hold places that were seen one way only ({first_of(named, 2)})"
    return one_way if named else ""


def missing_words(tile: TileDirections) -> str:
    """Return the missing headings as text."""
    return ", ".join(
        f"{count} places face {opposite(HEADINGS.index(heading))} and none near them {heading}"
        for heading, count in tile.missing.items()
    )
