"""A site on one day, built and lit chunk by chunk as the robot comes near.

A chunk is one aisle wide and about four bays long. Near the camera chunks are detailed and lit with shadows, far away
plain. A chunk's look depends on site, seed and day alone, never on the order of visits.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.geometry import Array
from fleetsim.scene.building import HallMaker
from fleetsim.scene.faces import FaceBuilder, Faces
from fleetsim.scene.layout import Layout, mix
from fleetsim.scene.light import LAMP_REACH_M, LampField
from fleetsim.scene.racks import RackMaker
from fleetsim.textures.texture_set import paint_textures

LAMP_GROUPS = 3
NEAR_COLUMNS, NEAR_ROWS = 3, 2  # detailed chunks on each side of the camera's own
_CELL_M = 0.7
_PLAIN_LIGHT = 0.55  # plain chunks are lit without shadows
_MOST_BAKED_CHUNKS, _MOST_BUILT_CHUNKS, _MOST_SCENES = 128, 256, 3
_DECAL_CELLS = 64


LitFaces = tuple[Faces, NDArray[np.float32]]
"""Faces with their baked light (groups, samples), before lamps are weighted."""


@dataclass(frozen=True, slots=True)
class Scene:
    """All chunks as painted around one place, near ones detailed. Columns as in `Faces`.

    ranges (C, 2), bounds_m (C, 6): faces of each chunk and their bounding box.
    """

    quads: Array
    values: Array
    numbers: NDArray[np.int32]
    light: NDArray[np.float32]
    ranges: NDArray[np.int32]
    bounds_m: Array


class World:
    """One site with one day's stock. `workers` bake light; without them the calling thread does."""

    def __init__(
        self, layout: Layout, *, seed: int = 0, day: int = 0, workers: ThreadPoolExecutor | None = None
    ) -> None:
        self.layout, self.seed, self.day = layout, seed, day
        tags = tuple(sorted({marker[0] for marker in layout.markers}))
        alike = layout.are_aisles_identical
        self.textures = paint_textures(seed, layout.aisles, are_aisles_identical=alike, markers=tags)
        self._workers = workers
        self._hall = HallMaker(layout, self.textures, seed)
        self._racks = RackMaker(layout, self.textures, seed, day)
        columns, rows = layout.chunk_counts
        self._keys = [(column, row) for row in range(rows) for column in range(columns)]
        self._lamps = {key: self._hall.lamps(*key) for key in self._keys}
        every_lamp = [lamp for lamps in self._lamps.values() for lamp in lamps]
        self.lamps = LampField(every_lamp, layout.length_m * layout.width_m)
        self.decals = self._lay_decals()
        self.floor_numbers = np.array([self.textures.concrete_coarse, self.textures.dirt], np.int32)
        # The detailed version of a chunk, by column and row, without light.
        self.detailed_faces = lru_cache(_MOST_BUILT_CHUNKS)(lambda *key: self._build(key, is_plain=False))
        self._lit = lru_cache(_MOST_BAKED_CHUNKS)(lambda key: self._light(key, is_plain=False))
        self._plain = lru_cache(None)(lambda key: self._light(key, is_plain=True))
        self._scenes = lru_cache(_MOST_SCENES)(self._assemble)

    def scene_around(self, x_m: float, y_m: float) -> Scene:
        """The scene for a camera at (x, y) in map. Not for several threads at once."""
        return self._scenes(self.layout.chunk_at(x_m, y_m))

    def builder(self) -> FaceBuilder:
        """An empty builder that knows the site's textures."""
        return FaceBuilder(self.textures.atlas.table[:, :2], self.textures.stretched)

    def _lay_decals(self) -> NDArray[np.int32]:
        """(rows, columns) decal texture * 4 + quarter turns, -1 for none; the pattern repeats after 82 m."""
        cells = np.full((_DECAL_CELLS, _DECAL_CELLS), -1, np.int32)
        for row in range(_DECAL_CELLS):
            for column in range(_DECAL_CELLS):
                bits = mix(self.seed, 51, row, column)
                if bits % 10 < 8:
                    decal = self.textures.decals[(bits >> 8) % len(self.textures.decals)]
                    cells[row, column] = decal * 4 + ((bits >> 32) & 3)
        return cells

    def _build(self, key: tuple[int, int], *, is_plain: bool) -> Faces:
        layout, builder = self.layout, self.builder()
        column, row = key
        self._hall.add_chunk(builder, column, row)
        add = self._racks.add_plain_bay if is_plain else self._racks.add_bay
        middles_m = [layout.bay_x_m(bay) + layout.bay_m / 2 for bay in range(layout.bays)]
        own = {bay for bay, x_m in enumerate(middles_m) if layout.chunk_at(x_m, 0.0)[0] == column}
        for rack_row in (2 * row, 2 * row + 1):
            for first, behind in layout.rack_runs:
                for bay in sorted(own & set(range(first, behind))):
                    add(builder, rack_row, bay)
                if first in own:
                    self._racks.add_end_guards(builder, rack_row, first, is_far_end=False)
                if behind - 1 in own:
                    self._racks.add_end_guards(builder, rack_row, behind, is_far_end=True)
        for number, (x, y) in enumerate(layout.parked_pallets_m()):
            if layout.chunk_at(x, y) == key:
                self._racks.add_parked_pallet(builder, number, x, y)
        for number, (x, y) in enumerate(layout.packing_stations_m()):
            if layout.chunk_at(x, y) == key:
                self._racks.add_packing_station(builder, number, x, y)
        return builder.finish()

    def _neighbours(self, key: tuple[int, int], columns: int, rows: int) -> list[tuple[int, int]]:
        return [other for other in self._keys if abs(other[0] - key[0]) <= columns and abs(other[1] - key[1]) <= rows]

    def _light(self, key: tuple[int, int], *, is_plain: bool) -> LitFaces:
        """Light, of a detailed chunk with shadows from the boxes in it and the eight around it; further lamps are not counted."""
        boxes, shift = np.zeros((0, 8)), 0
        faces = self._build(key, is_plain=True) if is_plain else self.detailed_faces(*key)
        if not is_plain:
            parts = {other: self.detailed_faces(*other) for other in sorted(self._neighbours(key, 1, 1))}
            shift = sum(len(part.boxes) for other, part in parts.items() if other < key)
            boxes = np.concatenate([part.boxes for part in parts.values()])
        rectangles = np.array([self._hall.rectangle(*other) for other in self._neighbours(key, 1, 1)])
        low = np.array([rectangles[:, 0].min(), rectangles[:, 1].min(), 0.0]) - 0.5
        high = np.array([rectangles[:, 2].max(), rectangles[:, 3].max(), self.layout.ceiling_m]) + 0.5
        grid = core.BoxGrid(boxes, low, high, _CELL_M)
        light = np.zeros((LAMP_GROUPS, faces.light_samples), np.float32)
        near = [lamp for other in self._neighbours(key, 1, 1) for lamp in self._lamps[other]]
        lamps = np.array(near, np.float64).reshape(-1, 5)

        def bake(first: int, last: int) -> None:
            columns = (faces.quads[first:last], faces.numbers[first:last], faces.owners[first:last])
            grid.bake(*columns, shift, lamps, LAMP_REACH_M, not is_plain, light)

        cuts = np.searchsorted(faces.numbers[:, 3], faces.light_samples * np.arange(1, 4) / 4)
        edges = [0, *(int(cut) for cut in cuts), len(faces)]
        starts, ends = edges[:-1], edges[1:]
        list(self._workers.map(bake, starts, ends) if self._workers else map(bake, starts, ends))
        if is_plain:
            light *= _PLAIN_LIGHT
        return faces, light

    def _assemble(self, centre: tuple[int, int]) -> Scene:
        near = set(self._neighbours(centre, NEAR_COLUMNS, NEAR_ROWS))
        parts, lights = zip(*(self._lit(key) if key in near else self._plain(key) for key in self._keys), strict=True)
        counts = np.array([len(part) for part in parts])
        samples = np.array([part.light_samples for part in parts])
        ends, first_sample = np.cumsum(counts), np.concatenate([[0], np.cumsum(samples)[:-1]])
        numbers = np.concatenate([part.numbers for part in parts])
        numbers[:, 3] += np.repeat(first_sample, counts).astype(np.int32)
        return Scene(
            quads=np.concatenate([part.quads for part in parts]),
            values=np.concatenate([part.values for part in parts]),
            numbers=numbers,
            light=np.concatenate(lights, axis=1),
            ranges=np.stack([ends - counts, ends], axis=1).astype(np.int32),
            bounds_m=np.stack([part.bounds_m() for part in parts]),
        )
