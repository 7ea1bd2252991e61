"""The landmarks of a world, chunk by chunk, and those that each stretch of a drive can see."""

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fleetmap.core import BoxGrid
from fleetmap.geometry import Array, se3_inverse
from fleetsim.scene.world import NEAR_COLUMNS, NEAR_ROWS, World
from support.estimator.landmark_lattice import Viewpoint, seed_landmarks, visible_from
from support.estimator.statistics import PITCH_PX

CELLS_M = np.array([0.08, 0.16, 0.32, 0.64, 1.28])  # lattice spacings: with distance coarser ones take over
_LARGEST = 1.4  # of the size drawn for a cell, see seed_landmarks
_OCTAVE_SPAN = 1.2**8
_GRID_M = 0.7
_MOST_CHUNKS, _MOST_GRIDS = 160, 32  # that are kept: an aisle of a large site with those around it takes 75 chunks
_RICH_CONTRAST = 9.0  # grey steps per centimetre from which on every cell holds a corner


@dataclass(frozen=True, slots=True)
class Landmarks:
    """N corners on surfaces, by rising cell size.

    points_map, normals_map (N, 3); sizes_m (N,): extent, which decides from how far away they are seen; keys (N, 3)
    uint64: what it looks like, what dirt lies on it, its id. firsts (levels,): first row of each cell size.
    """

    points_map: Array
    normals_map: Array
    sizes_m: Array
    keys: NDArray[np.uint64]
    firsts: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.sizes_m)

    def take(self, rows: NDArray[np.integer]) -> "Landmarks":
        """Those rows, as one piece."""
        return Landmarks(
            self.points_map[rows], self.normals_map[rows], self.sizes_m[rows], self.keys[rows], np.zeros(1, np.int64)
        )


class LandmarkField:
    """Landmarks of a world's near chunks, made when first asked for. Far, plain chunks hold none."""

    def __init__(self, world: World, remembered: int = 0) -> None:
        """remembered: answers of `seen_from` that are kept, for several runs along one way."""
        self._world = world
        self._remembered = remembered
        self._seen: OrderedDict[bytes, Landmarks] = OrderedDict()
        self._weights = _texture_weights(world)
        self._chunks: OrderedDict[tuple[int, int], Landmarks] = OrderedDict()
        self._bounds: dict[tuple[int, int], Array] = {}
        self._grids: OrderedDict[tuple[int, int], tuple[list[tuple[int, int]], BoxGrid]] = OrderedDict()

    def chunk(self, column: int, row: int) -> Landmarks:
        """All landmarks of a chunk."""
        key = (column, row)
        if key not in self._chunks:
            faces = self._world.detailed_faces(column, row)
            columns = (faces.quads, faces.values, faces.numbers, self._weights)
            parts = [seed_landmarks(*columns, cell_m) for cell_m in CELLS_M.tolist()]
            firsts = np.cumsum([0] + [len(part[0]) for part in parts[:-1]])
            points, normals, sizes, keys = (np.concatenate(column) for column in zip(*parts, strict=True))
            self._chunks[key] = Landmarks(points, normals, sizes, keys, firsts)
            self._bounds[key] = faces.bounds_m()
            if len(self._chunks) > _MOST_CHUNKS:
                self._chunks.popitem(last=False)
        self._chunks.move_to_end(key)
        return self._chunks[key]

    def seen_from(self, map_from_cam: Array, focal_px: float, widest: Array) -> Landmarks:
        """Landmarks that a camera there may see: in a cone |x/z|, |y/z| < widest (2,), near enough, with nothing between."""
        key = np.concatenate([map_from_cam.ravel(), [focal_px], widest]).tobytes()
        if key not in self._seen:
            self._seen[key] = self._look_from(map_from_cam, focal_px, widest)
        self._seen.move_to_end(key)
        seen = self._seen[key]
        if len(self._seen) > self._remembered:
            self._seen.popitem(last=False)
        return seen

    def _look_from(self, map_from_cam: Array, focal_px: float, widest: Array) -> Landmarks:
        centre, reach_per_m = np.ascontiguousarray(map_from_cam[:3, 3]), focal_px / PITCH_PX
        cam_from_map = np.ascontiguousarray(se3_inverse(map_from_cam)[:3, :3])
        view = Viewpoint(cam_from_map, centre, reach_per_m, widest, _OCTAVE_SPAN)
        keys, grid = self._boxes_around(centre)
        found: list[Landmarks] = []
        for key in keys:
            chunk = self.chunk(*key)
            low, high = self._bounds[key][:3], self._bounds[key][3:]
            gap_m = np.linalg.norm(np.maximum(np.maximum(low - centre, centre - high), 0.0))
            reaching = np.flatnonzero(CELLS_M * _LARGEST * reach_per_m > gap_m)
            if not len(chunk) or not len(reaching):
                continue
            first, columns = int(chunk.firsts[reaching[0]]), (chunk.points_map, chunk.normals_map, chunk.sizes_m)
            found.append(chunk.take(visible_from(first, *columns, view, grid)))
        return joined(found)

    def _boxes_around(self, centre: Array) -> tuple[list[tuple[int, int]], BoxGrid]:
        """The chunks around the chunk that holds a place, and a grid of their boxes."""
        layout = self._world.layout
        middle = layout.chunk_at(float(centre[0]), float(centre[1]))
        if middle not in self._grids:
            columns, rows = layout.chunk_counts
            keys = [
                (column, row)
                for row in range(max(0, middle[1] - NEAR_ROWS), min(rows, middle[1] + NEAR_ROWS + 1))
                for column in range(max(0, middle[0] - NEAR_COLUMNS), min(columns, middle[0] + NEAR_COLUMNS + 1))
            ]
            boxes = np.concatenate([self._world.detailed_faces(*key).boxes for key in keys])
            high = np.array([layout.length_m, layout.width_m, layout.ceiling_m]) + 1.0
            near_low = np.maximum(-1.0, np.append(centre[:2] - 40.0, -1.0))
            near_high = np.minimum(high, np.append(centre[:2] + 40.0, high[2]))
            self._grids[middle] = keys, BoxGrid(boxes, near_low, near_high, _GRID_M)
            if len(self._grids) > _MOST_GRIDS:
                self._grids.popitem(last=False)
        return self._grids[middle]


def joined(parts: list[Landmarks]) -> Landmarks:
    """All of them by rising id."""
    if not parts:
        return Landmarks(
            np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3), np.uint64), np.zeros(1, np.int64)
        )
    columns = ("points_map", "normals_map", "sizes_m", "keys")
    whole = Landmarks(*(np.concatenate([getattr(p, name) for p in parts]) for name in columns), np.zeros(1, np.int64))
    return whole.take(np.argsort(whole.keys[:, 2], kind="stable"))


def _texture_weights(world: World) -> Array:
    """(T,) share of lattice cells that hold a corner: by the texture's contrast at a centimetre's scale."""
    atlas, weights = world.textures.atlas, []
    for row in atlas.table:
        level = int(min(2, row[0], row[1]))
        width, height = 1 << int(row[0] - level), 1 << int(row[1] - level)
        first = int(row[2 + level])
        texels = atlas.texels[first : first + width * height].reshape(height, width).astype(np.float64)
        steps = [np.abs(np.diff(texels, axis=axis)).mean() if texels.shape[axis] > 1 else 0.0 for axis in range(2)]
        weights.append(np.clip(max(steps) / _RICH_CONTRAST, 0.05, 1.0))
    return np.array(weights)
