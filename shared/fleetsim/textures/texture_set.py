"""The warehouse's set of textures, painted from one seed."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fleetsim.textures import painting
from fleetsim.textures.atlas import Atlas, AtlasBuilder
from fleetsim.textures.lettering import noise

SKUS, LABELS, POSTERS, RACK_LABELS = 28, 64, 24, 512
_DECALS = (("scuffs", 6), ("stains", 3), ("cracks", 4), ("sticker", 6), ("repair", 4))


@dataclass(frozen=True, slots=True)
class Sku:
    """One kind of carton: width, depth, height in metres and its textures."""

    width_m: float
    depth_m: float
    height_m: float
    front: int
    side: int
    top: int


@dataclass(frozen=True, slots=True)
class Textures:
    """Numbers of the textures in `atlas`. `stretched` are those that fill their face whatever its size."""

    atlas: Atlas
    dirt: int
    concrete: int
    concrete_coarse: int
    decals: tuple[int, ...]
    uprights: tuple[int, ...]
    beams: tuple[int, ...]
    grey: int
    dark: int
    hazard: int
    wall: int
    wood: int
    paint: int
    cloth: tuple[int, ...]
    vest: int
    lamp: int
    skus: tuple[Sku, ...]
    labels: tuple[int, ...]
    posters: tuple[int, ...]
    signs: tuple[int, ...]
    rack_labels: tuple[int, ...]
    stretched: frozenset[int]


def _paint_skus(rng: np.random.Generator, atlas: AtlasBuilder) -> tuple[Sku, ...]:
    skus = []
    for _ in range(SKUS):
        width, depth, height = rng.uniform(0.30, 0.62), rng.uniform(0.30, 0.60), rng.uniform(0.22, 0.50)
        front = atlas.add(painting.carton(rng, width, height, has_label=True))
        side = atlas.add(painting.carton(rng, depth, height, has_label=False))
        top = atlas.add(painting.carton(rng, width, depth, has_label=False))
        skus.append(Sku(width, depth, height, front, side, top))
    return tuple(skus)


@lru_cache(maxsize=4)
def paint_textures(seed: int, aisles: int, *, are_aisles_identical: bool = False) -> Textures:
    """Every texture of a site with `aisles` aisles; identical aisles all carry the same sign and rack labels.

    Painted once for all days and robots of a site, who only read them.
    """
    rng = np.random.default_rng([seed, 1])
    atlas = AtlasBuilder()
    dirt = atlas.add(128 + 9 * noise(rng, 1024, range(2, 7), 0.85) + 5 * noise(rng, 1024, range(7, 9), 0.9))
    concrete = atlas.add(painting.concrete(rng))
    coarse = atlas.add(128 + 7.2 * noise(rng, 512, range(1, 6), 0.9))
    decals = tuple(atlas.add(painting.floor_decal(rng, kind)) for kind, count in _DECALS for _ in range(count))
    uprights = tuple(atlas.add(painting.perforated_steel(rng)) for _ in range(6))
    beams = tuple(atlas.add(painting.plain(rng, 150, 5, 64, 1024)) for _ in range(3))
    grey, dark = atlas.add(painting.plain(rng, 120, 6)), atlas.add(painting.plain(rng, 45, 3))
    hazard, wall, wood = (
        atlas.add(paint(rng)) for paint in (painting.hazard_stripes, painting.wall_panel, painting.planks)
    )
    skus = _paint_skus(rng, atlas)
    labels = tuple(atlas.add(painting.shipping_label(rng)) for _ in range(LABELS))
    posters = tuple(atlas.add(painting.poster(rng)) for _ in range(POSTERS))
    cloth = tuple(atlas.add(painting.plain(rng, grey_level, 10)) for grey_level in (40, 70, 110, 190))
    vest = atlas.add(painting.safety_vest(rng))
    paint = atlas.add(painting.plain(rng, 195, 16))
    lamp = atlas.add(np.full((64, 64), 255, np.float32))
    if are_aisles_identical:
        signs = (atlas.add(painting.aisle_sign(rng, "A")),) * aisles
        rack_labels = (atlas.add(painting.rack_label(rng, "0000")),) * RACK_LABELS
    else:
        signs = tuple(atlas.add(painting.aisle_sign(rng, f"A{aisle + 1}")) for aisle in range(aisles))
        rack_labels = tuple(atlas.add(painting.rack_label(rng, f"{slot:04d}")) for slot in range(RACK_LABELS))
    stretched = frozenset((*posters, *signs, *labels, *rack_labels, vest, *cloth))
    return Textures(
        atlas=atlas.finish(),
        dirt=dirt,
        concrete=concrete,
        concrete_coarse=coarse,
        decals=decals,
        uprights=uprights,
        beams=beams,
        grey=grey,
        dark=dark,
        hazard=hazard,
        wall=wall,
        wood=wood,
        paint=paint,
        cloth=cloth,
        vest=vest,
        lamp=lamp,
        skus=skus,
        labels=labels,
        posters=posters,
        signs=signs,
        rack_labels=rack_labels,
        stretched=stretched,
    )
