"""Landmarks and places of a version as bytes for the browser. Pure.

    offset        type          content
    0             u32           N, number of landmarks
    4             u32           K, number of places
    8             f32, N x 3    landmarks in `map`, metres
    8 + 12 N      f32, K x 12   map_from_cam of the places as they were surveyed one after the other, three rows of four
    ...           u8, N         how exactly each landmark is known: 0 for FINEST_M or better, 255 for COARSEST_M or worse, logarithmic

Little-endian.
"""

import struct
from collections.abc import Sequence

import numpy as np

from fleetmap.mapformat import Tile

FINEST_M, COARSEST_M = 0.002, 0.2
MAX_LANDMARKS = 2_000_000  # 26 MB; beyond, every n-th is shown


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
