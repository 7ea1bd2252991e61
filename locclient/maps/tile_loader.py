"""Loading of tiles from the robot's disk into its memory. Slow: not for the localizing thread."""

from dataclasses import dataclass, field

from fleetmap.bow.vocabulary import Vocabulary, decode_vocabulary
from fleetmap.errors import FleetmapError
from fleetmap.mapformat.manifest import Manifest
from fleetmap.mapformat.tile import Tile
from fleetmap.messages import WantedVersion
from fleetmap.version_grid import OccupancyGrid, grid_of, occupancy
from locclient.maps.loaded_map import Cell, LoadedMap, PositionBound, TileSelectionSettings, select_tiles
from locclient.maps.map_source import MapSource


@dataclass
class _Version:
    manifest: Manifest
    vocabulary: Vocabulary
    tiles: dict[Cell, Tile] = field(default_factory=dict)
    refused: dict[Cell, str] = field(default_factory=dict)
    cells: frozenset[Cell] | None = None


class TileLoader:
    """Reads from one MapSource. An unreadable tile is left out and its reason kept; the others stay usable."""

    def __init__(self, source: MapSource, settings: TileSelectionSettings) -> None:
        self._source, self.settings = source, settings
        self._versions: dict[str, _Version] = {}

    def load(self, wanted: WantedVersion, bound: PositionBound) -> LoadedMap | None:
        """Load the version's tiles around the robot; None if the selection has not changed since the last call.

        Raises FleetmapError if its manifest, its vocabulary or all of its tiles are unusable.
        """
        sha256 = wanted.manifest_sha256 or ""
        if sha256 not in self._versions:
            manifest = self._source.manifest(wanted)
            self._versions[sha256] = _Version(manifest, decode_vocabulary(self._source.vocabulary(manifest)))
        version = self._versions[sha256]
        cells = select_tiles(version.manifest, version.cells, bound, self.settings)
        if cells == version.cells:
            return None
        fetched = self._source.tiles(version.manifest, cells - version.tiles.keys() - version.refused.keys())
        version.refused.update(fetched.refused)
        version.tiles = {cell: tile for cell, tile in {**version.tiles, **fetched.tiles}.items() if cell in cells}
        if not version.tiles and version.refused:
            reasons = "; ".join(version.refused.values())
            raise FleetmapError(f"no tile of version {version.manifest.version} can be used: {reasons}"[:1000])
        version.cells = cells
        return LoadedMap(wanted, version.manifest, version.vocabulary, dict(version.tiles))

    def grid(self, wanted: WantedVersion, robot_height_m: float) -> OccupancyGrid:
        """Return the occupancy grid of a version for planners of a robot of this height.

        Raises StateError with the reason for a version without one, and other FleetmapErrors if it is missing or damaged.
        """
        return occupancy(grid_of(self._source.manifest(wanted), self._source.blob), robot_height_m)

    def refused(self, wanted: WantedVersion) -> dict[Cell, str]:
        """Return unreadable tiles of a version, with the reasons."""
        version = self._versions.get(wanted.manifest_sha256 or "")
        return {} if version is None else dict(version.refused)

    def retry_refused(self, wanted: WantedVersion) -> None:
        """Allow refused tiles of a version to be read again, after it was fetched again."""
        version = self._versions.get(wanted.manifest_sha256 or "")
        if version is not None and version.refused:
            version.refused.clear()
            version.cells = None

    def keep_only(self, held: list[WantedVersion]) -> None:
        kept = {wanted.manifest_sha256 for wanted in held}
        self._versions = {sha256: version for sha256, version in self._versions.items() if sha256 in kept}
