"""The pose of a robot's map in its building, the floors there, and the maps of the others than its own site's, held whole in memory."""

import logging
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from fleetmap.errors import FleetmapError, MapFormatError, UnreachableError
from fleetmap.mapformat import building as building_files
from fleetmap.mapformat.building import AREAS, BuildingFrame, Floor
from fleetmap.messages import WantedVersion
from locclient.maps.loaded_map import LoadedMap
from locclient.maps.map_source import MapSource

_MAX_ALIGNMENT_BYTES, _MAX_AREAS_BYTES = 1 << 20, 8 << 20
_UNKNOWN = BuildingFrame(x_m=0.0, y_m=0.0, yaw_rad=0.0)  # of a floor whose files are missing, and so its map
_log = logging.getLogger(__name__)


class BuildingChange(NamedTuple):
    """The building as of `Localizer.handle_building`, all of it, and new versions of the other floors.

    frame: of a site without floors; None if each version's manifest defines it.
    """

    building: dict[str, Floor]
    maps: list[LoadedMap]
    frame: BuildingFrame | None


class BuildingMaps:
    """`refresh` reads the record of the robot's own site, and the other sites by their own signed lists; changes wait in `changes`.

    A floor whose files cannot be read stays as it was. One whose map is missing stays a floor, on which the robot may be.
    """

    def __init__(self, own: MapSource, open_site: Callable[[str], MapSource]) -> None:
        """open_site: opens the source of another site."""
        self._own, self._open_site = own, open_site
        self._sources: dict[str, MapSource] = {}
        self._floors: dict[str, Floor] = {}
        self.held: dict[str, WantedVersion] = {}  # of the others
        self._made_of = b""  # the record and the files of the floors
        self._faults: dict[str, str] = {}
        self.changes: deque[BuildingChange] = deque()

    def refresh(self, *, asks: bool = True) -> None:
        """Read everything anew; asks: False reads the disk alone. UnreachableError without an answer of a server; all else is logged."""
        try:
            data = self._own.site_file(building_files.FLOORS, building_files.MAX_FLOORS_BYTES)
            entries = () if data is None else building_files.read_building(data).floors
            if entries and self._own.site not in {entry.site for entry in entries}:
                raise MapFormatError(f"the building of site {self._own.site} has no such floor; set it again")
            alone = None if entries else self._own.site_file(building_files.ALIGNMENT, _MAX_ALIGNMENT_BYTES)
            frame_alone = None if alone is None else building_files.aligned_frame(alone)
        except UnreachableError:
            raise
        except FleetmapError as error:
            return self._note(self._own.site, str(error))
        floors, files, maps = dict[str, Floor](), list[bytes | None](), list[LoadedMap]()
        for entry in entries:
            key = "" if entry.site == self._own.site else entry.site
            floors[key] = self._floors.get(key, Floor(entry, _UNKNOWN))
            try:
                if key and key not in self._sources:
                    self._sources[key] = self._open_site(key)
                source = self._sources[key] if key else self._own
                # First: it reads the signed list, which names the files
                loaded = self._newest(source, asks=asks) if key else None
                if key and source.site_file(building_files.FLOORS, building_files.MAX_FLOORS_BYTES) != data:
                    raise MapFormatError(f"site {key} does not name this building's floors; set the building again")
                alignment = source.site_file(building_files.ALIGNMENT, _MAX_ALIGNMENT_BYTES)
                if alignment is None:
                    reason = f"site {entry.site} has no pose in the building; `mapserver align` estimates it"
                    raise MapFormatError(reason)
                frame, areas = building_files.aligned_frame(alignment), source.site_file(AREAS, _MAX_AREAS_BYTES)
                floors[key] = Floor(entry, frame, building_files.read_lifts(areas, frame))
                files += [alignment, areas]
                maps += [] if loaded is None else [loaded]
                self._note(entry.site, "")
            except FleetmapError as error:
                if asks and isinstance(error, UnreachableError):
                    raise
                self._note(entry.site, str(error))
        known = [(key, floor.entry) for key, floor in floors.items()]
        made_of = repr([*known, *files]).encode() if floors else alone or b""
        if made_of != self._made_of or maps:
            if made_of == self._made_of or not (floors or self._floors):
                floors = self._floors  # the same object: a ride goes on
            self._floors, self._made_of = floors, made_of
            self._sources = {site: source for site, source in self._sources.items() if site in floors}
            held = {site: wanted for site, wanted in self.held.items() if site in floors}
            self.held = held | {loaded.wanted.site: loaded.wanted for loaded in maps}
            self.changes.append(BuildingChange(floors, maps, frame_alone))
        return None

    def _newest(self, source: MapSource, *, asks: bool) -> LoadedMap | None:
        """Return the current version with all of its usable tiles; None if the robot holds it already."""
        wanted = source.newest(asks=asks)
        if wanted == self.held.get(source.site):
            return None
        loaded = source.load(wanted, source.manifest(wanted))
        for reason in loaded.refused.values():
            _log.warning("floor %s: a tile is left out: %s", source.site, reason)
        return loaded

    def _note(self, site: str, fault: str) -> None:
        if fault and fault != self._faults.get(site):
            _log.warning("site %s stays as it was in its building: %s", site, fault)
        self._faults[site] = fault
