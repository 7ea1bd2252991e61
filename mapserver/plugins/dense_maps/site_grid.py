"""The grid of a site: images of each cell by surveys, tile by tile, and its occupancy for a robot of a given height."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from fleetmap import core, version_grid
from fleetmap.geometry import Array, Array32, Indices
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.version_grid import CELL_M, FLOOR_M, HEIGHT_STEP_M, LOWEST_M, SLICE_M, SLICES, TILE_CELLS, Counts, Tiles
from mapserver.plugins.dense_maps.dense_stereo import BLOCK_PX

_RANGE_CELLS = 160  # of a view
# A view that hits a voxel counts as two that pass it, since rays also pass at its rim. An earlier state stays until two more images
# contradict it, and is unknown until the deciding number: few images see into an emptied slot, and one night must suffice.
HIT, OCCUPIED, FREE, AGAINST = 2, 4, 4, 2
# A pixel's depth may belong to any point in the matched block, and its ray represents the pixels up to the next one.
REACH_PX = (BLOCK_PX + core.GRID_RAY_STRIDE_PX) // 2
_WIDTH_M, _STEP_M = 0.5, 1.5  # width of the camera's carrier; distance of keyframes of one drive
_SAME_STEPS = 10  # smaller differences of height are ignored


@dataclass(frozen=True, slots=True)
class SessionViews:
    """Counts of the images of one recording, by tile: hits, passes, hidden (N, N, SLICES) and heights (N, N, 4).

    before: earlier state. Hidden lies behind a newly appeared object: its depth may be unobservable.
    """

    before: Mapping[tuple[int, int], Counts] = field(default_factory=dict)
    tiles: dict[tuple[int, int], tuple[Counts, Counts, Counts, Counts]] = field(default_factory=dict)

    def add(
        self, disparity: tuple[Array32, Array32, float], camera: StereoCamera, map_from_cam: Array, floor_m: float
    ) -> None:
        """Add one view. disparity: as of `dense_disparity`, with that of `nearest_around` between; floor_m: distance of the ground."""
        size = 2 * _RANGE_CELLS + 1
        at_cells = map_from_cam[:2, 3] / CELL_M
        corner = np.floor(at_cells).astype(np.int64) - _RANGE_CELLS
        place = np.array([*(at_cells - corner), floor_m])
        turn = np.ascontiguousarray(map_from_cam[:3, :3])
        px, nearest_px, sigma_px = disparity
        parts, was_free = list(_parts(corner, size)), np.zeros((size, size), np.uint8)
        for tile, in_tile, in_window in parts:
            if tile in self.before:
                was_free[in_window] = self.before[tile][in_tile][..., 1]
        # The bits common to a cell and its eight neighbours; none at the border
        for axis in (0, 1) if was_free.any() else ():
            was_free = was_free & np.roll(was_free, 1, axis) & np.roll(was_free, -1, axis)
        was_free[[0, -1]], was_free[:, [0, -1]] = 0, 0
        window = core.cast_view(px, nearest_px, sigma_px, camera.lens, turn, place, was_free)
        for (x, y), *_ in parts:
            row, column, counts = y * TILE_CELLS - int(corner[1]), x * TILE_CELLS - int(corner[0]), self._tile(x, y)
            if core.add_view(*window, row, column, *counts):
                self.tiles[x, y] = counts

    def add_path(self, cameras_map: Array, floor_m: float) -> None:
        """Add the path of the camera (K, 2 or more): its carrier occupied it, as wide as a person and as high as the camera."""
        steps = np.linalg.norm(np.diff(cameras_map[:, :2], axis=0), axis=1) < _STEP_M
        shares = np.linspace(0.0, 1.0, round(_STEP_M / CELL_M))[:, None, None]
        way = cameras_map[:-1, :2][steps] * (1 - shares) + cameras_map[1:, :2][steps] * shares
        reach = np.arange(-_WIDTH_M / 2, _WIDTH_M / 2 + 1e-9, CELL_M / 2)
        disc = np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 1, 2)
        disc = disc[np.linalg.norm(disc[:, 0], axis=1) <= _WIDTH_M / 2]
        # Step by step: at once a kilometre takes half a gigabyte
        ways = [np.unique(np.floor((step + disc) / CELL_M) @ [1 << 32, 1]) for step in way.swapaxes(0, 1)]
        keys = np.unique(np.concatenate([[], *ways])).astype(np.int64)
        x = (keys + (1 << 31)) >> 32  # back to two halves: unique on integers is thirty times faster than on rows
        cells = np.stack([x, keys - (x << 32)], axis=-1)
        levels = int(np.clip(np.ceil((floor_m - FLOOR_M) / SLICE_M), 0, SLICES))
        for tile in np.unique(cells // TILE_CELLS, axis=0):
            mine = cells[(cells // TILE_CELLS == tile).all(axis=1)] - tile * TILE_CELLS
            x, y = tile.tolist()
            passes = self.tiles.setdefault((x, y), self._tile(x, y))[1]
            passes[mine[:, 1], mine[:, 0], :levels] = np.maximum(passes[mine[:, 1], mine[:, 0], :levels], FREE)

    def _tile(self, x: int, y: int) -> tuple[Counts, Counts, Counts, Counts]:
        if (x, y) in self.tiles:
            return self.tiles[x, y]
        hits, passes, hidden = (np.zeros((TILE_CELLS, TILE_CELLS, SLICES), np.uint8) for _ in range(3))
        return hits, passes, hidden, np.zeros((TILE_CELLS, TILE_CELLS, 4), np.uint8)


_Part = tuple[tuple[int, int], tuple[slice, slice], tuple[slice, slice]]


def _parts(corner: Indices, size: int) -> Iterator[_Part]:
    """Yield the tiles that a window of `size` cells overlaps: place, part of the tile, part of the window (rows, columns)."""
    first, last = corner // TILE_CELLS, (corner + size - 1) // TILE_CELLS
    for x in range(int(first[0]), int(last[0]) + 1):
        for y in range(int(first[1]), int(last[1]) + 1):
            start = np.array([y * TILE_CELLS - corner[1], x * TILE_CELLS - corner[0]])
            low, high = np.maximum(start, 0), np.minimum(start + TILE_CELLS, size)
            tile, window = (
                tuple(slice(*ends) for ends in zip(low - off, high - off, strict=True)) for off in (start, 0)
            )
            yield (x, y), tile, window  # type: ignore[misc]


def updated(images: SessionViews) -> Tiles:
    """Return the tiles updated by a session; unseen cells are unchanged, except behind new objects."""
    tiles = dict(images.before)
    for place, (hits, passes, hidden, heights) in images.tiles.items():
        old = images.before.get(place, np.zeros((TILE_CELLS, TILE_CELLS, 4), np.uint8))
        was_occupied, was_free = (np.unpackbits(old[..., i, None], axis=-1, bitorder="little") > 0 for i in (0, 1))
        # Of a voxel that its highest surface fills in part only so many rays would be in its way.
        over = (LOWEST_M + HEIGHT_STEP_M * heights[..., 3:] - FLOOR_M) / SLICE_M - np.arange(SLICES)
        score = HIT * hits.astype(np.int16) - np.round(np.where((over > 0) & (over < 1), over, 1.0) * passes)
        occupied = (score >= OCCUPIED) | (was_occupied & (score > -AGAINST))
        is_hidden = (hidden >= AGAINST) & (score > -AGAINST)
        free = ~occupied & ((score <= -FREE) | (was_free & (score < AGAINST) & ~is_hidden))
        bits = [np.packbits(mask, axis=-1, bitorder="little")[..., 0] for mask in (occupied, free)]
        low, high = (_height(old[..., 2 + i], heights[..., 1 + 2 * i]) for i in (0, 1))
        # An object seen there by a few images only has left no voxel.
        levels = np.where(bits[0] > 0, np.log2(np.maximum(bits[0], 1)).astype(np.int64) + 1, 0)
        top = 1 + ((FLOOR_M + SLICE_M * levels - LOWEST_M) / HEIGHT_STEP_M).astype(np.uint8)
        tiles[place] = np.stack([*bits, np.minimum(low, top), np.minimum(high, top)], axis=-1)
    return tiles


def _height(old: Counts, new: Counts) -> Counts:
    is_same = (old > 0) & (np.abs(old.astype(np.int16) - new) < _SAME_STEPS)
    return np.where((new == 0) | is_same, old, new)


def height_map(tiles: Mapping[tuple[int, int], Counts]) -> tuple[Array, version_grid.OccupancyGrid]:
    """Return (2, H, W) metres over the ground of the lowest and the highest surface, NaN if unseen, and their grid."""
    layers = []
    for layer in (2, 3):
        codes = version_grid.whole_grid(
            {place: cells[..., layer].view(np.int8) for place, cells in tiles.items()}, 0, is_cut=False
        )
        known = codes.cells.view(np.uint8).astype(np.float64)
        layers.append(np.where(known > 0, LOWEST_M + (known - 0.5) * HEIGHT_STEP_M, np.nan))
    return np.stack(layers), codes
