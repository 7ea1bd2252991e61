"""The hall of one chunk: ground with markings, walls, roof, lamps, columns, docks, signs."""

from typing import NamedTuple

import numpy as np

from fleetsim.scene.faces import MATERIAL_FLOOR, MATERIAL_LAMP, NO_BOTTOM, FaceBuilder, Surface
from fleetsim.scene.layout import Layout, Rectangle, mix
from fleetsim.textures.painting import MARGIN_SHARE, TEXEL_M
from fleetsim.textures.texture_set import Textures

GROUP_DAY, GROUP_NIGHT, GROUP_SKY = 0, 1, 2  # lamp groups that are switched together
LAMPS_PER_CHUNK = 3
LAMP_POWER, SKYLIGHT_POWER, DOCK_POWER = 20.0, 26.0, 30.0
_TAG_HALL, _TAG_POSTER = 41, 42
_DOCK_HEIGHT_M, _DOCK_HALF_WIDTH_M = 3.2, 1.2


class Lamp(NamedTuple):
    """A light source for baking: place in map, power, lamp group."""

    x_m: float
    y_m: float
    z_m: float
    power: float
    group: int


class HallMaker:
    """Adds the hall's surfaces of single chunks to a builder."""

    def __init__(self, layout: Layout, textures: Textures, seed: int) -> None:
        self._layout, self._textures, self._seed = layout, textures, seed

    def rectangle(self, column: int, row: int) -> Rectangle:
        """The chunk's ground; the outer ones reach to the walls."""
        layout = self._layout
        columns, rows = layout.chunk_counts
        x_max = layout.length_m if column == columns - 1 else (column + 1) * layout.chunk_length_m
        y_min = 0.0 if row == 0 else layout.margin_m + row * layout.pitch_m
        y_max = layout.width_m if row == rows - 1 else layout.margin_m + (row + 1) * layout.pitch_m
        return column * layout.chunk_length_m, y_min, x_max, y_max

    def add_chunk(self, builder: FaceBuilder, column: int, row: int) -> None:
        """Add all parts of the hall in the chunk."""
        self._add_floor_quad(builder, self.rectangle(column, row), 0.0, self._textures.concrete, row)
        self._add_markings(builder, column, row)
        self._add_walls(builder, column, row)
        self._add_roof(builder, column, row)
        self._add_lamps(builder, column, row)
        if self._layout.has_landmarks:
            self._add_posters(builder, column, row)
            if self._has_dock(column, row):
                self._add_dock(builder, row)
        self._add_columns(builder, column, row)
        self._add_signs(builder, column, row)
        self._add_markers(builder, column, row)

    def lamps(self, column: int, row: int) -> list[Lamp]:
        """The light sources in the chunk."""
        layout, (x_min, _, x_max, _) = self._layout, self.rectangle(column, row)
        y = layout.aisle_y_m(row)
        lamps = [Lamp(x, y, layout.ceiling_m - 0.8, LAMP_POWER, group) for x, group in self._lamp_places(column, row)]
        sky_y = y + 0.3 * layout.pitch_m
        lamps.append(Lamp((x_min + x_max) / 2, sky_y, layout.ceiling_m - 0.05, SKYLIGHT_POWER, GROUP_SKY))
        if layout.has_landmarks and self._has_dock(column, row) and self._is_dock_open(row):
            lamps += [Lamp(0.4, y, z, DOCK_POWER, GROUP_SKY) for z in (0.8, 2.0)]
        return lamps

    def _scramble(self, column: int, row: int, number: int) -> int:
        return mix(self._seed, _TAG_HALL, column, 0 if self._layout.are_aisles_identical else row, number) >> 40

    def _add_floor_quad(self, builder: FaceBuilder, rectangle: Rectangle, z_m: float, texture: int, row: int) -> None:
        x_min, y_min, x_max, y_max = rectangle
        # Concrete's texels at the corner, so that tiles join seamlessly; per aisle if aisles are identical
        base = self._layout.margin_m + row * self._layout.pitch_m if self._layout.are_aisles_identical else 0.0
        offset_texels = x_min / TEXEL_M, (self._layout.width_m + 10.0 - (y_max - base)) / TEXEL_M
        surface = Surface(texture, material=MATERIAL_FLOOR, offset_texels=offset_texels)
        builder.add_quad((x_min, y_max, z_m), (x_max - x_min, 0, 0), (0, y_min - y_max, 0), surface)

    def _add_markings(self, builder: FaceBuilder, column: int, row: int) -> None:
        """Lane lines along the racks, a stop line across each aisle mouth; 2 mm above the ground."""
        layout, (x_min, _, x_max, _) = self._layout, self.rectangle(column, row)
        y, half = layout.aisle_y_m(row), layout.aisle_width_m / 2 - 0.15
        x_first, x_last = layout.bay_x_m(0) - 0.5, layout.bay_x_m(layout.bays) + 0.5
        start, end = max(x_min, x_first), min(x_max, x_last)
        if end > start:
            for side in (-half, half):
                line = (start, y + side - 0.05, end, y + side + 0.05)
                self._add_floor_quad(builder, line, 0.002, self._textures.paint, row)
        for x in (x_first - 0.3, x_last + 0.3):
            if x_min <= x < x_max:
                self._add_floor_quad(builder, (x - 0.1, y - half, x + 0.1, y + half), 0.002, self._textures.paint, row)

    def _add_walls(self, builder: FaceBuilder, column: int, row: int) -> None:
        layout, (x_min, y_min, x_max, y_max) = self._layout, self.rectangle(column, row)
        columns, rows = layout.chunk_counts
        top = layout.ceiling_m
        walls = (
            (row == 0, (x_max, 0.0), (x_min - x_max, 0.0)),
            (row == rows - 1, (x_min, layout.width_m), (x_max - x_min, 0.0)),
            (column == 0, (0.0, y_min), (0.0, y_max - y_min)),
            (column == columns - 1, (layout.length_m, y_max), (0.0, y_min - y_max)),
        )
        spans = [(start, along) for is_outer, start, along in walls if is_outer]
        for number, ((x, y), (along_x, along_y)) in enumerate(spans):
            surface = Surface(self._textures.wall, 0.9, self._scramble(column, row, number))
            builder.add_quad((x, y, top), (along_x, along_y, 0), (0, 0, -top), surface)

    def _add_roof(self, builder: FaceBuilder, column: int, row: int) -> None:
        layout, textures = self._layout, self._textures
        x_min, y_min, x_max, y_max = self.rectangle(column, row)
        top, middle_x, middle_y = layout.ceiling_m, (x_min + x_max) / 2, (y_min + y_max) / 2
        length, width = x_max - x_min, y_max - y_min
        scramble = self._scramble(column, row, 10)
        builder.add_quad((x_min, y_min, top), (length, 0, 0), (0, width, 0), Surface(textures.dark, scramble=scramble))
        beam = Surface(textures.grey, 0.8, scramble + 1)
        for x in (x_min + length / 4, x_max - length / 4):
            builder.add_box((x, middle_y, top - 0.25), (0.1, width / 2, 0.2), beam, sides="xXz")
        duct = Surface(textures.grey, 1.1, scramble)
        builder.add_box((middle_x, y_min + 0.6, top - 0.45), (length / 2, 0.12, 0.1), duct, sides="yYz")
        sky_y = layout.aisle_y_m(row) + 0.3 * layout.pitch_m
        skylight = Surface(textures.lamp, material=MATERIAL_LAMP, emission=14.0, group=GROUP_SKY)
        builder.add_quad((middle_x - 1, sky_y - 0.6, top - 0.01), (2, 0, 0), (0, 1.2, 0), skylight)

    def _lamp_places(self, column: int, row: int) -> list[tuple[float, int]]:
        x_min, _, x_max, _ = self.rectangle(column, row)
        places = []
        for number in range(LAMPS_PER_CHUNK):
            stagger = 0 if self._layout.are_aisles_identical else 2 * row
            is_night = (column * LAMPS_PER_CHUNK + number + stagger) % 4 == 0
            x = x_min + (number + 0.5) * (x_max - x_min) / LAMPS_PER_CHUNK
            places.append((x, GROUP_NIGHT if is_night else GROUP_DAY))
        return places

    def _add_lamps(self, builder: FaceBuilder, column: int, row: int) -> None:
        y, z = self._layout.aisle_y_m(row), self._layout.ceiling_m
        textures = self._textures
        for x, group in self._lamp_places(column, row):
            lamp = Surface(textures.lamp, material=MATERIAL_LAMP, emission=9.0, group=group)
            builder.add_box((x, y, z - 0.75), (0.75, 0.12, 0.05), lamp, sides="z", is_solid=False)
            builder.add_box((x, y, z - 0.74), (0.77, 0.14, 0.06), Surface(textures.grey), sides="xXyY", is_solid=False)

    def _has_dock(self, column: int, row: int) -> bool:
        return column == 0 and row % 2 == 0

    def _is_dock_open(self, row: int) -> bool:
        return row % 4 == 0

    def _add_dock(self, builder: FaceBuilder, row: int) -> None:
        """A dock door in the wall at x = 0: open ones glow by day. Hazard-striped posts beside it."""
        y, textures = self._layout.aisle_y_m(row), self._textures
        half = _DOCK_HALF_WIDTH_M
        emission = 6.0 if self._is_dock_open(row) else 0.9
        door = Surface(textures.lamp, material=MATERIAL_LAMP, emission=emission, group=GROUP_SKY)
        builder.add_quad((0.02, y - half, _DOCK_HEIGHT_M), (0, 2 * half, 0), (0, 0, -_DOCK_HEIGHT_M), door)
        for number, side in enumerate((-half - 0.2, half + 0.2)):
            post = Surface(textures.hazard, scramble=self._scramble(0, row, 20 + number))
            builder.add_box((0.1, y + side, _DOCK_HEIGHT_M / 2), (0.1, 0.15, _DOCK_HEIGHT_M / 2), post, sides="XyYZ")

    def _add_posters(self, builder: FaceBuilder, column: int, row: int) -> None:
        """Notices on the outer walls, 15 mm in front, all placed by the seed."""
        layout, (x_min, y_min, x_max, y_max) = self._layout, self.rectangle(column, row)
        columns, rows = layout.chunk_counts
        for number in range(8):
            bits = mix(self._seed, _TAG_POSTER, column, row, number)
            share, up = (bits & 0xFFFF) / 0xFFFF, 1.3 + 1.9 * ((bits >> 16) & 0xFFFF) / 0xFFFF
            side = 0.5 + 0.12 * ((bits >> 32) & 0xFF) / 0xFF
            x = x_min + 0.4 + share * (x_max - x_min - side - 0.8)
            y = y_min + 0.4 + share * (y_max - y_min - side - 0.8)
            texture = self._textures.posters[(bits >> 40) % len(self._textures.posters)]
            is_there, place, along = (
                (row == 0, (x + side, 0.015), (-side, 0)),
                (row == rows - 1, (x, layout.width_m - 0.015), (side, 0)),
                (column == columns - 1, (layout.length_m - 0.015, y + side), (0, -side)),
                (column == 0 and not self._has_dock(column, row), (0.015, y), (0, side)),
            )[number % 4]
            if is_there:
                builder.add_quad((*place, up), (*along, 0), (0.0, 0.0, -side), Surface(texture, scramble=bits >> 44))

    def _add_columns(self, builder: FaceBuilder, column: int, row: int) -> None:
        layout, textures = self._layout, self._textures
        for number, (x, y) in enumerate(layout.columns_m()):
            if layout.chunk_at(x, y) != (column, row):
                continue
            scramble = self._scramble(column, row, 30)
            half = layout.ceiling_m / 2
            shaft, guard = Surface(textures.grey, 1.2, scramble), Surface(textures.hazard, scramble=scramble)
            builder.add_box((x, y, half), (0.18, 0.18, half), shaft, sides="xXyY")
            builder.add_box((x, y, 0.45), (0.2, 0.2, 0.45), guard, sides=NO_BOTTOM)
            if layout.has_landmarks:
                plates = ((0.185, -0.2, 0.4, 2.2, 3 * number + 1), (-0.185, 0.2, -0.4, 1.9, 3 * number + 2))
                for dx, dy, span, height, poster in plates:
                    plate = Surface(textures.posters[poster % len(textures.posters)], scramble=scramble)
                    builder.add_quad((x + dx, y + dy, height), (0, span, 0), (0, 0, -0.4), plate)

    def _add_markers(self, builder: FaceBuilder, column: int, row: int) -> None:
        """AprilTags with their white margin."""
        half = self._layout.marker_m / 2 * (1 + 2 * MARGIN_SHARE)
        for number, x, y, z, yaw_rad in self._layout.markers:
            if self._layout.chunk_at(x, y) == (column, row):
                right_x, right_y = -np.sin(yaw_rad) * half, np.cos(yaw_rad) * half
                edge = (2 * right_x, 2 * right_y, 0.0)
                surface = Surface(self._textures.markers[number])
                builder.add_quad((x - right_x, y - right_y, z + half), edge, (0.0, 0.0, -2 * half), surface)

    def _add_signs(self, builder: FaceBuilder, column: int, row: int) -> None:
        """The aisle's number, hanging over both of its mouths."""
        layout, sign = self._layout, Surface(self._textures.signs[row])
        for x in (layout.bay_x_m(0) - 0.6, layout.bay_x_m(layout.bays) + 0.6):
            if layout.chunk_at(x, layout.aisle_y_m(row))[0] == column:
                builder.add_box((x, layout.aisle_y_m(row), 4.6), (0.03, 0.32, 0.32), sign)
