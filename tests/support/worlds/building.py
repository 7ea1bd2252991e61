"""A building of two floors in a store, of maps of the painted room."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fleetmap.mapformat.building import Building, FloorEntry
from fleetmap.mapformat.tile import Tile
from mapserver.fleet.building import keep_building
from mapserver.store import NOBODY, MapStore
from support.storage.map_samples import align
from support.worlds import robot_world

SITES = ("low", "high")


def strange(tiles: tuple[Tile, ...]) -> tuple[Tile, ...]:
    """A floor that looks like no other."""
    rng = np.random.default_rng(1)
    return tuple(replace(t, descriptors=rng.integers(0, 256, t.descriptors.shape, np.uint8)) for t in tiles)


def house(
    folder: Path, low: tuple[Tile, ...], high: tuple[Tile, ...], x_m: float = 0.0, *, has_grid: bool = False
) -> MapStore:
    """A building of two floors; the map of the upper one lies x_m beside the lower one's."""
    store = MapStore.open(folder, create=True)
    for site, tiles, at_m in (("low", low, 0.0), ("high", high, x_m)):
        robot_world.save(store, site=site, of=tiles, has_grid=has_grid)
        align(store, site, at_m)
    floors = tuple(FloorEntry(site=site, level=f"L{n}", height_m=4.0 * n) for n, site in enumerate(SITES))
    keep_building(store, Building(name="tower", floors=floors), NOBODY)
    return store
