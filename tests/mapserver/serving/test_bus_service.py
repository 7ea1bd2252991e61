"""From the store over the bus to the robot and back, on the in-memory bus."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest

from fleetmap.errors import LinkError, MapFormatError, UnreachableError
from fleetmap.mapformat.names import blob_path, sha256_hex
from fleetmap.messages import (
    FailureAck,
    PoseMessage,
    RobotAck,
    RobotHealth,
    WantedVersion,
    decode_message,
    encode_message,
    part_of,
    robot_key,
)
from fleetmap.version_grid import OccupancyGrid
from locclient.maps.loaded_map import TileSelectionSettings
from locclient.maps.map_source import CachedMap, LocalMapSource
from locclient.maps.tile_cache import TileCache
from locclient.maps.tile_loader import TileLoader
from mapserver import releases
from mapserver.fleet.fleet import Fleet
from mapserver.serving import bus_service
from mapserver.serving.bus_service import ByteCache
from mapserver.store import Actor, FailureFilter, MapStore
from support.fleet.memory_bus import MemoryBus
from support.fleet.reports import blindness
from support.fleet.served_world import World
from support.storage.map_samples import publish_samples, save_grid_draft, save_sample_draft

FOREIGN_VOCABULARY = b"other" * 50


def test_a_robot_fetches_everything_once(world: World) -> None:
    wanted = world.link.wanted()
    assert wanted == WantedVersion(site="lab", version=1, manifest_sha256=world.store.current("lab").manifest_sha256)
    manifest = world.link.manifest(wanted)
    assert world.link.vocabulary(manifest) == b"words" * 50
    fetched, refused = world.link.tiles(manifest)
    assert sorted(fetched) == [(0, 0), (1, 0)]
    assert refused == {}
    assert sorted(world.link.tiles(manifest, [(1, 0), (9, 9)])[0]) == [(1, 0)]
    assert [what for what, result, _ in world.counts if result == "ok"] == ["wanted", "manifest", *["blob"] * 3]


def test_a_robot_takes_the_grid_with_its_version_and_then_what_changed(world: World, caplog) -> None:
    def ready(seed: int) -> WantedVersion:
        save_grid_draft(world.store, seed)
        releases.publish(world.store, "lab", actor=Actor("ada", "a test"), force=True)
        world.link.bring(world.link.wanted())
        return world.link.wanted()

    def grid(wanted: WantedVersion) -> OccupancyGrid:
        cached = CachedMap(TileCache(world.folder.parent / "cache"), "lab")
        return TileLoader(cached, TileSelectionSettings()).grid(wanted, 1.1)

    with pytest.raises(LinkError, match="not in the cache"):
        grid(ready(0))  # a robot that nobody plans for does without
    world.link.takes_grids = True
    first = grid(ready(1))
    assert (first.cells == 100).any()
    second = grid(ready(2))
    assert (second.cells == 100).sum() < (first.cells == 100).sum()
    # A grid that cannot be had costs the robot nothing else.
    save_grid_draft(world.store, 3)
    index = str(world.store.manifest("lab", 5).report["grid"]["sha256"])
    with pytest.raises(LinkError, match="no published bytes"):
        world.link.blob(index, 10**6)
    releases.publish(world.store, "lab", actor=Actor("ada", "a test"), force=True)
    (world.folder / blob_path(index)).unlink()
    world.link.bring(world.link.wanted())
    assert world.link.active().version == 5
    assert "without its grid" in caplog.text


def test_a_store_folder_gives_the_same(world: World) -> None:
    folder = LocalMapSource(world.folder, "lab")
    wanted = folder.wanted()
    assert wanted == world.link.wanted()
    manifest = folder.manifest(wanted)
    assert manifest == world.link.manifest(wanted)
    assert folder.vocabulary(manifest) == world.link.vocabulary(manifest)
    mine, theirs = folder.tiles(manifest)[0], world.link.tiles(manifest)[0]
    assert sorted(mine) == sorted(theirs)
    np.testing.assert_array_equal(mine[0, 0].points_map, theirs[0, 0].points_map)
    other = LocalMapSource(world.folder, "elsewhere")
    assert other.wanted().version is None
    with pytest.raises(LinkError, match="no published version"):
        other.manifest(other.wanted())


def test_a_lying_server_is_refused_by_hash(world: World) -> None:
    manifest = world.link.manifest(world.link.wanted())
    world.service.close()
    with MemoryBus(world.hub) as liar:
        liar.queryable(robot_key("*", "*", "blobs/*"), lambda _, asked: part_of(b"something else", asked))
        liar.queryable(robot_key("*", "*", "manifests/*"), lambda _, asked: part_of(b"{}", asked))
        fetched, refused = world.link.tiles(manifest)
        assert fetched == {}
        assert all("damaged" in reason for reason in refused.values())
        wanted = WantedVersion(site="lab", version=2, manifest_sha256="0" * 64)
        with pytest.raises(MapFormatError, match="damaged"):
            world.link.manifest(wanted)
    assert all(tile.sha256 not in world.cache for tile in manifest.tiles)


def test_row_11_a_vocabulary_of_another_site(world: World) -> None:
    """A sound one, under the address of the right one: words of one vocabulary mean nothing in a map of another."""
    manifest = world.link.manifest(world.link.wanted())
    world.service.close()
    with MemoryBus(world.hub) as liar:
        liar.queryable(robot_key("*", "*", "blobs/*"), lambda _, asked: part_of(FOREIGN_VOCABULARY, asked))
        with pytest.raises((MapFormatError, LinkError), match=r"damaged|at most"):
            world.link.vocabulary(manifest)
        # The control: under its own address it is taken.
        address = sha256_hex(FOREIGN_VOCABULARY)
        assert world.link.blob(address, len(FOREIGN_VOCABULARY)) == FOREIGN_VOCABULARY
    assert manifest.vocabulary.sha256 not in world.cache


def test_silence_is_waited_for_once(world: World) -> None:
    manifest = world.link.manifest(world.link.wanted())
    world.robot_bus.get = Mock(side_effect=UnreachableError("nobody"))
    assert len(world.link.tiles(manifest)[1]) == 2
    world.robot_bus.get.assert_called_once()


def test_robots_see_published_things_only(world: World) -> None:
    save_sample_draft(world.store, seed=3)
    draft = world.store.version("lab", 2)
    tile = world.store.manifest("lab", 2).tiles[0].sha256
    archive = world.store.version("lab", 1).archive_sha256
    for key, words in (
        (robot_key("lab", "r1", "manifests/2"), "draft"),
        (robot_key("lab", "r1", "manifests/7"), "no version 7"),
        (robot_key("lab", "r1", "manifests/x"), "invalid version number"),
        (robot_key("lab", "r1", f"blobs/{tile}"), "no published bytes"),
        (robot_key("lab", "r1", f"blobs/{archive}"), "no published bytes"),
        (robot_key("lab", "r1", f"blobs/{draft.manifest_sha256}"), "no published bytes"),
        (robot_key("lab", "r1", "blobs/.."), "not a SHA-256"),
        (robot_key("nowhere", "r1", "wanted"), "no site nowhere"),
        (robot_key("lab", "R 1", "wanted"), "robot name"),
    ):
        with pytest.raises(LinkError, match=words):
            world.robot_bus.get(key)
    assert world.counts[-1] == ("wanted", "refused", 0)


def test_new_versions_are_announced_to_known_robots(world: World) -> None:
    heard: list[WantedVersion] = []
    world.link.hear("wanted", WantedVersion, heard.append)
    assert world.link.wanted().version == 1  # asking makes it known
    assert world.service.announce_changes() == ["lab"]
    assert [message.version for message in heard] == [1]
    assert world.service.announce_changes() == []
    with MapStore.open(world.folder) as other_process:
        publish_samples(other_process, 1, first=9)
    assert world.service.announce_changes() == ["lab"]
    assert [message.version for message in heard] == [1, 2]
    assert world.link.manifest(heard[-1]).version == 2


def test_reports_reach_the_fleet_and_survive_a_restart(world: World) -> None:
    world.link.ack(1, stamp_ns=5, refused="tile (0, 0): damaged")
    health = RobotHealth(site="lab", robot="r1", stamp_ns=6, version=1, status="TRACKING", metrics={"matches": 80})
    world.link.publish("health", health)
    world.link.publish("pose", PoseMessage.of(7, np.eye(4), np.eye(6), "TRACKING", 1))
    (status,) = world.fleet.robots()
    assert (status.site, status.robot, status.seconds_since) == ("lab", "r1", 0)
    assert (status.version, status.wanted_version) == (1, 1)
    assert status.last_ack["refused"] == "tile (0, 0): damaged"
    assert status.last_health["metrics"] == {"matches": 80}
    assert status.last_pose["stamp_ns"] == 7
    world.fleet.flush()
    (again,) = Fleet(world.store, clock_ns=lambda: 10**18 + 5 * 10**9).robots("lab")
    assert (again.version, again.seconds_since) == (1, 5)
    assert again.last_ack == status.last_ack
    assert Fleet(world.store).robots("other") == []


def test_health_is_saved_with_the_next_flush(tmp_path: Path) -> None:
    now = {"ns": 10**18}
    with MapStore.open(tmp_path, create=True, clock_ns=lambda: now["ns"]) as store:
        save_sample_draft(store)
        fleet = Fleet(store, clock_ns=lambda: now["ns"])
        saved = []
        for step in range(30):
            now["ns"] = 10**18 + step * 100_000_000
            health = RobotHealth(site="lab", robot="r1", stamp_ns=step, version=None, status="LOST")
            fleet.take_health("lab", "r1", health)
            if step % 10 == 0:
                fleet.flush()
            saved.append(store.robots()[0].last_report["health"]["stamp_ns"])
        assert sorted(set(saved)) == [0, 10, 20]
        assert fleet.robots()[0].last_health["stamp_ns"] == 29


def test_presence_is_what_the_bus_shows(world: World) -> None:
    world.link.ack(1, stamp_ns=5)
    assert [robot.is_present for robot in world.fleet.robots()] == [None]
    handle = world.link.announce_presence()
    world.service.look_for_robots()
    assert [robot.is_present for robot in world.fleet.robots()] == [True]
    handle.close()
    world.service.look_for_robots()
    assert [robot.is_present for robot in world.fleet.robots()] == [False]


def test_a_failure_is_acknowledged_when_it_is_on_the_disk(world: World) -> None:
    report = blindness("f-1", wall_ns=10**18 - 1, tile=(0, 0))
    key = robot_key("lab", "r1", "failures")
    for _ in range(2):
        ack = decode_message(world.robot_bus.get(key, encode_message(report)), FailureAck)
        assert (ack.id, ack.refused) == ("f-1", "")
        with MapStore.open(world.folder) as other_process:
            (row,) = other_process.fleet.failures(FailureFilter())
            assert (row.failure_id, row.tile, row.version) == ("f-1", "0,0", 1)
    stolen = robot_key("lab", "r2", "failures")
    assert "in the name of" in decode_message(world.robot_bus.get(stolen, encode_message(report)), FailureAck).refused
    with pytest.raises(LinkError, match="FailureReport"):
        world.robot_bus.get(key, b"nonsense")
    assert world.counts[-1] == ("failure", "refused", 0)


def test_a_report_that_cannot_be_read_is_refused_for_good_and_set_aside(world: World) -> None:
    """It says its id, so that the robot can let go of it; of another fleetmap it may be."""
    key = robot_key("lab", "r1", "failures")
    payload = msgspec.msgpack.encode({"id": "f-7", "site": "lab", "robot": "r1", "kind": 3})
    ack = decode_message(world.robot_bus.get(key, payload), FailureAck)
    assert ack.id == "f-7"
    assert "no FailureReport" in ack.refused
    answered = ("failure", "ok", len(encode_message(ack)))
    assert world.counts[-2:] == [("failure refused for good", "refused", 0), answered]
    (kept,) = (world.folder / "refused").glob("*.msgpack")
    assert kept.read_bytes() == payload
    assert ack.refused in kept.with_suffix(".reason.txt").read_text()
    for number in range(120):
        world.fleet.take_failure_bytes("lab", f"r{number % 3}", msgspec.msgpack.encode({"id": f"g-{number}"}))
    assert len(list((world.folder / "refused").iterdir())) <= 200
    assert world.store.verify().faults == []


def test_bad_messages_are_counted_and_change_nothing(world: World, caplog) -> None:
    bus = world.robot_bus
    bus.publish(robot_key("lab", "r1", "ack"), b"nonsense")
    stolen = RobotAck(site="lab", robot="r2", stamp_ns=1, version=1)
    bus.publish(robot_key("lab", "r3", "ack"), encode_message(stolen))
    elsewhere = RobotHealth(site="nowhere", robot="r1", stamp_ns=1, version=None, status="LOST")
    bus.publish(robot_key("nowhere", "r1", "health"), encode_message(elsewhere))
    assert [what for what, result, _ in world.counts if result == "refused"] == ["ack", "ack", "health"]
    assert world.fleet.robots() == []
    assert "in the name of 'r2'" in caplog.text


def test_reports_have_a_size_and_a_rate(world: World, monkeypatch) -> None:
    def report(stamp_ns: int, words: dict[str, object]) -> bytes:
        fields = {"site": "lab", "robot": "r1", "stamp_ns": stamp_ns, "version": 1, "status": "LOST", "metrics": words}
        return msgspec.msgpack.encode(fields)

    key = robot_key("lab", "r1", "health")
    many = {f"m{n}": "x" * 1900 for n in range(10)}
    for words in (many, {"one": "x" * 3000}):
        world.robot_bus.publish(key, report(1, words))
        assert world.counts[-1] == ("health", "refused", 0)
    assert world.fleet.robots() == []
    monkeypatch.setattr(bus_service, "MAX_REPORT_BYTES", 1 << 20)
    world.robot_bus.publish(key, report(1, many))
    assert world.counts[-1] == ("health", "ok", 0), "the control"
    for number in range(100):
        world.robot_bus.publish(key, report(number, {}))
    assert [event for event in world.counts if event[:2] == ("health", "dropped")]
    taken = len([event for event in world.counts if event == ("health", "ok", 0)])
    assert 15 <= taken <= 25
    world.robot_bus.publish(robot_key("lab", "r2", "health"), report(1, {}).replace(b"r1", b"r2"))
    assert world.counts[-1] == ("health", "ok", 0), "another robot has a rate of its own"


def test_the_least_recently_used_go_first_and_nothing_is_kept_beyond_the_limit() -> None:
    read: list[str] = []

    def blob(key: str) -> bytes:
        read.append(key)
        if key == "missing":
            raise LookupError
        return b"" if key.startswith("empty") else key.encode() * (2000 if key == "x" else 100)

    held = ByteCache(1000, blob)
    for key in "abcabdbc":
        assert held.get(key) == key.encode() * 100
    assert read == ["a", "b", "c", "d", "c"]
    assert len(held.get("x")) == 2000
    with pytest.raises(LookupError):
        held.get("missing")
    for number in range(100):
        held.get(f"empty {number}")
    assert 0 < held.total_bytes() <= 1000


def test_what_many_ask_for_at_once_is_read_once() -> None:
    """Also where reading it fails at first: the next one tries."""
    begun, read = threading.Event(), []

    def blob(key: str) -> bytes:
        read.append(key)
        begun.wait(5)
        if len(read) == 1:
            raise LookupError
        return b"tile"

    held = ByteCache(1000, blob)
    with ThreadPoolExecutor(8) as pool:
        asked = [pool.submit(held.get, "a") for _ in range(8)]
        while not read:
            time.sleep(0.001)
        begun.set()
        failed = sum(answer.exception() is not None for answer in asked)
        answers = [answer.result() for answer in asked if answer.exception() is None]
    assert (failed, answers, len(read)) == (1, [b"tile"] * 7, 2)


def test_nobody_waits_for_other_bytes() -> None:
    """An object store that answers slowly stops only those who ask for the same."""
    begun, slow = threading.Event(), threading.Event()

    def blob(key: str) -> bytes:
        if key == "slow":
            begun.set()
            assert slow.wait(20)
        return key.encode()

    held = ByteCache(1000, blob)
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(held.get, "slow")
        assert begun.wait(20)
        assert [held.get(key) for key in ("known", "known")] == [b"known"] * 2
        slow.set()
        assert asked.result() == b"slow"
