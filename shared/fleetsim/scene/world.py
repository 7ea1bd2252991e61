"""A site on one day, built and lit chunk by chunk as the robot comes near; its light states, and the exposure of cameras in it.

A chunk is one aisle wide and about four bays long. Near the camera chunks are detailed and lit with shadows, far away
plain. A chunk's look depends on site, seed and day alone, never on the order of visits.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fleetmap import core
from fleetmap.geometry import Array, Array32
from fleetsim.scene.building import HallMaker, Lamp
from fleetsim.scene.faces import FaceBuilder, Faces
from fleetsim.scene.layout import Layout, mix
from fleetsim.scene.racks import RackMaker
from fleetsim.textures.texture_set import paint_textures

# Strength of the lamp groups: day lamps, night lamps, skylights and open docks.
LIGHT_STATES = {"day": (1.0, 1.0, 1.0), "evening": (1.0, 1.0, 0.08), "night": (0.0, 0.8, 0.01)}
LAMP_REACH_M = 14.0
GREY_PER_MS = 70.0  # grey levels per unit radiance and millisecond of exposure at gain 1
_AMBIENT_SHARE = 0.9  # of the unshadowed mean light on the ground
_MEAN_REFLECTANCE = 0.32
_TARGET_GREY, _EXPOSURES_S, _MOST_GAIN = 95.0, (0.0004, 0.010), 12.0  # of the automatic exposure
# Electrons behind a grey value at gain 1, and read noise before and after the amplifier
_ELECTRONS_PER_GREY, _READ_ELECTRONS, _AFTER_GAIN_GREY = 39.0, 5.0, 0.5


@dataclass(frozen=True, slots=True)
class Exposure:
    """Exposure time and gain of one picture."""

    time_s: float
    gain: float


def sensor_noise_of(gain: float) -> tuple[float, float]:
    """Shot noise, as variance per grey level, and read noise in grey levels. Source: EMVA Standard 1288, the linear camera model."""
    return gain / _ELECTRONS_PER_GREY, float(np.hypot(_AFTER_GAIN_GREY, gain * _READ_ELECTRONS / _ELECTRONS_PER_GREY))


class LampField:
    """All lamps of a site, to compute the light at a place without tracing rays."""

    def __init__(self, lamps: list[Lamp], floor_area_m2: float) -> None:
        table = np.array(lamps, np.float64).reshape(-1, 5)
        self._places, self._powers, self._groups = table[:, :3], table[:, 3], table[:, 4].astype(np.int64)
        self._ambient = np.zeros(3)
        for lamp in lamps:
            self._ambient[lamp.group] += _AMBIENT_SHARE * lamp.power * _floor_integral(lamp.z_m) / floor_area_m2

    def ambient(self, groups: Array) -> float:
        """Light that reaches every surface, one bounce crudely: a share of the mean light on the ground."""
        return float(groups @ self._ambient)

    def floor_light(self, groups: Array, x_m: float, y_m: float) -> float:
        """Unshadowed light on the ground at a place, ambient light included."""
        offsets = self._places - (x_m, y_m, 0.0)
        squared = np.einsum("ij,ij->i", offsets, offsets)
        near = squared < LAMP_REACH_M**2
        received = _received(squared[near], offsets[near, 2]) * self._powers[near] * groups[self._groups[near]]
        return float(received.sum()) + self.ambient(groups)


def _received(squared_m2: Array, height_m: Array) -> Array:
    """The lamp term of the baking, for a level surface below."""
    fade = 1.0 - squared_m2 / LAMP_REACH_M**2
    return np.asarray(np.maximum(height_m, 0.0) / np.sqrt(squared_m2) / (squared_m2 + 3.0) * fade / np.pi)


def _floor_integral(height_m: float) -> float:
    """Integral of the lamp term over the ground under a lamp of power 1."""
    radius = (np.arange(400) + 0.5) * LAMP_REACH_M / 400
    squared = radius**2 + height_m**2
    inside = squared < LAMP_REACH_M**2
    ring = 2 * np.pi * radius[inside] * LAMP_REACH_M / 400
    return float((_received(squared[inside], np.full(int(inside.sum()), height_m)) * ring).sum())


def auto_exposure(lamps: LampField, groups: Array, places_map: Array, forward_map: Array) -> Exposure:
    """Exposure from the light on the ground ahead, for recent camera places (N, 3) that looked along forward_map (N, 3).

    Stateless, so pictures can be made in any order.
    """
    ahead = np.concatenate([places_map + reach * forward_map for reach in (1.0, 3.0, 6.0)])
    seen = np.mean([lamps.floor_light(groups, float(x), float(y)) for x, y, _ in ahead])
    wanted_s = _TARGET_GREY / (GREY_PER_MS * 1e3 * max(_MEAN_REFLECTANCE * float(seen), 1e-4))
    time_s = float(np.clip(wanted_s, *_EXPOSURES_S))
    return Exposure(time_s, float(np.clip(wanted_s / time_s, 1.0, _MOST_GAIN)))


LAMP_GROUPS = 3
NEAR_COLUMNS, NEAR_ROWS = 3, 2  # detailed chunks on each side of the camera's own
_CELL_M = 0.7
_PLAIN_LIGHT = 0.55  # plain chunks are lit without shadows
_MOST_BAKED_CHUNKS, _MOST_BUILT_CHUNKS, _MOST_SCENES = 128, 256, 3
_DECAL_CELLS = 64


LitFaces = tuple[Faces, Array32]
"""Faces with their baked light (groups, samples), before lamps are weighted."""


@dataclass(frozen=True, slots=True)
class Scene:
    """All chunks as painted around one place, near ones detailed. Columns as in `Faces`.

    ranges (C, 2), bounds_m (C, 6): faces of each chunk and their bounding box.
    """

    quads: Array
    values: Array
    numbers: NDArray[np.int32]
    light: Array32
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
