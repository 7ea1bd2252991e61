"""Which tiles a robot holds in memory: those within reach, and those ahead. Pure."""

from dataclasses import dataclass, field

import numpy as np

from fleetmap.config import Section
from fleetmap.geometry import Array
from fleetmap.mapformat import Manifest
from fleetmap.messages import Status
from locclient.localization.estimate import Estimate

Cell = tuple[int, int]
_DOUBT_STEP_M = 10.0  # so that tiles are not read anew with every frame


class WindowSettings(Section, frozen=True):
    """How far around the robot tiles are held."""

    reach_m: float = 35.0
    ahead_s: float = 8.0
    spare_m: float = 10.0
    most_mps: float = 3.0


@dataclass(frozen=True, slots=True)
class Place:
    """Where a robot is or was, (3,), with its velocity (3,), and how far from there it may be; position None for anywhere."""

    position_map_m: Array | None = None
    velocity_map_mps: Array = field(default_factory=lambda: np.zeros(3))
    doubt_m: float = 0.0


class PositionBound:
    """Follows a robot's estimates: while it is lost, it is within what it, or who carries it, can have come since it was not.

    A lost robot's own estimate leads out of the tiles that it holds, and without them it finds no other place. All tiles of a
    large site at once are more than its memory should have to take.
    """

    def __init__(self, settings: WindowSettings) -> None:
        self._settings = settings
        self._known: tuple[int, Array] | None = None  # stamp and position of the last place that was one

    def handle(self, estimate: Estimate) -> Place:
        """The place after an estimate."""
        if estimate.map_from_body is not None and estimate.status in {Status.TRACKING, Status.DEGRADED}:
            self._known = (estimate.stamp_ns, estimate.map_from_body[:3, 3])
            odom = estimate.odometry
            turn = estimate.map_from_body[:3, :3] @ odom.odom_from_body[:3, :3].T
            return Place(self._known[1], np.asarray(turn @ odom.velocity_odom_mps))
        if self._known is None:
            return Place()
        way_m = (estimate.stamp_ns - self._known[0]) * 1e-9 * self._settings.most_mps
        return Place(self._known[1], doubt_m=_DOUBT_STEP_M * np.ceil(way_m / _DOUBT_STEP_M))


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
    manifest: Manifest, held: frozenset[Cell] | None, place: Place, settings: WindowSettings
) -> frozenset[Cell]:  # fmt: skip
    """The cells to hold now. held: those that are, None for none.

    Without a position all of them, because the robot may be anywhere. What is held stays as long as it is within reach and a
    spare, so that a robot that turns on the border of a tile does not load it again and again.
    """
    position_map_m = place.position_map_m
    if position_map_m is None:
        return frozenset((entry.x, entry.y) for entry in manifest.tiles)
    reach_m = settings.reach_m + place.doubt_m
    wanted = cells_within(manifest, position_map_m, reach_m)
    wanted |= cells_within(manifest, position_map_m + settings.ahead_s * place.velocity_map_mps, reach_m)
    if held is not None:
        wanted |= held & cells_within(manifest, position_map_m, reach_m + settings.spare_m)
    return wanted
