"""Tiles of one map version in memory, ready for the localizer. Pure."""

from dataclasses import dataclass

from fleetmap.bow import Vocabulary
from fleetmap.mapformat import Manifest, Tile
from fleetmap.messages import WantedVersion
from fleetmap.relocalization.map_view import LookAlikes
from locclient.maps.tile_selection import Cell


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
