"""A robot fetches whole versions: what changed, damage, a server that goes away and comes back."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import UnreachableError
from fleetmap.mapformat.tile import Tile, decode_tile
from fleetmap.messages import PART_BYTES
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from support.fleet.served_world import World, served_world
from support.storage.map_samples import random_tile
from support.storage.s3_server import Content


@pytest.fixture
def world(store_folder: Path) -> Iterator[World]:
    with served_world(store_folder.parent) as made:
        yield made


def moved(tile: Tile, rows: slice) -> Tile:
    points = tile.points_map.copy()
    points[rows, 2] += 1.0
    return replace(tile, points_map=points)


def large_site(world: World, count: int = 3, landmarks: int = 9000, seed: int = 0) -> list[Tile]:
    """Tiles that need two parts each."""
    rng = np.random.default_rng(seed)
    return [random_tile(rng, landmarks=landmarks, cell=(x, 0)) for x in range(count)]


def test_a_version_is_active_when_all_of_it_is_there(world: World) -> None:
    assert world.cache.active("lab") is None
    ready = world.link.ready()
    assert (ready.wanted.version, ready.note) == (1, "")
    assert world.cache.active("lab").version == 1
    manifest = world.link.manifest(ready.wanted)
    world.hub.reachable = False
    # Another process of the same robot, without a server.
    again = MapClient(world.robot_bus, TileCache(world.folder.parent / "cache"), "lab", "r1", timeout_s=0.1)
    later = again.ready()
    assert later.wanted == ready.wanted
    assert "version 1 stays active: no reply" in later.note
    assert len(again.tiles(again.manifest(later.wanted))[0]) == len(manifest.tiles)


def test_an_empty_cache_without_a_server_is_told(world: World) -> None:
    world.hub.reachable = False
    with pytest.raises(UnreachableError):
        world.link.ready()


def test_a_damaged_version_never_becomes_active(world: World) -> None:
    world.publish(large_site(world, seed=1))
    world.hall.ready()
    world.publish(large_site(world))
    bad = world.store.manifest("hall", 2).tiles[1]
    Content(world.store).write(bad.sha256, world.store.blob(bad.sha256)[:-1] + b"x")
    ready = world.hall.ready()
    assert ready.wanted.version == 1
    assert "version 1 stays active" in ready.note
    assert bad.sha256 in ready.note
    assert world.cache.active("hall").version == 1
    # A robot that has nothing yet takes what there is.
    fresh = MapClient(world.robot_bus, TileCache(world.folder.parent / "fresh"), "hall", "r2")
    ready = fresh.ready()
    assert ready.wanted.version == 2
    assert bad.sha256 in ready.note
    fetched, refused = fresh.tiles(fresh.manifest(ready.wanted))
    assert (sorted(fetched), list(refused)) == ([(0, 0), (2, 0)], [(1, 0)])


def test_a_night_costs_what_changed(world: World) -> None:
    tiles = large_site(world)
    world.publish(tiles)
    world.hall.ready()
    whole = world.hall.chunks.received_bytes
    assert whole > 900_000
    entries = world.store.manifest("hall", world.store.current("hall").version).tiles
    tiles = [decode_tile(world.store.blob(entry.sha256)) for entry in entries]
    world.publish(tiles)  # nothing moved
    world.hall.ready()
    unmoved = world.hall.chunks.received_bytes - whole
    assert world.cache.active("hall").version == 2
    assert unmoved < 0.01 * whole
    world.publish([moved(tiles[0], slice(0, 450)), *tiles[1:]])
    world.hall.ready()
    assert world.cache.active("hall").version == 3
    assert world.hall.chunks.received_bytes - whole - unmoved < 0.35 * whole  # one tile of three
    fetched, _ = world.hall.tiles(world.hall.manifest(world.hall.wanted()))
    np.testing.assert_allclose(fetched[0, 0].points_map[:450, 2], tiles[0].points_map[:450, 2] + 1.0, atol=1e-3)


@pytest.mark.parametrize("died_after", range(1, 8))
def test_a_fetch_goes_on_where_it_was(world: World, died_after: int) -> None:
    """The server goes away after any part, the robot gives up, and takes up later: no part comes twice."""
    wanted = world.publish(large_site(world))
    asked: list[tuple[str, bytes]] = []
    through = world.robot_bus.get

    def get(key: str, payload: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
        if len(asked) == died_after:
            world.hub.reachable = False
        answer = through(key, payload, timeout_s=timeout_s)
        asked.append((key, payload))
        return answer

    world.robot_bus.get = get
    with pytest.raises(UnreachableError):
        world.hall.bring(wanted)
    assert world.cache.active("hall") is None
    world.hub.reachable = True
    died_after = -1
    world.hall.bring(wanted)
    assert world.cache.active("hall").version == 1
    assert len(asked) == len(set(asked))
    assert world.hall.chunks.received_bytes == sum(
        len(world.cache.get(sha256)) for sha256 in world.cache.active("hall").blobs
    )


def test_no_message_of_a_large_site_exceeds_a_part(world: World) -> None:
    wanted = world.publish(large_site(world, 1, landmarks=30_000))
    sizes: list[int] = []
    through = world.robot_bus.get

    def get(key: str, payload: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
        answer = through(key, payload, timeout_s=timeout_s)
        sizes.append(len(answer))
        return answer

    world.robot_bus.get = get
    world.hall.bring(wanted)
    assert max(sizes) <= PART_BYTES + 100
    assert sum(sizes) > 1 << 20
