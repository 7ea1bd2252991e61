"""Tiles of one map version in memory, ready for the localizer. Pure."""

from dataclasses import dataclass

from fleetmap.bow import Vocabulary
from fleetmap.mapformat import Manifest, Tile
from fleetmap.messages import WantedVersion
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
        """Its number."""
        return self.manifest.version

    @property
    def lookalike_recall(self) -> float | None:
        """The landmark recall that places outside the map may reach by likeness; None where its build did not measure it."""
        found = self.manifest.report.get("lookalike_recall")
        return float(found) if isinstance(found, int | float) else None
