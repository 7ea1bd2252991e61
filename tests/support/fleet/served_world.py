"""A map server and one robot on the in-memory bus, with a published version."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fleetmap.mapformat.tile import Tile
from fleetmap.messages import WantedVersion
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from mapserver import releases
from mapserver.fleet.fleet import Fleet
from mapserver.serving.bus_service import BusService
from mapserver.store import DraftContent, MapStore
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.storage.map_samples import draft_details, publish_samples


@dataclass
class World:
    folder: Path
    hub: MemoryHub
    store: MapStore
    fleet: Fleet
    service: BusService
    counts: list[tuple[str, str, int]]
    robot_bus: MemoryBus
    cache: TileCache
    link: MapClient
    hall: MapClient

    def publish(self, tiles: list[Tile]) -> WantedVersion:
        """Another version of site hall, which has none at first."""
        self.store.save("hall", DraftContent(tiles=tiles, vocabulary=b"words" * 50, details=draft_details(path_m=12.5)))
        releases.publish(self.store, "hall")
        return self.hall.wanted()


@contextmanager
def served_world(folder: Path) -> Iterator[World]:
    """A server with one published version of site lab, and one robot."""
    hub = MemoryHub()
    clock = {"ns": 10**18}
    counts: list[tuple[str, str, int]] = []
    with MapStore.open(folder / "store", create=True, clock_ns=lambda: clock["ns"]) as store, MemoryBus(hub) as bus:
        publish_samples(store, 1)
        fleet = Fleet(store, clock_ns=lambda: clock["ns"])
        service = BusService(store, fleet, bus, lambda *event: counts.append(event))
        with MemoryBus(hub) as robot_bus:
            cache = TileCache(folder / "cache")
            links = (MapClient(robot_bus, cache, site, "r1") for site in ("lab", "hall"))
            yield World(folder / "store", hub, store, fleet, service, counts, robot_bus, cache, *links)
        service.close()
