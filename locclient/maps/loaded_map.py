"""Tiles of one map version in memory, and which of them a robot holds: those within reach, and those ahead. Pure."""

from dataclasses import dataclass, field

import numpy as np

from fleetmap.bow import Vocabulary
from fleetmap.config import Section
from fleetmap.geometry import Array
from fleetmap.mapformat import Manifest, Tile
from fleetmap.messages import Status, WantedVersion
from fleetmap.relocalization.map_view import LookAlikes
from locclient.localization.estimate import Estimate

Cell = tuple[int, int]
_RADIUS_STEP_M = 10.0  # so that tiles are not read anew with every frame


class TileSelectionSettings(Section, frozen=True):
    """How far around the robot tiles are held."""

    reach_m: float = 35.0
    ahead_s: float = 8.0
    spare_m: float = 10.0
    most_mps: float = 3.0


@dataclass(frozen=True, slots=True)
class PositionBound:
    """The robot is within radius_m of a position (3,), None for anywhere; with its velocity (3,)."""

    position_map_m: Array | None = None
    velocity_map_mps: Array = field(default_factory=lambda: np.zeros(3))
    radius_m: float = 0.0


class PositionBoundTracker:
    """Follows a robot's estimates. While it is lost, the bound grows at the maximum speed assumed for it.

    A lost robot's own estimate leads out of the tiles that it holds, and without them it finds no other place. All tiles of a
    large site at once are more than its memory should have to take.
    """

    def __init__(self, settings: TileSelectionSettings) -> None:
        self._settings = settings
        self._known: tuple[int, Array] | None = None  # stamp and position of the last estimate with a pose

    def handle(self, estimate: Estimate) -> PositionBound:
        if estimate.map_from_body is not None and estimate.status in {Status.TRACKING, Status.DEGRADED}:
            self._known = (estimate.stamp_ns, estimate.map_from_body[:3, 3])
            odometry = estimate.odometry
            turn = estimate.map_from_body[:3, :3] @ odometry.odom_from_body[:3, :3].T
            return PositionBound(self._known[1], np.asarray(turn @ odometry.velocity_odom_mps))
        if self._known is None:
            return PositionBound()
        radius_m = (estimate.stamp_ns - self._known[0]) * 1e-9 * self._settings.most_mps
        return PositionBound(self._known[1], radius_m=_RADIUS_STEP_M * np.ceil(radius_m / _RADIUS_STEP_M))


def tiles_within(manifest: Manifest, position_map_m: Array, reach_m: float) -> frozenset[Cell]:
    """Tiles of the version that come nearer than reach_m to a position (3,)."""
    size_m = manifest.tile_size_m
    near = set()
    for entry in manifest.tiles:
        low = np.array([entry.x, entry.y]) * size_m
        off = np.maximum(np.maximum(low - position_map_m[:2], position_map_m[:2] - low - size_m), 0.0)
        if float(np.hypot(off[0], off[1])) <= reach_m:
            near.add((entry.x, entry.y))
    return frozenset(near)


def select_tiles(
    manifest: Manifest, held: frozenset[Cell] | None, bound: PositionBound, settings: TileSelectionSettings
) -> frozenset[Cell]:
    """The tiles to hold now: all of them without a position. held: those that are, None for none.

    A held tile stays within the reach plus a hysteresis (spare_m): a robot that turns on the border of a tile does not load it again
    and again.
    """
    position_map_m = bound.position_map_m
    if position_map_m is None:
        return frozenset((entry.x, entry.y) for entry in manifest.tiles)
    reach_m = settings.reach_m + bound.radius_m
    wanted = tiles_within(manifest, position_map_m, reach_m)
    wanted |= tiles_within(manifest, position_map_m + settings.ahead_s * bound.velocity_map_mps, reach_m)
    if held is not None:
        wanted |= held & tiles_within(manifest, position_map_m, reach_m + settings.spare_m)
    return wanted


@dataclass(frozen=True)
class LoadedMap:
    """Some tiles of one version. is_offer: a version to begin with or to try, not only other tiles of one that is held."""

    wanted: WantedVersion
    manifest: Manifest
    vocabulary: Vocabulary
    tiles: dict[Cell, Tile]
    is_offer: bool = True

    @property
    def version(self) -> int:
        return self.manifest.version

    @property
    def lookalikes(self) -> LookAlikes | None:
        """What places outside the map have in common with it; None where its build did not measure it."""
        recall, starts = self.manifest.report.get("lookalike_recall"), self.manifest.report.get("starts")
        share = starts.get("max_wrong_share") if isinstance(starts, dict) else None
        if not isinstance(recall, int | float):
            return None
        return LookAlikes(float(recall), float(share)) if isinstance(share, int | float) else LookAlikes(float(recall))
