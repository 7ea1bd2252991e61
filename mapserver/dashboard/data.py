"""Maps and surveys for the pages: all that they read from the store."""

import logging
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Generic, TypeVar

import cv2
import numpy as np

from fleetmap.errors import FleetmapError, UsageError
from fleetmap.mapformat.building import ALIGNMENT
from fleetmap.mapformat.tile import decode_tile
from fleetmap.version_grid import OccupancyGrid, known_grid, occupancy
from mapserver import releases
from mapserver.dashboard.map_layers import Layer, Picture
from mapserver.dashboard.plan import Box, Plan, inked, make_plan, png
from mapserver.floor_plan.alignment import PLAN, Alignment
from mapserver.floor_plan.plan_file import decode_plan
from mapserver.nightly.inbox import sites_of
from mapserver.quality.gate import GateSettings
from mapserver.releases.version_diff import Difference
from mapserver.store import MapStore, VerdictRow, VersionInfo

_log = logging.getLogger(__name__)
T = TypeVar("T")
_GRID_HEIGHT_M = 1.1  # as the API's grid without a height
JOBS_SHOWN = 100
MANY_SITES = 1000
_LONG_SIDE_PX = 2000
_FINEST_M = 0.02
_INK_BGR, _FREE_BGR = (150, 140, 130), (130, 170, 110)
_FREE = 60  # how opaque


def floor_picture(data: bytes, alignment: Alignment, box: Box) -> bytes:
    """A PNG of the drawing where it lies in a box of `map`: ink where the drawing is dark. UsageError for a drawing that cannot be read."""
    plan = decode_plan(alignment.plan or "", data)
    scale_m = max(_FINEST_M, max(box[2] - box[0], box[3] - box[1]) / _LONG_SIDE_PX)
    size = (max(1, round((box[2] - box[0]) / scale_m)), max(1, round((box[3] - box[1]) / scale_m)))
    building_from_map = alignment.frame.building_from_map[:2, [0, 1, 3]]
    map_from_pixel = np.array([[scale_m, 0, box[0] + scale_m / 2], [0, -scale_m, box[3] - scale_m / 2], [0, 0, 1]])
    drawing_from_pixel = (building_from_map @ map_from_pixel) / alignment.metres_per_unit  # right and up
    # A picture counts down, and its first pixel's centre is half a pixel from its corner.
    source = np.array([[1, 0], [0, -1]]) @ drawing_from_pixel - np.array([[0, 0, 0.5], [0, 0, 0.5]])
    flags = cv2.INTER_AREA | cv2.WARP_INVERSE_MAP
    grey = cv2.warpAffine(plan.grey, source, size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=255)
    return png(inked(255 - grey.astype(np.uint8), _INK_BGR))


def grid_picture(grid: OccupancyGrid) -> tuple[bytes, Box]:
    """A PNG of what is occupied and free, and where it lies; what is not known is left out."""
    occupied, free = grid.cells >= 50, (grid.cells >= 0) & (grid.cells < 50)
    picture = inked(255 * occupied, _INK_BGR)
    picture[free] = (*_FREE_BGR, _FREE)
    x, y = grid.map_from_grid[:2, 3].tolist()
    height, width = grid.cells.shape
    return png(picture[::-1]), (x, y, x + width * grid.resolution_m, y + height * grid.resolution_m)


class Kept(Generic[T]):
    """The last values that were made, by key: a second browser waits for the first one's instead of making it again.

    age: after which, by the clock, a value is made again.
    """

    def __init__(self, most: int = 8, age: float = math.inf, clock: Callable[[], float] = time.monotonic) -> None:
        self._lock, self._most, self._age, self._clock = threading.Lock(), most, age, clock
        self._values = OrderedDict[Hashable, tuple[float, T]]()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        with self._lock:
            if key not in self._values or self._clock() - self._values[key][0] >= self._age:
                value = make()
                self._values[key] = self._clock(), value
            self._values.move_to_end(key)
            while len(self._values) > self._most:
                self._values.popitem(last=False)
            return self._values[key][1]


