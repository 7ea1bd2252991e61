"""Tiles of one map version in memory, and their selection: those within reach, and those ahead. Pure."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from fleetmap.bow.vocabulary import Vocabulary
from fleetmap.config import Section
from fleetmap.geometry import Array
from fleetmap.mapformat.manifest import Manifest, map_errors_of
from fleetmap.mapformat.tile import Tile, off_tile_m
from fleetmap.messages import Status, WantedVersion
from fleetmap.relocalization.map_view import ALIAS_STEP_M, LookAlikes, MapView
from locclient.localization.estimate import Estimate
from locclient.localization.localizer import Localizer

Cell = tuple[int, int]
_RADIUS_STEP_M = 10.0  # so that tiles are not selected again with every frame


class TileSelectionSettings(Section, frozen=True):
    """Range of held tiles around the robot."""

    reach_m: float = 35.0
    ahead_s: float = 8.0
    spare_m: float = 10.0
    most_mps: float = 3.0


class PositionBound(NamedTuple):
    """Bound of the robot's position: within radius_m of that of the last estimate with a pose (3,), at stamp_ns, None for anywhere; with
    its velocity (3,)."""

    position_map_m: Array | None = None
    velocity_map_mps: Array = np.zeros(3)
    radius_m: float = 0.0
    stamp_ns: int = 0

    def after(self, estimate: Estimate, most_mps: float) -> "PositionBound":
        """Return the bound by a further estimate. While the robot is lost, it grows at the assumed maximum speed.

        A lost robot's estimate may leave the held tiles, and without tiles it cannot be localized elsewhere. All tiles of a large site
        may exceed its memory.
        """
        if not estimate.is_at_home:  # another site's map, which says nothing of this one's tiles
            return PositionBound()
        if estimate.map_from_body is not None and estimate.status in {Status.TRACKING, Status.DEGRADED}:
            odometry = estimate.odometry
            position_map_m = estimate.map_from_body[:3, 3]
            turn = estimate.map_from_body[:3, :3] @ odometry.odom_from_body[:3, :3].T
            return PositionBound(position_map_m, turn @ odometry.velocity_odom_mps, stamp_ns=estimate.stamp_ns)
        if self.position_map_m is None:
            return self
        radius_m = _RADIUS_STEP_M * np.ceil((estimate.stamp_ns - self.stamp_ns) * 1e-9 * most_mps / _RADIUS_STEP_M)
        return PositionBound(self.position_map_m, radius_m=radius_m, stamp_ns=self.stamp_ns)


def tiles_within(manifest: Manifest, position_map_m: Array, reach_m: float) -> frozenset[Cell]:
    """Return tiles of the version within reach_m of a position (3,)."""
    cells = np.array([(entry.x, entry.y) for entry in manifest.tiles], np.int64).reshape(-1, 2)
    near = cells[off_tile_m(cells, manifest.tile_size_m, position_map_m) <= reach_m]
    return frozenset((x, y) for x, y in near.tolist())


def select_tiles(
    manifest: Manifest, held: frozenset[Cell] | None, bound: PositionBound, settings: TileSelectionSettings
) -> frozenset[Cell]:
    """Select the tiles to hold: all of them without a position. held: the present tiles, None for none.

    A held tile stays up to the reach plus a hysteresis (spare_m), so that a robot at the border of a tile does not reload it
    repeatedly.
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
    """Some tiles of one version. is_offer: a version to start with or to try, not only other tiles of a held one.

    refused: the reasons of tiles that cannot be read.
    """

    wanted: WantedVersion
    manifest: Manifest
    vocabulary: Vocabulary
    tiles: dict[Cell, Tile]
    is_offer: bool = True
    refused: dict[Cell, str] = field(default_factory=dict)

    @property
    def version(self) -> int:
        return self.manifest.version

    def show(self, localizer: Localizer, site: str = "") -> None:
        """Let a localizer use it as the map of a site of its building; empty: of the robot's own."""
        view = MapView(self.tiles.values(), self.vocabulary, self.manifest.camera.focal_px)
        errors = map_errors_of(self.manifest)
        localizer.handle_version(self.version, view, self.lookalikes, self.alias_step_m, site, errors)

    @property
    def alias_step_m(self) -> float:
        """Smallest distance at which places of the map look alike; ALIAS_STEP_M if its build did not measure it."""
        step_m = self.manifest.report.get("alias_step_m")
        return float(step_m) if isinstance(step_m, int | float) and step_m > 0 else ALIAS_STEP_M

    @property
    def lookalikes(self) -> LookAlikes | None:
        """Similarity of unmapped places to the map; None if its build did not measure it."""
        recall, evidence = self.manifest.report.get("lookalike_recall"), self.manifest.report.get("evidence")
        starts = evidence.get("starts") if isinstance(evidence, dict) else None
        measured = starts if isinstance(starts, dict) else {}
        share, inliers = measured.get("max_wrong_share"), measured.get("lookalike_inliers")
        if not isinstance(recall, int | float):
            return None
        share = float(share) if isinstance(share, int | float) else 1.0
        return LookAlikes(float(recall), share, float(inliers) if isinstance(inliers, int | float) else float("inf"))
