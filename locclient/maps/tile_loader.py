"""Loading of tiles from the robot's disk into its memory. Slow: not for the localizing thread."""

from dataclasses import replace

from fleetmap.errors import FleetmapError
from fleetmap.messages import WantedVersion
from fleetmap.version_grid import OccupancyGrid, grid_of, occupancy
from locclient.maps.loaded_map import Cell, LoadedMap, PositionBound, TileSelectionSettings, select_tiles
from locclient.maps.map_source import MapSource


class TileLoader:
    """Reads from one MapSource. An unreadable tile is left out and its reason kept; the others stay usable."""

    def __init__(self, source: MapSource, settings: TileSelectionSettings) -> None:
        self._source, self.settings = source, settings
        # With the selected cells, None if tiles are to be read again
        self._versions: dict[str, tuple[LoadedMap, frozenset[Cell] | None]] = {}

    def load(self, wanted: WantedVersion, bound: PositionBound) -> LoadedMap | None:
        """Load the version's tiles around the robot; None if the selection has not changed since the last call.

        Raises FleetmapError if its manifest, its vocabulary or all of its tiles are unusable.
        """
        sha256 = wanted.manifest_sha256 or ""
        if sha256 not in self._versions:
            self._versions[sha256] = self._source.load(wanted, self._source.manifest(wanted), ()), None
        known, held = self._versions[sha256]
        cells = select_tiles(known.manifest, held, bound, self.settings)
        if cells == held:
            return None
        fetched, refused = self._source.tiles(known.manifest, cells - known.tiles.keys() - known.refused.keys())
        tiles = {cell: tile for cell, tile in (known.tiles | fetched).items() if cell in cells}
        loaded = replace(known, tiles=tiles, refused=known.refused | refused)
        self._versions[sha256] = loaded, cells if tiles or not loaded.refused else held
        if not tiles and loaded.refused:
            reasons = "; ".join(loaded.refused.values())
            raise FleetmapError(f"no tile of version {loaded.version} can be used: {reasons}"[:1000])
        return loaded

    def grid(self, wanted: WantedVersion, robot_height_m: float) -> OccupancyGrid:
        """Return the occupancy grid of a version for planners of a robot of this height.

        Raises StateError with the reason for a version without one, and other FleetmapErrors if it is missing or damaged.
        """
        return occupancy(grid_of(self._source.manifest(wanted), self._source.blob), robot_height_m)

    def retry_refused(self, wanted: WantedVersion) -> None:
        """Allow refused tiles of a version to be read again, after it was fetched again."""
        sha256 = wanted.manifest_sha256 or ""
        if sha256 in self._versions and self._versions[sha256][0].refused:
            self._versions[sha256] = replace(self._versions[sha256][0], refused={}), None

    def keep_only(self, held: list[WantedVersion]) -> None:
        kept = {wanted.manifest_sha256 for wanted in held}
        self._versions = {sha256: known for sha256, known in self._versions.items() if sha256 in kept}
