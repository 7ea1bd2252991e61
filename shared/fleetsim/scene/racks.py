"""Rack rows with their goods: the detailed version for near chunks, a plain one for far chunks."""

import numpy as np

from fleetsim.scene.faces import NO_BOTTOM, FaceBuilder, Surface
from fleetsim.scene.layout import Layout, Slot, mix, slot_generator
from fleetsim.textures.texture_set import RACK_LABELS, Sku, Textures

_TAG_RACK, _TAG_LABEL = 31, 32


class RackMaker:
    """Adds bays of one site on one day to a builder."""

    def __init__(self, layout: Layout, textures: Textures, seed: int, day: int) -> None:
        self._layout, self._textures, self._seed, self._day = layout, textures, seed, day

    def add_bay(self, builder: FaceBuilder, row: int, bay: int) -> None:
        """Add one bay: the frame at its low x (and high x for the last one of a run), shelves, labels, goods."""
        self._add_frame(builder, row, bay)
        if bay == self._layout.bays - 1 or bay + 1 in self._layout.cross_bays:
            self._add_frame(builder, row, bay + 1)
        for level in range(self._layout.levels):
            if level:
                self._add_shelf(builder, row, bay, level)
            self._add_goods(builder, Slot(row, bay, level))

    def add_plain_bay(self, builder: FaceBuilder, row: int, bay: int) -> None:
        """Add a bay to be seen from afar: one block of cartons per slot, beams, posts."""
        layout, textures = self._layout, self._textures
        x, y = layout.bay_x_m(bay), layout.row_y_m(row)
        depth = layout.rack_depth_m / 2
        post = (0.05, depth, layout.rack_top_m / 2)
        surface = Surface(textures.uprights[0])
        builder.add_box((x, y, layout.rack_top_m / 2), post, surface, sides="yY", is_solid=False)
        for level, height in enumerate(layout.shelf_heights_m[: layout.levels]):
            rng = slot_generator(layout, self._seed, self._day, Slot(row, bay, level))
            if level:
                beam = (layout.bay_m / 2, depth - 0.03, 0.06)
                centre, surface = (x + layout.bay_m / 2, y, height - 0.07), Surface(textures.beams[0], 0.75)
                builder.add_box(centre, beam, surface, sides="yYZ", is_solid=False)
            if rng.random() < layout.empty_share:
                continue
            sku = textures.skus[int(rng.integers(0, len(textures.skus)))]
            centre, half = (x + layout.bay_m / 2, y, height + 0.47), (layout.bay_m / 2 - 0.1, 0.4, 0.45)
            surface = Surface(sku.front, scramble=mix(self._seed, row, bay, level) >> 40)
            builder.add_box(centre, half, surface, sides=NO_BOTTOM, is_solid=False)

    def add_end_guards(self, builder: FaceBuilder, row: int, bay: int, *, is_far_end: bool) -> None:
        """The hazard-striped guard where a run ends, at the low x of a bay, with a poster on the frame if the site has landmarks."""
        layout, textures = self._layout, self._textures
        x = layout.bay_x_m(bay) + (0.12 if is_far_end else -0.12)
        y, half = layout.row_y_m(row), layout.rack_depth_m / 2
        inner = bay if 0 < bay < layout.bays else 0
        scramble = self._scramble(_TAG_RACK, row, 900 + is_far_end + 2 * inner)
        builder.add_box((x, y, 0.25), (0.06, half, 0.25), Surface(textures.hazard, scramble=scramble), sides=NO_BOTTOM)
        if layout.has_landmarks:
            side, plate = 0.275, x + (0.095 if is_far_end else -0.095)
            sign = 1.0 if is_far_end else -1.0
            poster = Surface(
                textures.posters[(row * 2 + is_far_end + 5 * inner) % len(textures.posters)], scramble=scramble
            )
            builder.add_quad((plate, y - sign * side, 2.0), (0, sign * 2 * side, 0), (0, 0, -2 * side), poster)

    def add_packing_station(self, builder: FaceBuilder, number: int, x_m: float, y_m: float) -> None:
        """A bench with a shelf above it, and the day's cartons on both."""
        textures = self._textures
        rng = slot_generator(self._layout, self._seed, self._day, Slot(self._layout.rows + 1000 + number, 0, 0))
        wood, grey = Surface(textures.wood, scramble=int(rng.integers(0, 1 << 24))), Surface(textures.grey)
        builder.add_box((x_m, y_m, 0.87), (0.4, 0.9, 0.03), wood)
        builder.add_box((x_m - 0.3, y_m, 1.6), (0.1, 0.9, 0.02), grey)
        for side in (-0.85, 0.85):
            builder.add_box((x_m, y_m + side, 0.42), (0.38, 0.03, 0.42), grey)
            builder.add_box((x_m - 0.35, y_m + side, 1.25), (0.03, 0.03, 0.38), grey)
        for base_m in (0.9, 1.62):
            y = y_m - 0.8
            while True:
                sku = textures.skus[int(rng.integers(0, len(textures.skus)))]
                if y + sku.width_m > y_m + 0.8:
                    break
                half = (0.15, sku.width_m / 2, sku.height_m / 2)
                surface = Surface(sku.sides("xX"), rng.uniform(0.8, 1.2), int(rng.integers(0, 1 << 24)))
                builder.add_box((x_m - 0.2, y + half[1], base_m + half[2]), half, surface, yaw_rad=rng.normal(0, 0.03))
                y += sku.width_m + rng.uniform(0.05, 0.4)

    def add_parked_pallet(self, builder: FaceBuilder, number: int, x_m: float, y_m: float) -> None:
        """A pallet with a stack of cartons on the ground by an end wall; changes as often as a slot."""
        layout, textures = self._layout, self._textures
        rng = slot_generator(layout, self._seed, self._day, Slot(layout.rows + number, 0, 0))
        pallet = Surface(textures.wood, scramble=int(rng.integers(0, 1 << 24)))
        builder.add_box((x_m, y_m, 0.07), (0.4, 0.6, 0.07), pallet)
        sku = textures.skus[int(rng.integers(0, len(textures.skus)))]
        for layer in range(int(rng.integers(1, 5))):
            z = 0.14 + (layer + 0.5) * sku.height_m + 0.002 * layer
            for side in (-1, 1):
                centre = (x_m + rng.uniform(-0.03, 0.03), y_m + side * (sku.width_m / 2 + 0.01), z)
                half = (0.36, sku.width_m / 2, sku.height_m / 2)
                yaw, scramble = rng.normal(0, 0.015), int(rng.integers(0, 1 << 24))
                surface = Surface(sku.sides("xX"), rng.uniform(0.8, 1.2), scramble)
                builder.add_box(centre, half, surface, yaw_rad=yaw)

    def _scramble(self, tag: int, row: int, *rest: int) -> int:
        """Bits for the dirt of a fixed thing; the same in every aisle if aisles are identical."""
        return mix(self._seed, tag, row % 2 if self._layout.are_aisles_identical else row, *rest) >> 40

    def _add_frame(self, builder: FaceBuilder, row: int, bay: int) -> None:
        layout, textures = self._layout, self._textures
        x, y, top = layout.bay_x_m(bay), layout.row_y_m(row), layout.rack_top_m
        depth = layout.rack_depth_m / 2
        post = textures.uprights[(bay + row % 2) % len(textures.uprights)]
        for number, offset in enumerate((depth - 0.05, 0.05 - depth)):
            surface = Surface(post, scramble=self._scramble(_TAG_RACK, row, bay, number))
            builder.add_box((x, y + offset, top / 2), (0.05, 0.05, top / 2), surface, sides="xXyY")
        for number in range(int((top - 0.3) / 0.75) + 1):
            half, height = (0.015, depth - 0.1, 0.025), 0.3 + 0.75 * number
            surface = Surface(textures.grey, scramble=self._scramble(_TAG_RACK, row, bay, 10 + number))
            builder.add_box((x, y, height), half, surface, sides="xXzZ", is_solid=False)

    def _add_shelf(self, builder: FaceBuilder, row: int, bay: int, level: int) -> None:
        layout, textures = self._layout, self._textures
        x, y, z = layout.bay_x_m(bay) + layout.bay_m / 2, layout.row_y_m(row), layout.shelf_heights_m[level]
        depth = layout.rack_depth_m / 2
        beam, span = textures.beams[(bay + level) % 3], layout.bay_m / 2 - 0.05
        for number, offset in enumerate((depth - 0.03, 0.03 - depth)):
            surface = Surface(beam, 0.75, self._scramble(_TAG_RACK, row, bay, 100 + 2 * level + number))
            builder.add_box((x, y + offset, z - 0.07), (span, 0.03, 0.06), surface, sides="yYzZ")
        deck = Surface(textures.grey, 0.8, self._scramble(_TAG_RACK, row, bay, 200 + level))
        builder.add_box((x, y, z - 0.012), (span, depth - 0.06, 0.01), deck)
        toward_aisle = 1.0 if row % 2 else -1.0
        label = Surface(textures.rack_labels[Slot(row, bay, level).number(layout) % RACK_LABELS])
        for half_bay in range(2):
            shift = (self._scramble(_TAG_LABEL, row, bay, level, half_bay) & 255) * 0.3 / 255
            left = layout.bay_x_m(bay) + 0.36 + half_bay * 1.3 + shift
            start = left + 0.26 if row % 2 else left
            front = y + toward_aisle * (depth + 0.003)
            builder.add_quad((start, front, z - 0.03), (-0.26 * toward_aisle, 0.0, 0.0), (0, 0, -0.08), label)

    def _add_goods(self, builder: FaceBuilder, slot: Slot) -> None:
        layout, textures = self._layout, self._textures
        rng = slot_generator(layout, self._seed, self._day, slot)
        if rng.random() < layout.empty_share:
            return
        x, y = layout.bay_x_m(slot.bay) + 0.06, layout.row_y_m(slot.row)
        base = layout.shelf_heights_m[slot.level]
        ceiling = layout.shelf_heights_m[slot.level + 1] - 0.2 if slot.level + 1 < layout.levels else base + 1.25
        if rng.random() < 0.55:
            for number in range(2):
                pallet = Surface(textures.wood, scramble=int(rng.integers(0, 1 << 24)))
                builder.add_box((x + 0.66 + 1.28 * number, y, base + 0.07), (0.6, 0.5, 0.07), pallet)
            base += 0.14
        end = layout.bay_x_m(slot.bay + 1) - 0.08
        while True:
            sku = textures.skus[int(rng.integers(0, len(textures.skus)))]
            if x + sku.width_m > end:
                return
            for layer in range(int(rng.integers(1, 4))):
                bottom = base + layer * (sku.height_m + 0.002)
                if bottom + sku.height_m > ceiling:
                    break
                self._add_carton(builder, rng, sku, slot.row, (x, y, bottom))
            x += sku.width_m + rng.uniform(0.01, 0.12)

    def _add_carton(
        self, builder: FaceBuilder, rng: np.random.Generator, sku: Sku, row: int, corner_map: tuple[float, float, float]
    ) -> None:
        """One carton, its front 2-12 cm behind the rack's front, turned a little; half of them carry a label."""
        x, y, bottom = corner_map
        toward_aisle = 1.0 if row % 2 else -1.0
        yaw, jitter, setback = rng.normal(0, 0.02), rng.uniform(-0.01, 0.01), rng.uniform(0.02, 0.12)
        half_depth = max(sku.depth_m, 0.5) / 2
        centre_x = x + sku.width_m / 2 + jitter
        centre_y = y + toward_aisle * (self._layout.rack_depth_m / 2 - setback - half_depth)
        centre, half = (centre_x, centre_y, bottom + sku.height_m / 2), (sku.width_m / 2, half_depth, sku.height_m / 2)
        surface = Surface(sku.sides("Y" if row % 2 else "y"), rng.uniform(0.8, 1.2), int(rng.integers(0, 1 << 24)))
        builder.add_box(centre, half, surface, yaw_rad=yaw)
        if rng.random() < 0.5:
            side, reach = 0.12, half_depth + 0.003
            along = rng.uniform(-0.4, 0.4) * (sku.width_m - side)
            up = rng.uniform(0.3, 0.9) * (sku.height_m - side)
            cosine, sine = float(np.cos(yaw)), float(np.sin(yaw))
            outward = (-sine * toward_aisle, cosine * toward_aisle)
            right = (-cosine * toward_aisle, -sine * toward_aisle)
            origin_x = centre_x + outward[0] * reach + right[0] * (along - side / 2)
            origin_y = centre_y + outward[1] * reach + right[1] * (along - side / 2)
            texture = self._textures.labels[int(rng.integers(0, len(self._textures.labels)))]
            label = Surface(texture, scramble=int(rng.integers(0, 1 << 24)))
            edge = (right[0] * side, right[1] * side, 0.0)
            builder.add_quad((origin_x, origin_y, bottom + up + side), edge, (0, 0, -side), label)
