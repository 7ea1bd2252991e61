"""The warehouse's set of textures, painted from one seed."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fleetsim.textures import painting
from fleetsim.textures.painting import Atlas, noise

SKUS, LABELS, POSTERS, RACK_LABELS = 28, 64, 24, 512
_DECALS = (("scuffs", 6), ("stains", 3), ("cracks", 4), ("sticker", 6), ("repair", 4))


@dataclass(frozen=True, slots=True)
class Sku:
    """One kind of carton: width, depth, height in metres and its textures, by the names of a box' sides."""

    width_m: float
    depth_m: float
    height_m: float
    front: int
    side: int
    top: int

    def sides(self, fronts: str) -> dict[str, int]:
        """The textures by the names of a box' sides, of which `fronts` show the front."""
        return {name: self.front if name in fronts else self.top if name in "zZ" else self.side for name in "xXyYzZ"}


class Textures:
    """Numbers of a site's textures in `atlas`, painted from its seed. `stretched` are those that fill a face of any size."""

    def __init__(self, seed: int, aisles: int, *, are_aisles_identical: bool, markers: tuple[int, ...] = ()) -> None:
        """Identical aisles all carry the same sign and rack labels. markers: numbers of AprilTags."""
        rng, atlas = np.random.default_rng([seed, 1]), Atlas()
        add = atlas.add
        self.dirt = add(128 + 9 * noise(rng, 1024, range(2, 7), 0.85) + 5 * noise(rng, 1024, range(7, 9), 0.9))
        self.concrete = add(painting.concrete(rng))
        self.concrete_coarse = add(128 + 7.2 * noise(rng, 512, range(1, 6), 0.9))
        self.decals = tuple(add(painting.floor_decal(rng, kind)) for kind, count in _DECALS for _ in range(count))
        self.uprights = tuple(add(painting.perforated_steel(rng)) for _ in range(6))
        self.beams = tuple(add(painting.plain(rng, 150, 5, 64, 1024)) for _ in range(3))
        self.grey = add(painting.plain(rng, 120, 6))
        self.dark = add(painting.plain(rng, 45, 3))
        self.hazard = add(painting.hazard_stripes(rng))
        self.wall = add(painting.wall_panel(rng))
        self.wood = add(painting.planks(rng))
        skus = []
        for _ in range(SKUS):
            width, depth, height = rng.uniform(0.30, 0.62), rng.uniform(0.30, 0.60), rng.uniform(0.22, 0.50)
            front = add(painting.carton(rng, width, height, has_label=True))
            side = add(painting.carton(rng, depth, height, has_label=False))
            top = add(painting.carton(rng, width, depth, has_label=False))
            skus.append(Sku(width, depth, height, front, side, top))
        self.skus = tuple(skus)
        self.labels = tuple(add(painting.shipping_label(rng)) for _ in range(LABELS))
        self.posters = tuple(add(painting.poster(rng)) for _ in range(POSTERS))
        self.cloth = tuple(add(painting.plain(rng, grey_level, 10)) for grey_level in (40, 70, 110, 190))
        self.vest = add(painting.safety_vest(rng))
        self.paint = add(painting.plain(rng, 195, 16))
        self.lamp = add(np.full((64, 64), 255, np.float32))
        if are_aisles_identical:
            self.signs = (add(painting.aisle_sign(rng, "A")),) * aisles
            self.rack_labels = (add(painting.rack_label(rng, "0000")),) * RACK_LABELS
        else:
            self.signs = tuple(add(painting.aisle_sign(rng, f"A{aisle + 1}")) for aisle in range(aisles))
            self.rack_labels = tuple(add(painting.rack_label(rng, f"{slot:04d}")) for slot in range(RACK_LABELS))
        self.markers = {number: add(painting.april_tag(number)) for number in markers}
        printed = *self.markers.values(), *self.posters, *self.signs, *self.labels, *self.rack_labels
        self.stretched = frozenset((*printed, self.vest, *self.cloth))
        self.atlas = atlas


paint_textures = lru_cache(maxsize=4)(Textures)
"""Every texture of a site with `aisles` aisles, painted once for all days and robots of the site; read-only."""
