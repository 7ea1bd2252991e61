"""Made-up surfels, and drafts with them."""

from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np

from mapserver.drafting.draft_evidence import MappedSession
from mapserver.plugins.dense_maps.surfel_map import EDGE_M, TILE_SIZE_M, SurfelReport, Surfels, SurfelTiles, encode_tile
from mapserver.plugins.dense_maps.survey_pictures import kept_pictures
from mapserver.store import MapStore
from mapserver.store.survey_pictures import SurveyPicture
from support.fleet.dashboard_scene import AISLE_M, LENGTH_M, WIDTH_M
from support.storage.map_samples import save_tile


def encode_surfels(surfels: Surfels) -> list[bytes]:
    """All surfels of a version as blobs, cut into tiles."""
    places = np.floor(surfels.points_map[:, :2] / TILE_SIZE_M).astype(np.int64)
    every = np.unique(places, axis=0).tolist()
    tiles = {(x, y): encode_tile((x, y), surfels[(places == (x, y)).all(axis=1)]) for x, y in every}
    return SurfelTiles(tiles, surfels.falloff, surfels.exposures).blobs()


def surfel_extras(surfels: Surfels) -> tuple[list[tuple[str, bytes]], object]:
    """The bytes of a draft's surfels, and what is reported of them."""
    blobs = encode_surfels(surfels)
    return [("surfel", data) for data in blobs], msgspec.to_builtins(SurfelReport.of(blobs, {}, surfels=len(surfels)))


def wall(distance_m: float = 2.0, *, grey: int = 120, edge_level: int = 1) -> Surfels:
    """A wall across x at this distance, 4 m wide and 2 m high, that faces the origin; grey apart from a square of 0.4 m that is white."""
    edge_m = EDGE_M * 2**edge_level
    y, z = (axis.ravel() for axis in np.meshgrid(np.arange(-2.0, 2.0, edge_m), np.arange(-1.0, 1.0, edge_m)))
    points = np.column_stack([np.full(len(y), distance_m), y + edge_m / 2, z + edge_m / 2]).astype(np.float32)
    normals = np.tile(np.array([-1.0, 0.0, 0.0], np.float32), (len(y), 1))
    greys = np.where((np.abs(points[:, 1]) < 0.2) & (np.abs(points[:, 2]) < 0.2), 250, grey).astype(np.uint8)
    return Surfels(points, normals, np.full(len(y), edge_level, np.uint8), greys)


def seen_wall(*, with_board: bool = False) -> Surfels:
    """The wall as two views from the origin saw it, with a board of 0.6 m halfway before it."""
    views = np.array([[0.0, y, 0.0, 1.0, 0.0, 0.0, 0.0] for y in (-0.1, 0.1)])
    board = wall(1.0)
    board = board[np.abs(board.points_map[:, 1:]).max(axis=1) < 0.3]
    return replace(Surfels.joined([wall(), board] if with_board else [wall()]), exposures=views)


def save_surfel_draft(store: MapStore, surfels: Surfels, *, site: str = "lab") -> int:
    """A draft with these surfels."""
    extras, said = surfel_extras(surfels)
    return save_tile(store, site, {"surfels": said}, extras)


def save_session_pictures(
    store: MapStore, sessions: Sequence[MappedSession], before: Sequence[SurveyPicture] = (), *, site: str = "lab"
) -> int:
    """A draft with the pictures of these sessions, and those of a version before."""
    blobs, said = kept_pictures(sessions, before, store.blob, store.now_ns())
    extras = [("surfel", data) for data in blobs]
    return save_tile(store, site, {"pictures": msgspec.to_builtins(said)}, extras)


def rack_surfels(level: int = 3) -> Surfels:
    """Both sides of the racks of `hall_tiles`, with uprights and boards darker than the goods."""
    edge_m = 0.01 * 2**level
    x, z = (axis.ravel() for axis in np.meshgrid(np.arange(3, LENGTH_M - 3, edge_m), np.arange(0.1, 3.0, edge_m)))
    parts = []
    for rack in np.arange(2.0, WIDTH_M, AISLE_M):
        for side in (-1.0, 1.0):
            points = np.column_stack([x, np.full(len(x), rack + 0.6 * side), z]).astype(np.float32)
            frame = (x % 2.7 < 0.25) | (z % 1.0 < 0.2)
            goods = 120 + 60 * ((np.floor(x / 0.9) * 7 + np.floor(z) * 3 + rack) % 5 / 5)
            normals = np.tile(np.array([0.0, side, 0.0], np.float32), (len(x), 1))
            greys = np.where(frame, 40, goods).astype(np.uint8)
            parts.append(Surfels(points, normals, np.full(len(x), level, np.uint8), greys))
    return Surfels.joined(parts)
