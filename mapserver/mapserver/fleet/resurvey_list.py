"""The re-survey list of a site, from the store's counters, and a route through the current map."""

import math
from dataclasses import dataclass, replace

from fleetmap.errors import FleetmapError
from fleetmap.mapformat import TileEntry, decode_tile
from mapserver.fleet_statistics.kpis import hour_of
from mapserver.fleet_statistics.resurvey_test import ResurveySettings, TileConcern, Waypoint, concerns, route
from mapserver.store import MapStore


@dataclass(frozen=True, slots=True)
class ResurveyList:
    """Tiles to survey again, the worst first, and a way through them; version: the current one, None without."""

    site: str
    version: int | None
    tiles: list[TileConcern]
    route: list[Waypoint]


def resurvey_list(store: MapStore, site: str, settings: ResurveySettings, now_ns: int) -> ResurveyList:
    """The list as of now; raises UsageError for an unknown site."""
    current = store.current(site)
    now_hour = hour_of(now_ns)
    recent_hour = now_hour - round(settings.recent_days * 24)
    before_hour = recent_hour - round(settings.before_days * 24)
    recent, before = (
        {
            key: counts
            for (_, key), counts in store.fleet.counters(site, "tile", since_hour=since, until_hour=until).items()
        }
        for since, until in ((recent_hour, 1 << 60), (before_hour, recent_hour))
    )
    found = concerns(recent, before, settings)
    if current is None:
        return ResurveyList(site, None, found, [])
    manifest = store.manifest(site, current.version)
    entries = {f"{tile.x},{tile.y}": tile for tile in manifest.tiles}
    areas = store.areas(site)
    found = [replace(concern, name=areas.name_tiles(concern.name, manifest.tile_size_m)) for concern in found]
    tiles = [concern.tile for concern in found if concern.tile in entries]
    places = {tile: _place(store, entries[tile], manifest.tile_size_m) for tile in tiles}
    return ResurveyList(site, current.version, found, route(found, places))


def _place(store: MapStore, entry: TileEntry, size_m: float) -> tuple[float, float]:
    """Where the survey stood nearest to the tile's middle, which can be driven to; the middle where it never stood there."""
    middle = ((entry.x + 0.5) * size_m, (entry.y + 0.5) * size_m)
    try:
        stood = decode_tile(store.blob(entry.sha256)).map_from_cam[:, :2, 3]
    except FleetmapError:
        return middle  # a damaged tile needs a survey most of all
    return min(((float(x), float(y)) for x, y in stood), key=lambda place: math.dist(place, middle), default=middle)