class MapData:
    """Reads maps in an open store, `store`. Methods may be called from any thread; errors are the store's."""

    def __init__(self, store: MapStore, gate: GateSettings, trial_share: float, inbox: Path | None = None) -> None:
        """inbox: the folder with an inbox for each site; None if the server has none."""
        self.store, self.inbox = store, inbox
        self._gate, self.trial_share = gate, trial_share
        self._plans, self._underlays = Kept[Plan](), Kept[tuple[bytes, Box] | None]()
        self._differences, self._foretold = Kept[Difference](64), Kept[VerdictRow]()

    def sites(self) -> list[str]:
        """Names of all sites, also of those that have only jobs or an inbox yet."""
        inboxes = [] if self.inbox is None else sites_of(self.inbox)
        return sorted({*(info.site for info in self.store.sites()), *self.store.sites_with_jobs(), *inboxes})

    def is_mapped(self, site: str) -> bool:
        """Whether a site ever had a version."""
        return any(info.site == site for info in self.store.sites())

    def chosen_site(self, site: str | None) -> str:
        """`site`, or the first site, one with a version before others, if none is named; UsageError for an unknown one."""
        mapped = {info.site for info in self.store.sites()}
        known = sorted(self.sites(), key=lambda name: name not in mapped)
        if not known:
            raise UsageError("the store has no site yet; `mapserver build` makes one from a recording")
        if site is not None and site not in known:
            raise UsageError(f"the store has no site {site[:64]}; it has: {', '.join(known)}")
        return site or known[0]

    def levels(self, site: str) -> dict[str, str]:
        """Names of the floors in a site's building by their sites, the highest last; none where it is in no building."""
        building = self.store.building(site) if self.is_mapped(site) else None
        return {} if building is None else {floor.site: floor.level for floor in building.floors}

    def current_version(self, site: str) -> int | None:
        """The number of the current version, None before the first."""
        current = self.store.current(site) if self.is_mapped(site) else None
        return None if current is None else current.version

    def has_version(self, site: str, version: int) -> bool:
        """Whether the store has a version."""
        return self.is_mapped(site) and any(info.version == version for info in self.store.versions(site))

    def foretold(self, draft: VersionInfo) -> VerdictRow:
        """What the gate would say now; kept, since it follows from the draft and the current version."""

        def said() -> VerdictRow:
            said = releases.judge_draft(self.store, draft, self._gate)
            reasons = (*said.hard_reasons, *said.reasons)
            return VerdictRow(self.store.now_ns(), said.accepted, False, reasons, said.report)

        return self._foretold.get((draft.manifest_sha256, self.current_version(draft.site)), said)

    def plan(self, site: str, version: int) -> Plan:
        """The plan of a version; the last ones are kept, since versions do not change."""

        def made() -> Plan:
            return make_plan(self.store.manifest(site, version), lambda tile: decode_tile(self.store.blob(tile.sha256)))

        return self._plans.get(self.store.version(site, version).manifest_sha256, made)

    def underlays(self, site: str, version: int, root: str) -> list[Layer]:
        """The floor plan and the occupancy grid under a version's map, where there are any; root: prefix of their addresses."""
        found = []
        for name, kind in (("Floor plan", "floor"), ("Occupancy grid", "grid")):
            picture = self.underlay(site, version, kind)
            if picture is not None:
                found.append(Layer(name, [Picture(f"{root}/underlays/{site}/{version}/{kind}.png", picture[1])]))
        return found

    def underlay(self, site: str, version: int, kind: str) -> tuple[bytes, Box] | None:
        """A PNG and where it lies, None where the site or version has none or it cannot be drawn, which the log says."""
        key = (
            self.store.version(site, version).manifest_sha256,
            kind,
            *(self.store.site_file_sha256(site, file) for file in (PLAN, ALIGNMENT) if kind == "floor"),
        )
        return self._underlays.get(key, lambda: self._underlay(site, version, kind))

    def _underlay(self, site: str, version: int, kind: str) -> tuple[bytes, Box] | None:
        try:
            if kind == "grid":
                tiles = known_grid(self.store.manifest(site, version), self.store.blob)
                return grid_picture(occupancy(tiles, _GRID_HEIGHT_M)) if tiles else None
            data, alignment = self.store.site_file(site, PLAN), self.store.alignment(site)
            if data is None or alignment is None:
                return None
            box = self.plan(site, version).box
            return floor_picture(data, alignment, box), box
        except FleetmapError as error:
            _log.warning("the map of %s is shown without its %s: %s", site, kind, error)
            return None

    def difference(self, site: str, before: int, after: int) -> Difference:
        """The difference between two versions."""
        key = tuple(self.store.version(site, version).manifest_sha256 for version in (before, after))
        return self._differences.get(key, lambda: releases.difference(self.store, site, before, after))

    def changed_tiles(self, site: str, before: int, after: int) -> dict[tuple[int, int], str]:
        """Cells that differ between two versions: added, removed or changed."""
        old, new = (
            {(tile.x, tile.y): tile.sha256 for tile in self.store.manifest(site, version).tiles}
            for version in (before, after)
        )
        changed = {cell: "changed" for cell in old.keys() & new.keys() if old[cell] != new[cell]}
        added, removed = new.keys() - old.keys(), old.keys() - new.keys()
        return changed | dict.fromkeys(added, "added") | dict.fromkeys(removed, "removed")
