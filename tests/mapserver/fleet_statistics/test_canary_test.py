"""A version that some robots try first: who they are, what their failures prove, and that the others never see it."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from scipy import integrate, stats

from fleetmap.bus import MemoryBus, MemoryHub
from fleetmap.errors import GateRefusedError, StateError, UsageError
from fleetmap.messages import FailureReport, PoseMessage, RobotHealth, WantedVersion, decode_message, robot_key
from locclient.maps.map_client import MapClient
from locclient.maps.tile_cache import TileCache
from mapserver.fleet.canary_controller import find, review
from mapserver.fleet.fleet import Fleet
from mapserver.fleet_statistics.canary_test import (
    CanarySettings,
    evidence_of_harm,
    judge_canary,
    number_of,
    threshold_for,
    within_margin,
)
from mapserver.fleet_statistics.kpis import Tally, rate
from mapserver.serving.bus_service import BusService
from mapserver.store import Actor, MapStore, Retention
from support.fleet.made_fleet import NS, Known, MadeRobot, drive
from support.storage.map_samples import draft_details, random_tile, save_sample_draft

DAY_MS = 57_600_000
SETTINGS = CanarySettings()


def tally(failures: int, days: float) -> Tally:
    return Tally(failures=failures, driving_ms=round(days * DAY_MS))


def test_robots_are_chosen_as_if_by_lot_and_always_the_same() -> None:
    robots = [f"robot-{n}" for n in range(20_000)]
    numbers = np.array([number_of("lab", 3, robot) for robot in robots])
    assert stats.kstest(numbers, "uniform").pvalue > 0.01
    other = np.array([number_of("lab", 4, robot) for robot in robots])
    assert abs(np.corrcoef(numbers, other)[0, 1]) < 0.03
    assert abs(np.mean(numbers < threshold_for(0.05, "lab", 3, robots)) - 0.05) < 0.005
    for version in range(20):  # of a small fleet at least one takes part
        few = robots[:6]
        threshold = threshold_for(0.05, "lab", version, few)
        assert sum(number_of("lab", version, robot) < threshold for robot in few) >= 1
    assert threshold_for(0.05, "lab", 3, []) == 0.05


def test_the_posterior_is_the_integral_of_its_definition() -> None:
    ours, theirs = rate(2, 3.0), rate(9, 60.0)

    def inside(other_rate: float) -> float:
        limit = 1.5 * other_rate + 0.5
        return float(stats.gamma.cdf(limit, 2.5, scale=1 / 3.0) * stats.gamma.pdf(other_rate, 9.5, scale=1 / 60.0))

    assert within_margin(ours, theirs, 1.5, 0.5) == pytest.approx(integrate.quad(inside, 0, 2)[0], abs=2e-3)


def test_a_harmless_version_is_rarely_taken_back_however_often_it_is_looked_at() -> None:
    """At the very edge of the margin: the e-value exceeds 1/alpha in at most a share alpha of the runs."""
    rng = np.random.default_rng(4)
    alarms = 0
    runs, looks = 250, 60
    for _ in range(runs):
        ours, theirs = np.cumsum(rng.poisson(0.1 * 1.5 * 0.6, looks)), np.cumsum(rng.poisson(2.0 * 0.6, looks))
        evidence = [
            evidence_of_harm(rate(int(a), 0.1 * n), rate(int(b), 2.0 * n), 1.5)
            for n, (a, b) in enumerate(zip(ours, theirs, strict=True), start=1)
        ]
        alarms += max(evidence) >= 1 / SETTINGS.alpha
    assert alarms / runs <= SETTINGS.alpha * 1.5


@pytest.mark.parametrize(
    ("canary", "others", "days", "action"),
    [
        (tally(0, 0.0), tally(0, 0.0), 0.1, "wait"),
        (tally(1, 0.05), tally(0, 1.0), 0.1, "wait"),  # one failure proves nothing
        (tally(8, 0.5), tally(3, 10.0), 0.3, "roll_back"),
        (tally(0, 2.0), tally(2, 40.0), 1.0, "wait"),
        (tally(0, 4.5), tally(2, 90.0), 1.0, "promote"),
        (tally(3, 4.5), tally(60, 90.0), 1.0, "wait"),
        (tally(4, 15.0), tally(60, 300.0), 1.0, "promote"),
        (tally(3, 2.0), tally(30, 40.0), 7.5, "roll_back"),  # not proven in time
    ],
)
def test_decisions(canary: Tally, others: Tally, days: float, action: str) -> None:
    finding = judge_canary(canary, others, days, SETTINGS)
    assert finding.action == action, finding.reason
    assert "robot-day" in finding.reason


def test_everything_that_speaks_against_a_map_counts() -> None:
    for name in ("failures", "suspected", "docks_wrong", "blind_seen"):
        bad = Tally(driving_ms=DAY_MS, **{name: 9})
        assert judge_canary(bad, tally(3, 20.0), 0.3, SETTINGS).action == "roll_back", name


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
        for now_ns, robot, message in drive(self.robots, seconds, self.clock["ns"]):
            self.clock["ns"] = now_ns
            robot.rate_factor = factor_on.get(robot.version, 1.0)
            if isinstance(message, RobotHealth):
                self.fleet.take_health("lab", robot.name, message)
            elif isinstance(message, PoseMessage):
                self.fleet.take_pose("lab", robot.name, message)
            else:
                assert isinstance(message, FailureReport)
                self.fleet.take_failure("lab", robot.name, message)
        self.fleet.flush()


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    """Site lab with version 1, a draft 2, and 40 robots that are known."""
    clock = {"ns": 1_767_000_000 * NS}
    with (
        MapStore.open(tmp_path / "store", create=True, clock_ns=lambda: clock["ns"]) as store,
        MemoryBus(MemoryHub()) as bus,
    ):
        save_sample_draft(store)
        store.publish("lab")
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
    canary = world.store.start_canary("lab", 2, 0.1, actor=Actor("ada", "the nightly map"))
    members = {robot.name for robot in world.robots if number_of("lab", 2, robot.name) < canary.threshold}
    assert 1 <= len(members) <= 10
    world.service.announce_changes()
    assert {status.robot for status in world.fleet.robots("lab") if status.is_canary} == members
    for _ in range(60):
        world.run(30, {2: 900.0})
        done = review(world.store, SETTINGS, world.clock["ns"])
        world.service.announce_changes()
        if done:
            break
    (finding,) = done
    assert finding.action == "roll_back"
    assert {name for name, versions in world.told.items() if 2 in versions} == members
    assert {robot.version for robot in world.robots} == {1}
    assert world.store.current("lab").version == 1
    assert world.store.version("lab", 2).state == "retired"
    (row,) = world.store.canaries("lab")
    assert (row.state, row.outcome) == ("rolled_back", finding.reason)
    event = world.store.events("lab")[-1]
    assert (event.kind, event.version, event.actor, event.reason) == ("canary_rolled_back", 2, "canary", finding.reason)
    assert world.store.verify().faults == []


def test_a_good_map_is_promoted_for_all(world: World) -> None:
    world.store.start_canary("lab", 2, 0.3)
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
    assert world.store.rollback("lab") == 1


def test_a_robot_fetches_what_it_is_told(world: World, tmp_path: Path) -> None:
    canary = world.store.start_canary("lab", 2, 0.1)
    inside = next(r.name for r in world.robots if number_of("lab", 2, r.name) < canary.threshold)
    outside = next(r.name for r in world.robots if number_of("lab", 2, r.name) >= canary.threshold)
    for name, version in ((inside, 2), (outside, 1)):
        ready = MapClient(world.bus, TileCache(tmp_path / name), "lab", name).ready()
        assert (ready.wanted.version, ready.note) == (version, "")


def test_people_may_end_it_in_both_ways(world: World) -> None:
    world.store.start_canary("lab", 2, 0.1)
    assert world.store.rollback("lab", actor=Actor("ada", "complaints")) == 1
    assert world.store.version("lab", 2).state == "retired"
    assert "complaints" in world.store.canaries("lab")[0].outcome
    world.store.start_canary("lab", 2, 0.1)  # a second try
    world.store.promote("lab", 2, actor=Actor("ada", "the others agree"))
    assert [row.state for row in world.store.canaries("lab")] == ["promoted", "rolled_back"]
    assert world.store.canaries("lab", running=True) == []
    world.store.start_canary("lab", 1, 0.1)
    save_sample_draft(world.store, seed=8)
    world.store.publish("lab")
    assert world.store.canaries("lab")[0].state == "stopped"
    assert world.store.current("lab").version == 3


def test_what_cannot_be_tried_is_refused(world: World) -> None:
    store = world.store
    with pytest.raises(StateError, match="version 1 as its current one"):
        store.start_canary("lab", 1, 0.1)
    with pytest.raises(UsageError, match="no version 9"):
        store.start_canary("lab", 9, 0.1)
    with pytest.raises(UsageError, match="between 0 and 1"):
        store.start_canary("lab", 2, 5.0)
    canary = store.start_canary("lab", 2, 0.1)
    with pytest.raises(StateError, match="tries version 2 already"):
        store.start_canary("lab", 2, 0.1)
    store.rollback("lab")
    for promote in (True, False):  # somebody was faster
        with pytest.raises(StateError, match="not tried any more"):
            store.end_canary(canary, promote=promote, outcome="late")
    assert store.current("lab").version == 1
    save_sample_draft(store, site="empty")
    with pytest.raises(StateError, match="no current version"):
        store.start_canary("empty", 1, 0.1)
    few = [random_tile(np.random.default_rng(1), landmarks=2, places=1)]
    store.save_draft("lab", tiles=few, vocabulary=b"words" * 50, details=draft_details(path_m=1.0))
    with pytest.raises(GateRefusedError):
        store.start_canary("lab", 3, 0.1)


def test_garbage_collection_leaves_what_is_tried(world: World) -> None:
    world.store.start_canary("lab", 2, 0.1)
    world.clock["ns"] += 100 * 86_400 * NS
    world.store.collect_garbage(Retention(keep_versions=0, keep_drafts=0, keep_days=0.0, robot_days=1.0))
    assert [info.state for info in world.store.versions("lab")] == ["current", "published"]
