"""Tiles around the robot are in memory, the others on the disk; bad ones are left out with their reasons; maps of other floors follow."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from fleetmap.encoding import to_json
from fleetmap.errors import FleetmapError, LinkError, StoreError, UnreachableError
from fleetmap.mapformat.building import FLOORS, Building, FloorEntry
from fleetmap.mapformat.names import blob_path, current_path
from fleetmap.messages import (
    PART_BYTES,
    ChunkRequest,
    Part,
    Status,
    WantedVersion,
    decode_message,
    encode_message,
    part_of,
)
from fleetmap.trust.trusted_map import TrustedMap, ask_over
from locclient.maps import map_client
from locclient.maps.building_maps import BuildingMaps
from locclient.maps.loaded_map import PositionBound, TileSelectionSettings
from locclient.maps.map_client import ChunkReader, MapClient
from locclient.maps.map_source import CachedMap, LocalMapSource
from locclient.maps.tile_cache import TileCache
from locclient.maps.tile_loader import TileLoader
from mapserver import releases
from mapserver.fleet.fleet import Fleet
from mapserver.serving.bus_service import BusService
from mapserver.store import DraftContent, MapStore
from mapserver.trust import init_here, update_lists
from support.fleet.estimates import estimate
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.storage.map_samples import draft_details, random_tile
from support.worlds import robot_world
from support.worlds.building import house
from support.worlds.robot_world import vocabulary

SETTINGS = TileSelectionSettings(reach_m=20.0, ahead_s=8.0, spare_m=10.0)


@pytest.fixture(scope="module")
def row(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, MapStore]]:
    """A site of ten tiles in a row along x."""
    folder = tmp_path_factory.mktemp("row") / "store"
    rng = np.random.default_rng(0)
    with MapStore.open(folder, create=True) as store:
        tiles, details = [random_tile(rng, cell=(x, 0)) for x in range(10)], draft_details(path_m=160.0)
        store.save("row", DraftContent(tiles=tiles, vocabulary=vocabulary(), details=details, archive=b"a"))
        releases.publish(store, "row")
        yield folder, store


def at(x_m: float) -> np.ndarray:
    return np.array([x_m, 8.0, 1.0])


@pytest.mark.parametrize(("report", "step_m"), [({}, 2.5), ({"alias_step_m": None}, 2.5), ({"alias_step_m": 5.0}, 5.0)])
def test_a_manifest_says_how_near_look_alikes_are(
    row: tuple[Path, MapStore], report: dict[str, float | None], step_m: float
) -> None:
    """Those of older servers do not say it."""
    link = LocalMapSource(row[0], "row")
    loaded = TileLoader(link, SETTINGS).load(link.wanted(), PositionBound())
    assert replace(loaded, manifest=msgspec.structs.replace(loaded.manifest, report=report)).alias_step_m == step_m


def test_memory_follows_the_robot(row: tuple[Path, MapStore]) -> None:
    link = LocalMapSource(row[0], "row")
    loader, wanted = TileLoader(link, SETTINGS), link.wanted()
    everywhere = loader.load(wanted, PositionBound())
    assert sorted(everywhere.tiles) == [(x, 0) for x in range(10)]
    near = loader.load(wanted, PositionBound(at(8.0)))
    assert sorted(near.tiles) == [(0, 0), (1, 0), (2, 0)]  # those held within reach and a spare stay
    assert loader.load(wanted, PositionBound(at(8.5))) is None, "nothing changed"
    ahead = loader.load(wanted, PositionBound(at(30.0), np.array([4.0, 0, 0])))
    assert sorted(ahead.tiles) == [(x, 0) for x in range(6)]
    loader.keep_only([])
    assert loader.load(wanted, PositionBound(at(8.0))) is not None, "forgotten and read again"


def test_a_lost_robot_holds_the_tiles_that_it_can_have_come_to(row: tuple[Path, MapStore]) -> None:
    """Not those where it says that it is: it would drive out of the map, and never find another bound."""
    loader, most_mps = TileLoader(LocalMapSource(row[0], "row"), SETTINGS), SETTINGS.most_mps
    wanted = LocalMapSource(row[0], "row").wanted()
    bound = PositionBound().after(estimate(0.0, Status.AMBIGUOUS, known=False), most_mps)
    assert bound.position_map_m is None, "anywhere"
    bound = bound.after(estimate(1.0, x_m=40.0), most_mps)
    assert bound.radius_m == 0
    held = []
    for seconds in (1, 10, 40):
        bound = bound.after(estimate(1.0 + seconds, Status.LOST, x_m=40.0 + 900.0 * seconds), most_mps)
        np.testing.assert_array_equal(bound.position_map_m, [40.0, 0.0, 0.0])
        assert SETTINGS.most_mps * seconds <= bound.radius_m <= SETTINGS.most_mps * seconds + 10
        loaded = loader.load(wanted, bound)
        held.append(sorted(x for x, _ in loaded.tiles))
    assert held == [list(range(5)), list(range(6)), list(range(10))]
    found = bound.after(estimate(42.0, Status.DEGRADED, x_m=140.0), most_mps)
    assert (float(found.position_map_m[0]), found.radius_m) == (140.0, 0.0)  # type: ignore[index]


def test_a_place_on_another_floor_bounds_no_tiles_of_its_own_site() -> None:
    """Coordinates there mean nothing here; without all tiles its own floor would not compete with an equal one."""
    bound = PositionBound().after(estimate(0.0, x_m=40.0), 3.0)
    bound = bound.after(replace(estimate(1.0, x_m=140.0), floor="hall-2"), 3.0)
    assert bound.position_map_m is bound.after(estimate(2.0, Status.LOST, known=False), 3.0).position_map_m is None


def test_bad_tiles_are_left_out(row: tuple[Path, MapStore]) -> None:
    folder, store = row
    manifest = store.manifest("row", 1)
    victim = folder / blob_path(manifest.tiles[4].sha256)
    good = victim.read_bytes()
    link = LocalMapSource(folder, "row")
    loader, wanted = TileLoader(link, SETTINGS), link.wanted()
    victim.chmod(0o644)
    victim.write_bytes(good[:-7])
    try:
        loaded = loader.load(wanted, PositionBound())
        assert len(loaded.tiles) == 9
        assert list(loaded.refused) == [(4, 0)]
        assert loader.load(wanted, PositionBound()) is None, "not read again and again"
    finally:
        victim.write_bytes(good)
    loader.retry_refused(wanted)
    mended = loader.load(wanted, PositionBound())
    assert len(mended.tiles) == 10
    foreign = WantedVersion(site="else", version=1, manifest_sha256=wanted.manifest_sha256)
    with pytest.raises(FleetmapError, match="manifest is of row version 1"):
        TileLoader(LocalMapSource(folder, "else"), SETTINGS).load(foreign, PositionBound())


def test_a_folder_without_sites_is_no_store(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="not a map store"):
        LocalMapSource(tmp_path, "lab")


def test_a_damaged_current_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "sites" / "lab").mkdir(parents=True)
    source = LocalMapSource(tmp_path, "lab")
    assert source.wanted().manifest_sha256 is None
    (tmp_path / "sites" / "lab" / "current").write_bytes(b"\xff\xfe nonsense")
    with pytest.raises(StoreError, match="repair"):
        source.wanted()
    with pytest.raises(StoreError, match="incomplete"):
        source.blob("0" * 64)


ROBOT = "r1"
BEYOND = FloorEntry(site="high", level="L1", height_m=0.0), FloorEntry(site="third", level="L9", height_m=4.0)


class Network:
    """A server of the building, and robots of its lower floor on one disk."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.cache, self.hub, self._stack = folder / "cache", MemoryHub(), stack
        tiles = robot_world.tiles()
        self.store = stack.enter_context(house(folder / "store", tiles, tiles, has_grid=True))
        init_here(self.store)
        self.bus = stack.enter_context(MemoryBus(self.hub))
        self.service = BusService(self.store, Fleet(self.store), self.bus, lambda *_: None)

    def floors(self, *, takes_grid_of: str = "") -> BuildingMaps:
        bus, cache = self._stack.enter_context(MemoryBus(self.hub)), TileCache(self.cache)
        root = (self.store.folder / "trust" / "1.root.json").read_bytes()

        def client(site: str) -> MapClient:
            made = MapClient(bus, cache, site, ROBOT, timeout_s=0.2)
            made.takes_grids = site == takes_grid_of
            made.trust = TrustedMap(self.cache / "trust" / site, site, root, ask_over(bus, site, ROBOT, 0.2))
            return made

        own, is_served = client("low"), self.service is not None
        if is_served:
            own.bring(own.wanted())
        floors = BuildingMaps(own, client)
        floors.refresh(asks=is_served)
        return floors


