"""The plan of a warehouse: sizes, counts, rates and positions; and the content of each slot on each day."""

from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np

from fleetmap.config import Section

Rectangle = tuple[float, float, float, float]  # x_min, y_min, x_max, y_max in map, metres


class Layout(Section, frozen=True):
    """Parallel aisles along x, rack rows on both sides of each, open ground at both ends.

    dock_m: further ground at low x, with packing stations between the docks and the racks. cross_bays: bays omitted in
    every row, which form cross aisles.

    has_landmarks: posters, columns with signs, marked docks, all different. are_aisles_identical: stock, labels and
    ground repeat from aisle to aisle (until a slot is restocked), so that only geometry and context tell them apart.
    restock_per_day: share of slots. moved_rows: rack rows that deviate from the plan: number, and metres along y. markers: AprilTags
    (36h11) of marker_m: number, x, y, z of the middle, and yaw of the direction that they face.
    """

    aisles: int = 3
    bays: int = 4
    levels: int = 4
    aisle_width_m: float = 2.8
    end_m: float = 6.0
    dock_m: float = 0.0
    cross_bays: tuple[int, ...] = ()
    has_landmarks: bool = True
    are_aisles_identical: bool = False
    restock_per_day: float = 0.125
    empty_share: float = 0.1
    moved_rows: tuple[tuple[int, float], ...] = ()
    markers: tuple[tuple[int, float, float, float, float], ...] = ()

    bay_m: ClassVar[float] = 2.7
    marker_m: ClassVar[float] = 0.2
    rack_depth_m: ClassVar[float] = 1.1
    margin_m: ClassVar[float] = 1.0
    ceiling_m: ClassVar[float] = 7.5
    shelf_heights_m: ClassVar[tuple[float, ...]] = (0.0, 1.5, 2.95, 4.4)
    bays_per_chunk: ClassVar[int] = 4

    @property
    def pitch_m(self) -> float:
        """From one aisle to the next."""
        return self.aisle_width_m + 2 * self.rack_depth_m

    @property
    def length_m(self) -> float:
        """Of the hall, along x."""
        return self.dock_m + 2 * self.end_m + self.bays * self.bay_m

    @property
    def width_m(self) -> float:
        """Of the hall, along y."""
        return 2 * self.margin_m + self.aisles * self.pitch_m

    @property
    def rack_top_m(self) -> float:
        """Height of the uprights."""
        return self.shelf_heights_m[self.levels - 1] + 1.3

    @property
    def rows(self) -> int:
        """Rack rows, two per aisle: even ones at larger y, odd ones at smaller y than their aisle."""
        return 2 * self.aisles

    def aisle_y_m(self, aisle: int) -> float:
        """Centre line of an aisle."""
        return self.margin_m + self.pitch_m * (aisle + 0.5)

    def row_y_m(self, row: int) -> float:
        """Centre line of a rack row."""
        side = -1.0 if row % 2 else 1.0
        moved_m = dict(self.moved_rows).get(row, 0.0)
        return self.aisle_y_m(row // 2) + side * (self.aisle_width_m + self.rack_depth_m) / 2 + moved_m

    def bay_x_m(self, bay: int) -> float:
        """Low x of a bay."""
        return self.dock_m + self.end_m + bay * self.bay_m

    @property
    def rack_runs(self) -> list[tuple[int, int]]:
        """Runs of a rack row between cross aisles: first bay, and the bay after the last one."""
        edges = pairwise((-1, *sorted(self.cross_bays), self.bays))
        return [(before + 1, behind) for before, behind in edges if behind > before + 1]

    @property
    def chunk_length_m(self) -> float:
        """Of a chunk, along x: about four bays."""
        return self.length_m / self.chunk_counts[0]

    @property
    def chunk_counts(self) -> tuple[int, int]:
        """Chunks along x and y; a chunk is one aisle wide."""
        return max(1, round(self.length_m / (self.bays_per_chunk * self.bay_m))), self.aisles

    def chunk_at(self, x_m: float, y_m: float) -> tuple[int, int]:
        """The chunk that holds a point; points outside belong to the nearest one."""
        columns, rows = self.chunk_counts
        column = int(x_m // self.chunk_length_m)
        row = int((y_m - self.margin_m) // self.pitch_m)
        return min(max(column, 0), columns - 1), min(max(row, 0), rows - 1)

    def solid_rectangles(self) -> list[Rectangle]:
        """Ground that no robot may enter: rack rows with their end guards, columns, pallets, packing stations."""
        runs = [(self.bay_x_m(first) - 0.2, self.bay_x_m(behind) + 0.2) for first, behind in self.rack_runs]
        half = self.rack_depth_m / 2
        rows_m = [self.row_y_m(row) for row in range(self.rows)]
        racks = [(start, y - half, end, y + half) for y in rows_m for start, end in runs]
        columns = [(x - 0.2, y - 0.2, x + 0.2, y + 0.2) for x, y in self.columns_m()]
        pallets = [(x - 0.45, y - 0.65, x + 0.45, y + 0.65) for x, y in self.parked_pallets_m()]
        return racks + columns + pallets + [(x - 0.5, y - 1.0, x + 0.5, y + 1.0) for x, y in self.packing_stations_m()]

    def packing_stations_m(self) -> list[tuple[float, float]]:
        """Centres of the packing stations, in two lines along the racks on the docks' side."""
        lines = [share * self.dock_m for share in (0.55, 0.8)] if self.dock_m > 0 else []
        return [(x, self.aisle_y_m(aisle)) for x in lines for aisle in range(self.aisles)]

    def parked_pallets_m(self) -> list[tuple[float, float]]:
        """Centres of the pallets along the end walls, two beside each aisle's line; none without landmarks."""
        if not self.has_landmarks:
            return []
        offsets = (-0.5 * self.aisle_width_m - 0.1, 0.5 * self.aisle_width_m + 0.1)
        return [
            (x, self.aisle_y_m(aisle) + y)
            for x in (0.6, self.length_m - 0.6)
            for aisle in range(self.aisles)
            for y in offsets
        ]

    def columns_m(self) -> list[tuple[float, float]]:
        """Feet of the columns, near the end walls in line with the racks' backs."""
        lines = [
            min(max(self.margin_m + self.pitch_m * row, 0.6), self.width_m - 0.6) for row in range(self.aisles + 1)
        ]
        return [(x, y) for x in (1.2, self.length_m - 1.2) for y in lines]


_MASK = (1 << 64) - 1
_TAG_RESTOCK, _TAG_CONTENT = 77, 7


@dataclass(frozen=True, slots=True)
class Slot:
    """A place for goods: rack row, bay, level."""

    row: int
    bay: int
    level: int

    def number(self, layout: Layout) -> int:
        """Unique in the site."""
        return (self.row * layout.bays + self.bay) * layout.levels + self.level


def mix(*values: int) -> int:
    """64 well mixed bits of the values: splitmix64 applied to each in turn. Python integers, so the same everywhere."""
    state = 0
    for value in values:
        state = (state + value + 0x9E3779B97F4A7C15) & _MASK
        state = ((state ^ (state >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
        state = ((state ^ (state >> 27)) * 0x94D049BB133111EB) & _MASK
        state ^= state >> 31
    return state


def last_restock_day(layout: Layout, seed: int, day: int, slot: Slot) -> int:
    """The last day up to `day` on which the slot was restocked; 0 if it was not."""
    number, least = slot.number(layout), layout.restock_per_day * 2.0**64
    return next((past for past in range(day, 0, -1) if mix(seed, _TAG_RESTOCK, number, past) < least), 0)


def slot_generator(layout: Layout, seed: int, day: int, slot: Slot) -> np.random.Generator:
    """Random generator of the slot's content on `day`: the same until the slot is restocked.

    With identical aisles a slot that was never restocked has the content of its fellow in every other aisle.
    """
    restocked = last_restock_day(layout, seed, day, slot)
    if layout.are_aisles_identical and restocked == 0:
        slot = Slot(slot.row % 2, slot.bay, slot.level)
    return np.random.default_rng([seed, _TAG_CONTENT, slot.number(layout), restocked])
