"""Canaries from start to end: who tries a version, what ends it, and that the other robots never see it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from fleetmap.errors import GateRefusedError, StateError, UsageError
from fleetmap.messages import WantedVersion, decode_message, robot_key
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from mapserver import releases
from mapserver.fleet.canary_controller import find, review
from mapserver.fleet.fleet import Fleet
from mapserver.fleet_statistics.canary_decision import CanarySettings, number_of
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings
from mapserver.serving.background_tasks import server_tasks
from mapserver.serving.bus_service import BusService
from mapserver.store import Actor, DraftContent, MapStore, Retention
from support.fleet.made_fleet import NS, Known, MadeRobot, Message, drive, hear
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.storage.map_samples import draft_details, publish_samples, random_tile, save_sample_draft


@dataclass
class World:
    """A server on a bus in memory, and made-up robots that run what they are told to."""

    store: MapStore
    fleet: Fleet
    service: BusService
    bus: MemoryBus
    clock: dict[str, int]
    robots: list[MadeRobot]
    told: dict[str, set[int | None]] = field(default_factory=dict)

    def hear(self, key: str, payload: bytes) -> None:
        wanted = decode_message(payload, WantedVersion)
        name = key.split("/")[3]
        self.told.setdefault(name, set()).add(wanted.version)
        robot = next(robot for robot in self.robots if robot.name == name)
        robot.version = wanted.version or 1

    def run(self, seconds: int, factor_on: dict[int, float]) -> None:
        """Seconds of driving; factor_on: how much more often robots fail on a version."""

        def said() -> Iterator[tuple[int, MadeRobot, Message]]:
            for now_ns, robot, message in drive(self.robots, seconds, self.clock["ns"]):
                robot.rate_factor = factor_on.get(robot.version, 1.0)
                yield now_ns, robot, message

        hear(self.fleet, said(), lambda now_ns: self.clock.update(ns=now_ns))


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    """Site lab with version 1, a draft 2, and 40 robots that are known."""
    clock = {"ns": 1_767_000_000 * NS}
    with (
        MapStore.open(tmp_path / "store", create=True, clock_ns=lambda: clock["ns"]) as store,
        MemoryBus(MemoryHub()) as bus,
    ):
        publish_samples(store, 1)
        save_sample_draft(store, seed=7)
        fleet = Fleet(store, clock_ns=lambda: clock["ns"])
        service = BusService(store, fleet, bus, lambda *_: None)
        rng = np.random.default_rng(2)
        robots = [MadeRobot("lab", f"r{n}", rng, Known(), rate_per_robot_day=2.0) for n in range(40)]
        world = World(store, fleet, service, bus, clock, robots)
        bus.subscribe(robot_key("lab", "*", "wanted"), world.hear)
        world.run(2, {})
        service.announce_changes()
        yield world
        service.close()


def test_a_bad_map_is_taken_back_and_nobody_else_saw_it(world: World) -> None:
    canary = releases.start_canary(world.store, "lab", 2, 0.1, actor=Actor("ada", "the nightly map"))
    members = {robot.name for robot in world.robots if number_of("lab", 2, robot.name) < canary.threshold}
    assert 1 <= len(members) <= 10
    world.service.announce_changes()
    assert {status.robot for status in world.fleet.robots("lab") if status.is_canary} == members
    tasks = server_tasks(world.store, world.fleet, world.service, CanarySettings(), ResurveySettings())
    for _ in range(8):
        world.run(30, {2: 900.0})
        for task in reversed(tasks):  # the server does them by itself
            task.act()
    assert {name for name, versions in world.told.items() if 2 in versions} == members
    assert {robot.version for robot in world.robots} == {1}
    assert world.store.current("lab").version == 1
    assert world.store.version("lab", 2).state == "retired"
    (row,) = world.store.canaries("lab")
    assert row.state == "rolled_back"
    assert " failures in " in row.outcome
    event = world.store.events("lab")[-1]
    assert (event.kind, event.version, event.actor, event.reason) == ("canary_rolled_back", 2, "canary", row.outcome)
    assert world.store.verify().faults == []


def test_a_good_map_is_promoted_for_all(world: World) -> None:
    releases.start_canary(world.store, "lab", 2, 0.3)
    world.service.announce_changes()
    world.run(5, {})
    quick = CanarySettings(min_robot_days=0.02, margin_per_robot_day=200.0)
    (row,) = world.store.canaries("lab")
    assert find(world.store, row, quick, world.clock["ns"]).action == "wait"
    world.run(240, {2: 0.0})
    (finding,) = review(world.store, quick, world.clock["ns"])
    assert finding.action == "promote"
    world.service.announce_changes()
    assert {robot.version for robot in world.robots} == {2}
    assert [info.state for info in world.store.versions("lab")] == ["published", "current"]
    (row,) = world.store.canaries("lab")
    assert (row.state, row.outcome) == ("promoted", finding.reason)
    assert releases.roll_back(world.store, "lab") == 1


def test_a_robot_fetches_what_it_is_told(world: World, tmp_path: Path) -> None:
    canary = releases.start_canary(world.store, "lab", 2, 0.1)
    inside = next(r.name for r in world.robots if number_of("lab", 2, r.name) < canary.threshold)
    outside = next(r.name for r in world.robots if number_of("lab", 2, r.name) >= canary.threshold)
    for name, version in ((inside, 2), (outside, 1)):
        ready = MapClient(world.bus, TileCache(tmp_path / name), "lab", name).ready()
        assert (ready.wanted.version, ready.note) == (version, "")


def test_people_may_end_it_in_both_ways(world: World) -> None:
    trial = releases.start_canary(world.store, "lab", 2, 0.1)
    with pytest.raises(StateError, match="no longer leads to version 1"):
        releases.roll_back(world.store, "lab", to=1)
    assert releases.roll_back(world.store, "lab", canary=trial.id, actor=Actor("ada", "complaints")) == 1
    with pytest.raises(StateError, match="has ended already"):
        releases.roll_back(world.store, "lab", canary=trial.id)
    assert world.store.version("lab", 2).state == "retired"
    assert "complaints" in world.store.canaries("lab")[0].outcome
    releases.start_canary(world.store, "lab", 2, 0.1)  # a second try
    releases.promote(world.store, "lab", 2, actor=Actor("ada", "the others agree"))
    assert [row.state for row in world.store.canaries("lab")] == ["promoted", "stopped"]
    assert world.store.canaries("lab")[0].outcome == "the others agree"
    assert [event.kind for event in world.store.log(site="lab", limit=2)] == ["promoted", "canary_promoted"]
    assert world.store.canaries("lab", running=True) == []
    releases.start_canary(world.store, "lab", 1, 0.1)
    publish_samples(world.store, 1, first=8)
    assert world.store.canaries("lab")[0].outcome == "version 3 became current"
    assert [event.kind for event in world.store.log(site="lab", limit=2)] == ["published", "canary_stopped"]
    assert world.store.current("lab").version == 3


def test_what_cannot_be_tried_is_refused(world: World) -> None:
    store = world.store
    with pytest.raises(StateError, match="version 1 as its current one"):
        releases.start_canary(store, "lab", 1, 0.1)
    with pytest.raises(UsageError, match="no version 9"):
        releases.start_canary(store, "lab", 9, 0.1)
    with pytest.raises(UsageError, match="between 0 and 1"):
        releases.start_canary(store, "lab", 2, 5.0)
    canary = releases.start_canary(store, "lab", 2, 0.1)
    with pytest.raises(StateError, match="has a canary of version 2"):
        releases.start_canary(store, "lab", 2, 0.1)
    releases.roll_back(store, "lab")
    for promote in (True, False):  # somebody was faster
        with pytest.raises(StateError, match="no longer a canary"):
            releases.end_canary(store, canary, promote=promote, outcome="late")
    assert store.current("lab").version == 1
    save_sample_draft(store, site="empty")
    with pytest.raises(StateError, match="no current version"):
        releases.start_canary(store, "empty", 1, 0.1)
    few = [random_tile(np.random.default_rng(1), landmarks=2, places=1)]
    store.save("lab", DraftContent(tiles=few, vocabulary=b"words" * 50, details=draft_details(path_m=1.0)))
    with pytest.raises(GateRefusedError):
        releases.start_canary(store, "lab", 3, 0.1)


def test_garbage_collection_leaves_what_is_tried(world: World) -> None:
    releases.start_canary(world.store, "lab", 2, 0.1)
    world.clock["ns"] += 100 * 86_400 * NS
    world.store.collect_garbage(Retention(keep_versions=0, keep_drafts=0, keep_days=0.0, robot_days=1.0))
    assert [info.state for info in world.store.versions("lab")] == ["current", "published"]


# Releases where others were faster, or something else was current.

ADA = Actor("ada", "a test")


@pytest.fixture
def store(store: MapStore) -> MapStore:
    """Versions 1 and 2, published, and 3, a draft."""
    publish_samples(store, 2)
    save_sample_draft(store, seed=3)
    return store


@pytest.fixture
def meanwhile(monkeypatch) -> Callable[[Callable[[], object]], None]:
    """Something that happens once between the judgement of a draft and its release."""
    real = releases._pass_gate

    def between(action: Callable[[], object]) -> None:
        def judged(*given: object, **more: object) -> object:
            monkeypatch.setattr(releases, "_pass_gate", real)
            found = real(*given, **more)
            action()
            return found

        monkeypatch.setattr(releases, "_pass_gate", judged)

    return between


def test_the_newest_draft_is_chosen(store: MapStore) -> None:
    save_sample_draft(store, seed=4)
    for wanted, error, words in ((1, StateError, "is published"), (9, UsageError, "no version 9")):
        with pytest.raises(error, match=words):
            releases.publish(store, "lab", wanted)
    assert [releases.publish(store, "lab"), releases.publish(store, "lab")] == [4, 3]
    with pytest.raises(UsageError, match="no draft"):
        releases.publish(store, "lab")


def test_publishing_replaces_the_version_that_the_draft_was_compared_with(store: MapStore, meanwhile) -> None:
    meanwhile(lambda: releases.promote(store, "lab", 1))
    with pytest.raises(StateError, match="became current while draft 3 was compared with 2"):
        releases.publish(store, "lab")
    assert [info.state for info in store.versions("lab")] == ["current", "published", "draft"]
    assert releases.publish(store, "lab") == 3


def test_a_canary_begins_only_beside_the_version_that_it_was_judged_against(store: MapStore, meanwhile) -> None:
    meanwhile(lambda: releases.promote(store, "lab", 1))
    with pytest.raises(StateError, match="meanwhile by another operator"):
        releases.start_canary(store, "lab", 3, 0.1)
    meanwhile(lambda: releases.start_canary(store, "lab", 2, 0.1))
    with pytest.raises(StateError, match="meanwhile by another operator"):
        releases.start_canary(store, "lab", 3, 0.1)
    releases.roll_back(store, "lab")
    releases.start_canary(store, "lab", 3, 0.1)
    assert [event.kind for event in store.log(site="lab", limit=2)] == ["canary_started", "admitted"]