@pytest.fixture
def network(tmp_path: Path) -> Iterator[Network]:
    with ExitStack() as stack:
        yield Network(tmp_path, stack)


def test_floors_come_by_signed_lists(network: Network) -> None:
    (change,) = network.floors().changes
    assert [(loaded.wanted.site, loaded.version) for loaded in change.maps] == [("high", 1)]
    assert change.building["high"].entry.level == "L1"


def test_a_version_that_is_not_signed_is_not_taken(network: Network) -> None:
    floors = network.floors()
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
    data = None if record is None else to_json(Building(name=record, floors=BEYOND))
    network.store.keep_site_files("high", {FLOORS: data}, "")
    update_lists(network.store)
    floor_maps = network.floors()
    (change,) = floor_maps.changes
    assert (list(change.building), change.maps) == (["", "high"], []), "where it may be, without a map"
    network.store.keep_site_files("high", {FLOORS: network.store.site_file("low", FLOORS)}, "")
    update_lists(network.store)
    floor_maps.refresh()
    assert [loaded.wanted.site for loaded in floor_maps.changes[-1].maps] == ["high"]


def test_a_building_without_the_robots_own_site_is_not_taken(network: Network) -> None:
    network.store.keep_site_files("low", {FLOORS: to_json(Building(name="tower", floors=BEYOND))}, "")
    update_lists(network.store)
    assert not network.floors().changes


