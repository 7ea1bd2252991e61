"""Landmarks, places and surfels of a version as bytes for the browser. Pure.

    offset        type          content
    0             u32           N, number of landmarks
    4             u32           K, number of places
    8             f32, N x 3    landmarks in `map`, metres
    8 + 12 N      f32, K x 12   map_from_cam of the places as they were surveyed one after the other, three rows of four
    ...           u8, N         how exactly each landmark is known: 0 for FINEST_M or better, 255 for COARSEST_M or worse, logarithmic

Surfels, in the order of their levels:

    0             u32           L, number of levels
    4             u32, L        number of surfels of each level
    4 + 4 L       f32, L        edge of the voxels that they stand for, metres; wider where every n-th is shown
    4 + 8 L       f32, M x 3    surfels in `map`, metres
    ...           u8, M         grey level of each

Little-endian.
"""

import struct
from collections.abc import Sequence

import numpy as np

from fleetmap.mapformat.tile import Tile
from mapserver.plugins.dense_maps.surfel_map import EDGE_M, LEVELS, Surfels

FINEST_M, COARSEST_M = 0.002, 0.2
MAX_LANDMARKS = 2_000_000  # 26 MB; beyond, every n-th is shown
MAX_SURFELS = 1_000_000  # 13 MB


def space_bytes(tiles: Sequence[Tile]) -> bytes:
    """All landmarks and places of a version; of more than MAX_LANDMARKS every n-th."""
    points = np.concatenate([np.zeros((0, 3)), *(tile.points_map for tile in tiles)])
    sigmas_m = np.concatenate([np.zeros(0), *(tile.sigma_m for tile in tiles)])
    order = np.argsort(np.concatenate([np.zeros(0, np.int64), *(tile.place_ids for tile in tiles)]), kind="stable")
    places = np.concatenate([np.zeros((0, 4, 4)), *(tile.map_from_cam for tile in tiles)])[order]
    step = max(1, -(-len(points) // MAX_LANDMARKS))
    points, sigmas_m = points[::step], sigmas_m[::step]
    share = np.log(np.maximum(sigmas_m, FINEST_M) / FINEST_M) / np.log(COARSEST_M / FINEST_M)
    return b"".join(
        [
            struct.pack("<2I", len(points), len(places)),
            points.astype("<f4").tobytes(),
            places[:, :3].astype("<f4").tobytes(),
            np.clip(np.round(255 * share), 0, 255).astype(np.uint8).tobytes(),
        ]
    )


def surfel_bytes(surfels: Surfels) -> bytes:
    """All surfels of a version; of more than MAX_SURFELS every n-th."""
    step = max(1, -(-len(surfels) // MAX_SURFELS))
    shown = surfels[np.arange(0, len(surfels), step)]
    shown = shown[np.argsort(shown.levels, kind="stable")]
    edges_m = EDGE_M * np.sqrt(step) * np.exp2(np.arange(LEVELS))
    return b"".join(
        [
            struct.pack("<I", LEVELS),
            np.bincount(shown.levels, minlength=LEVELS).astype("<u4").tobytes(),
            edges_m.astype("<f4").tobytes(),
            shown.points_map.astype("<f4").tobytes(),
            shown.greys.tobytes(),
        ]
    )
