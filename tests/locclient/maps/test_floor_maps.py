"""The maps of a building's other floors over the bus: by each site's own signed list, and from the disk without a server."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from fleetmap.encoding import to_json
from fleetmap.mapformat.building import FLOORS, Building, FloorEntry
from fleetmap.mapformat.names import current_path
from fleetmap.trust import TrustedMap, ask_over
from locclient.maps.building_maps import BuildingMaps
from locclient.maps.map_client import MapClient
from locclient.maps.map_source import LocalMapSource
from locclient.maps.tile_cache import TileCache
from mapserver.fleet.fleet import Fleet
from mapserver.serving.bus_service import BusService
from mapserver.trust import init_here, update_lists
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.worlds import robot_world
from support.worlds.building import house

ROBOT = "r1"


class Network:
    """A server of the building, and robots of its lower floor on one disk."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.cache, self.hub, self._stack = folder / "cache", MemoryHub(), stack
        self.store = stack.enter_context(house(folder / "store", robot_world.tiles(), robot_world.tiles()))
        init_here(self.store)
        self.bus = stack.enter_context(MemoryBus(self.hub))
        self.service = BusService(self.store, Fleet(self.store), self.bus, lambda *_: None)

    def floors(self) -> BuildingMaps:
        bus, cache = self._stack.enter_context(MemoryBus(self.hub)), TileCache(self.cache)
        root = (self.store.folder / "trust" / "1.root.json").read_bytes()

        def client(site: str) -> MapClient:
            made = MapClient(bus, cache, site, ROBOT, timeout_s=0.2)
            made.trust = TrustedMap(self.cache / "trust" / site, site, root, ask_over(bus, site, ROBOT, 0.2))
            return made

        own = client("low")
        if self.service is not None:
            own.bring(own.wanted())
        return BuildingMaps(own, client)


@pytest.fixture
def network(tmp_path: Path) -> Iterator[Network]:
    with ExitStack() as stack:
        yield Network(tmp_path, stack)


def test_floors_come_by_signed_lists(network: Network) -> None:
    floors = network.floors()
    floors.refresh()
    (change,) = floors.changes
    assert [(loaded.wanted.site, loaded.version) for loaded in change.maps] == [("high", 1)]
    assert change.building["high"].entry.level == "L1"


def test_a_version_that_is_not_signed_is_not_taken(network: Network) -> None:
    floors = network.floors()
    floors.refresh()
    keys = network.store.folder / "keys" / "site-high.pem"
    keys.rename(keys.with_suffix(".away"))
    robot_world.save(network.store, site="high")
    floors.refresh()
    assert len(floors.changes) == 1
    keys.with_suffix(".away").rename(keys)
    update_lists(network.store)
    floors.refresh()
    assert [loaded.version for loaded in floors.changes[-1].maps] == [2]


@pytest.mark.parametrize("record", [None, "tower of others", "annex"])
def test_a_site_that_is_no_floor_of_this_building_is_none(network: Network, record: str | None) -> None:
    """Its own signed list says where it belongs: a building that one of its sites alone names is half a change."""
    floors = (FloorEntry(site="high", level="L1", height_m=0.0), FloorEntry(site="third", level="L9", height_m=4.0))
    data = None if record is None else to_json(Building(name=record, floors=floors))
    network.store.keep_site_files("high", {FLOORS: data}, "")
    update_lists(network.store)
    floor_maps = network.floors()
    floor_maps.refresh()
    (change,) = floor_maps.changes
    assert (list(change.building), change.maps) == (["", "high"], []), "where it may be, without a map"
    network.store.keep_site_files("high", {FLOORS: network.store.site_file("low", FLOORS)}, "")
    update_lists(network.store)
    floor_maps.refresh()
    assert [loaded.wanted.site for loaded in floor_maps.changes[-1].maps] == ["high"]


def test_a_building_without_the_robots_own_site_is_not_taken(network: Network) -> None:
    floors = (FloorEntry(site="high", level="L1", height_m=0.0), FloorEntry(site="third", level="L9", height_m=4.0))
    floor_maps = network.floors()
    network.store.keep_site_files("low", {FLOORS: to_json(Building(name="tower", floors=floors))}, "")
    update_lists(network.store)
    floor_maps.refresh()
    assert not floor_maps.changes


def test_another_sites_map_is_not_taken_for_a_floors(network: Network) -> None:
    """A folder, whose files nobody signs: the upper floor's present version is the manifest of the lower one."""
    folder = network.store.folder
    (folder / current_path("high")).write_text((folder / current_path("low")).read_text())
    floor_maps = BuildingMaps(LocalMapSource(folder, "low"), lambda site: LocalMapSource(folder, site))
    floor_maps.refresh()
    (change,) = floor_maps.changes
    assert (list(change.building), change.maps) == (["", "high"], [])


def test_without_a_server_the_disk_has_them(network: Network) -> None:
    with_server = network.floors()
    with_server.refresh()
    network.service.close()
    network.service = None  # type: ignore[assignment]
    floors = network.floors()
    floors.refresh(asks=False)
    assert [loaded.version for loaded in floors.changes[-1].maps] == [1]
