"""Which tiles a robot holds in memory: those within reach, and those ahead. Pure."""

import numpy as np

from fleetmap.config import Section
from fleetmap.geometry import Array
from fleetmap.mapformat import Manifest

Cell = tuple[int, int]


class WindowSettings(Section, frozen=True):
    """How far around the robot tiles are held."""

    reach_m: float = 35.0
    ahead_s: float = 8.0
    spare_m: float = 10.0


def cells_within(manifest: Manifest, position_map_m: Array, reach_m: float) -> frozenset[Cell]:
    """Cells of the version that come nearer than reach_m to a place (3,)."""
    size_m = manifest.tile_size_m
    near = set()
    for entry in manifest.tiles:
        low = np.array([entry.x, entry.y]) * size_m
        off = np.maximum(np.maximum(low - position_map_m[:2], position_map_m[:2] - low - size_m), 0.0)
        if float(np.hypot(off[0], off[1])) <= reach_m:
            near.add((entry.x, entry.y))
    return frozenset(near)


def window(
    manifest: Manifest, held: frozenset[Cell] | None, position_map_m: Array | None, velocity_map_mps: Array, settings: WindowSettings
) -> frozenset[Cell]:  # fmt: skip
    """The cells to hold now. held: those that are, None for none; position_map_m (3,), velocity_map_mps (3,).

    Without a position all of them, because the robot may be anywhere. What is held stays as long as it is within reach and a
    spare, so that a robot that turns on the border of a tile does not load it again and again.
    """
    if position_map_m is None:
        return frozenset((entry.x, entry.y) for entry in manifest.tiles)
    wanted = cells_within(manifest, position_map_m, settings.reach_m)
    wanted |= cells_within(manifest, position_map_m + settings.ahead_s * velocity_map_mps, settings.reach_m)
    if held is not None:
        wanted |= held & cells_within(manifest, position_map_m, settings.reach_m + settings.spare_m)
    return wanted