def test_another_sites_map_is_not_taken_for_a_floors(network: Network) -> None:
    """A folder, whose files nobody signs: the upper floor's present version is the manifest of the lower one."""
    folder = network.store.folder
    (folder / current_path("high")).write_text((folder / current_path("low")).read_text())
    floor_maps = BuildingMaps(LocalMapSource(folder, "low"), lambda site: LocalMapSource(folder, site))
    floor_maps.refresh()
    (change,) = floor_maps.changes
    assert (list(change.building), change.maps) == (["", "high"], [])


def test_without_a_server_the_disk_has_them(network: Network) -> None:
    network.floors()
    network.service.close()
    network.service = None  # type: ignore[assignment]
    assert [loaded.version for loaded in network.floors().changes[-1].maps] == [1]


def test_planners_get_the_grid_of_a_floor_that_came_without(network: Network) -> None:
    network.floors()
    floors = network.floors(takes_grid_of="high")
    loader = TileLoader(CachedMap(TileCache(network.cache), "low"), TileSelectionSettings())
    assert (loader.grid(floors.held["high"], 1.0).cells == 100).any()


# Parts: put together in order, bounded, and never believed.

DATA = bytes(range(256)) * 3000  # three parts
WHOLE = PART_BYTES + 5


def answered(**answers: Callable[[str, bytes], bytes]) -> ChunkReader:
    """A reader of a server with these answers."""
    hub = MemoryHub()
    for key, answer in answers.items():
        MemoryBus(hub).queryable(key, answer)
    return ChunkReader(MemoryBus(hub), timeout_s=0.01, patience_s=0)


def test_parts_become_the_whole() -> None:
    reader = answered(x=lambda _, asked: part_of(DATA, asked), empty=lambda _, asked: part_of(b"", asked))
    assert reader.read("x", max_bytes=len(DATA)) == DATA
    assert reader.received_bytes == len(DATA)
    assert reader.read("empty", max_bytes=0) == b""
    with pytest.raises(LinkError, match="at most 100"):
        reader.read("x", max_bytes=100)


def test_an_empty_question_asks_for_the_first_part() -> None:
    part = decode_message(part_of(DATA, b""), Part)
    assert (part.total_bytes, part.offset, part.data) == (len(DATA), 0, DATA[:PART_BYTES])
    beyond = decode_message(part_of(DATA, encode_message(ChunkRequest(offset=10**9))), Part)
    assert (beyond.total_bytes, beyond.data) == (len(DATA), b"")
    for nonsense in (b"x", b"\x80\x80", encode_message(Part(total_bytes=1, offset=0, data=b""))[:-1]):
        with pytest.raises(LinkError):
            part_of(DATA, nonsense)


@pytest.mark.parametrize(
    ("second", "words"),
    [
        (Part(total_bytes=WHOLE, offset=0, data=b"01234"), "from 0 on"),
        (Part(total_bytes=WHOLE, offset=PART_BYTES, data=b""), "0 bytes from byte 262144"),
        (Part(total_bytes=WHOLE, offset=PART_BYTES, data=b"0123"), "4 bytes from byte 262144"),
        (Part(total_bytes=WHOLE, offset=PART_BYTES, data=b"0123456"), "got 7 from 262144"),
        (Part(total_bytes=10**6, offset=PART_BYTES, data=b"0"), "has 1000000 bytes"),
    ],
)
def test_nonsense_is_refused(second: Part, words: str) -> None:
    parts = [second, Part(total_bytes=WHOLE, offset=0, data=bytes(PART_BYTES))]
    reader = answered(x=lambda *_: encode_message(parts.pop()))
    with pytest.raises(LinkError, match=words):
        reader.read("x", max_bytes=WHOLE)


def test_row_15_a_server_that_gives_bytes_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def slow(_: str, question: bytes) -> bytes:
        offset = decode_message(question, ChunkRequest).offset
        asked.append(offset)
        return encode_message(Part(total_bytes=500, offset=offset, data=b"x"))

    reader = answered(x=slow)
    with pytest.raises(LinkError, match="1 bytes from byte 0 on of 500"):
        reader.read("x", max_bytes=500)
    assert asked == [0]
    monkeypatch.setattr(map_client, "PART_BYTES", 1)  # the control: without the rule it goes on
    reader.read("x", max_bytes=500)
    assert len(asked) == 501


def test_patience_ends() -> None:
    bus, now, asked = MemoryBus(MemoryHub()), [0.0], []

    def get(key: str, payload: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
        asked.append(key)
        now[0] += timeout_s
        raise UnreachableError(key)

    bus.get = get
    with pytest.raises(UnreachableError):
        ChunkReader(bus, timeout_s=5.0, patience_s=9.0, clock_s=lambda: now[0]).read("x", max_bytes=1)
    assert len(asked) == 2
