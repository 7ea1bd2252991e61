"""The daemon's threads together: what the network does changes nothing of what the robot knows, and nothing is lost."""

import re
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fleetmap.errors import FleetmapError, LinkError, RecordingError, StoreError
from fleetmap.geometry import se3_inverse
from fleetmap.messages import (
    Cause,
    FailureAck,
    FailureReport,
    InitialPoseMessage,
    Status,
    decode_message,
    encode_message,
    robot_key,
)
from fleetmap.sensors.samples import CameraFrame, ImuSamples
from fleetmap.sources.intake import Intake
from fleetmap.sources.sensor_bundle import SensorBundle
from fleetmap.version_grid import OccupancyGrid
from locclient.daemon import runtime
from locclient.daemon.runtime import Runtime, RuntimeParts
from locclient.daemon.server_sync import ServerSync
from locclient.daemon.service_manager import ServiceManager
from locclient.delivery.outbox import Outbox
from locclient.delivery.report_delivery import ReplayQueue
from locclient.localization.estimate import Estimate
from locclient.maps.building_maps import BuildingMaps
from locclient.maps.loaded_map import PositionBound, TileSelectionSettings
from locclient.maps.map_client import MapClient
from locclient.maps.map_source import CachedMap, LocalMapSource
from locclient.maps.tile_cache import TileCache
from locclient.maps.tile_loader import TileLoader
from locclient.robot.continuous_odom import PublishedPose
from locclient.robot.failure_report import RobotProfile
from locclient.robot.robot import Robot
from mapserver.api.metrics import Metrics
from mapserver.dashboard.live import live_robot
from mapserver.dashboard.overview import remarks
from mapserver.fleet.alerts import AlertSettings, active_alerts
from mapserver.fleet.fleet import Fleet
from mapserver.serving.bus_service import BusService, place_robot
from mapserver.store import Actor, FailureFilter, MapStore
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.recordings.recording_samples import calibration
from support.waiting import eventually
from support.worlds import robot_world
from support.worlds.building import house


@dataclass
class ScriptedSource:
    """Puts bundles one after another, each once the one before was taken; does something before some of them."""

    bundles: list[SensorBundle]
    before: dict[int, Callable[[], None]] = field(default_factory=dict)
    ready: Callable[[], bool] = lambda: True
    at_once: int = 1  # frames, of which the last is taken
    calibration = calibration()
    has_depth = False

    def run(self, intake: Intake, wait: Callable[[float], bool]) -> None:
        while not self.ready() and not wait(0.01):
            pass
        for first in range(0, len(self.bundles), self.at_once):
            while not intake.wait_for_room(0.1) and not wait(0.0):
                pass
            self.before.get(first, lambda: None)()
            crowd = self.bundles[first : first + self.at_once]
            for sample in (sample for bundle in crowd for sample in bundle.wheel):
                intake.put_wheel(sample)
            for bundle in crowd:
                intake.put_frame(bundle.frame)
            for bundle in crowd:  # without its samples no frame is taken
                intake.put_imu(bundle.imu)

    def close(self) -> None:
        pass


@dataclass
class Listener:
    """Keeps what the robot tells its own programs."""

    estimates: list[Estimate] = field(default_factory=list)
    grids: list[tuple[int, OccupancyGrid | None, str]] = field(default_factory=list)
    grid_height_m: float | None = None

    def publish(self, estimate: Estimate, published: PublishedPose, base_from_body: np.ndarray) -> None:
        self.estimates.append(estimate)

    def alive(self, is_silent: bool) -> None:
        pass

    def show_grid(self, version: int, grid: OccupancyGrid | None, why: str) -> None:
        self.grids.append((version, grid, why))

    def close(self) -> None:
        pass


@dataclass
class World:
    hub: MemoryHub
    store: MapStore
    fleet: Fleet
    bus: MemoryBus
    folder: Path
    table: list[str] = field(default_factory=list)

    def parts(self, source: ScriptedSource, robot: Robot, listener: Listener) -> RuntimeParts:
        caches = tuple(TileCache(self.folder / "cache") for _ in range(2))
        client = MapClient(self.bus, caches[0], "room", "r1")
        outbox = Outbox(self.folder / "spool", max_bytes=10**7)
        intake = Intake(frames=1, imu_minus_cam_s=0.0, has_imu=True, imu_wait_s=1.0)
        return RuntimeParts(
            profile=RobotProfile("room", "r1", robot_world.rectifier().rig, robot_world.SETTINGS),
            source=source,
            intake=intake,
            robot=robot,
            tile_loader=TileLoader(CachedMap(caches[1], "room"), TileSelectionSettings()),
            outbox=outbox,
            replays=None,
            publisher=listener,
            server=ServerSync(client, outbox, retry_s=600.0, put_prior=intake.put_prior),
            first=client.active(),
            caches=caches,
        )

    def drive(
        self, bundles: list[SensorBundle], before: dict[int, Callable[[], None]] | None = None, *,
        robot: Robot | None = None, at_once: int = 1,
    ) -> list[Estimate]:  # fmt: skip
        """What a robot tells that gets these once it has its map; does something before some of them."""
        robot = robot or robot_world.new_robot()
        source = ScriptedSource(bundles, before or {}, lambda: robot.running is not None, at_once)
        return started(self.parts(source, robot, Listener()))


def started(parts: RuntimeParts) -> list[Estimate]:
    """The robot's estimates until its source ends."""
    Runtime(parts, ServiceManager("")).run()
    return parts.publisher.estimates  # type: ignore[attr-defined]


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    hub = MemoryHub()
    with MapStore.open(tmp_path / "store", create=True) as store, MemoryBus(hub) as bus, MemoryBus(hub) as robot_bus:
        robot_world.save(store)
        fleet = Fleet(store)
        made = World(hub, store, fleet, robot_bus, tmp_path)

        def take(_: str, payload: bytes) -> bytes:
            made.table.append(decode_message(payload, FailureReport).id)
            return encode_message(fleet.take_failure_bytes("room", "r1", payload))

        # Before the service's own table: what arrives is looked at here.
        bus.queryable(robot_key("*", "*", "failures"), take)
        service = BusService(store, fleet, bus, lambda *_: None)
        yield made
        service.close()


def test_a_network_that_goes_away_changes_no_estimate_and_loses_no_report(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    """Without a network from frame 30 to 120, dark from 60 to 100: the estimates are to the bit those of a robot alone."""
    caplog.set_level("INFO")
    bundles = list(robot_world.bundles(130, dark=range(60, 100)))
    folder = LocalMapSource(world.folder / "store", "room")
    alone, robot = robot_world.new_robot(), robot_world.new_robot()
    alone.use(TileLoader(folder, TileSelectionSettings()).load(folder.wanted(), PositionBound()))
    expected = [outcome.estimate for outcome in map(alone.handle, bundles)]
    away, back = (lambda: setattr(world.hub, "reachable", False)), (lambda: setattr(world.hub, "reachable", True))
    delivered_while_away: list[int] = []
    steps = {30: away, 119: lambda: delivered_while_away.append(len(world.table)), 120: back}
    source = ScriptedSource(bundles, steps, ready=lambda: robot.running is not None)
    parts = world.parts(source, robot, Listener())
    estimates = started(parts)
    assert [e.stamp_ns for e in estimates] == [e.stamp_ns for e in expected]
    for got, wanted in zip(estimates, expected, strict=True):
        assert (got.status, got.refused) == (wanted.status, wanted.refused)
        if wanted.map_from_body is not None:
            np.testing.assert_array_equal(got.map_from_body, wanted.map_from_body)
    assert parts.intake.counts.frames_dropped == 0
    assert delivered_while_away == [0]
    waiting = [report.id for report in parts.outbox.waiting(10)]
    world.hub.reachable = True
    ServerSync(parts.server.client, parts.outbox, retry_s=600.0).step()  # the next start delivers what was not yet
    assert len(world.table) == len(set(world.table)) == 1
    assert waiting in ([], world.table)
    assert world.fleet.robots("room")[0].last_ack["version"] == 1
    told = [record.getMessage() for record in caplog.records if record.name.startswith("locclient")]
    assert [line for line in told if line.startswith("version")] == ["version 1 is fetched", "version 1 is adopted"]
    statuses = [status for status, _ in groupby(estimate.status for estimate in estimates)]
    assert [line.split()[1].rstrip(",") for line in told if line.startswith("status")] == statuses
    assert any(re.fullmatch(r"status TRACKING, version 1, position known to 0\.\d\d m \(95 %\)", line) for line in told)
    assert f"the report of failure {world.table[0]} is delivered" in told


def check_tracking(said: Iterable[tuple[int, Estimate]]) -> None:
    for number, one in said:
        off_m = one.map_from_body[:3, 3] - robot_world.truth(number)[:3, 3]
        assert one.status is Status.TRACKING
        assert off_m @ np.linalg.solve(one.cov_rot_trans[3:, 3:], off_m) < 16.27, "0.999 of chi-square"


def test_a_robot_that_is_too_slow_for_its_frames_stays_exact_and_people_see_it(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    """On its page, in the metrics, as an alert, in its log, and as the cause once nothing in the pictures is known any more."""
    caplog.set_level("INFO")
    bundles, rng = list(robot_world.bundles(240)), np.random.default_rng(3)
    for number, bundle in enumerate(bundles[160:], 160):
        noise = rng.integers(0, 255, bundle.frame.left.shape, np.uint8)
        bundles[number] = replace(bundle, frame=CameraFrame(bundle.frame.stamp_ns, noise, noise))
    said = world.drive(bundles, at_once=4)
    check_tracking(zip(range(3, 160, 4), said, strict=False))
    assert Cause.OVERLOADED in {one.cause for one in said[40:]}
    (status,) = world.fleet.robots("room")
    lines = [record.getMessage() for record in caplog.records]
    assert sum(int(n) for line in lines for n in re.findall(r"^lost: (\d+) frames dropped", line)) == 180
    told = "75% of its frames are dropped"
    assert told in " ".join(remarks(live_robot(status)))
    alerts = active_alerts(world.store, world.fleet, AlertSettings(), world.store.now_ns())
    (alert,) = (alert for alert in alerts if alert.name == "FleetmapRobotOverloaded" and told in alert.words)
    assert alert.about == "r1"
    assert 'fleetmap_site_robots_overloaded{site="room"} 1.0' in Metrics(world.store, world.fleet).text().decode()


@pytest.mark.parametrize("is_stopped", [False, True])
def test_the_recording_of_a_failure_at_the_end_has_arrived(
    world: World, monkeypatch: pytest.MonkeyPatch, is_stopped: bool
) -> None:
    robot, bundles = robot_world.new_robot(keeps_replay=True), list(robot_world.bundles(110, dark=range(60, 110)))
    plain = world.parts(ScriptedSource(bundles, ready=lambda: robot.running is not None), robot, Listener())
    spool = plain.server.replays = Outbox(world.folder / "replays", max_bytes=10**8)
    made = Runtime(plain._replace(replays=ReplayQueue(spool, plain.profile)), ServiceManager(""))

    sent = plain.server.client.deliver

    def ctrl_c(name: str, payload: bytes) -> FailureAck:
        if name != "replays":
            return sent(name, payload)
        made.stop()
        raise LinkError("later")

    monkeypatch.setattr(runtime, "_DELIVERED_WITHIN_S", 600.0)  # a loaded machine needs more than the product waits
    if is_stopped:
        monkeypatch.setattr(plain.server.client, "deliver", ctrl_c)
    made.run()
    (failure,) = world.store.fleet.failures(FailureFilter(site="room"))
    assert (world.store.fleet.replay_summary(failure.number) is None) == is_stopped
    assert len(spool.waiting()) == is_stopped


def test_a_new_version_is_taken_while_driving(world: World) -> None:
    """And planners get its grid; of the one before they hear that it has none."""
    robot, listener = robot_world.new_robot(), Listener(grid_height_m=0.3)
    source = ScriptedSource(list(robot_world.bundles(200)), ready=lambda: robot.running is not None)
    parts = world.parts(source, robot, listener)
    parts.server.client.takes_grids = True

    def publish() -> None:
        robot_world.save(world.store, has_grid=True)
        current = robot_world.wanted(world.store)
        with MemoryBus(world.hub) as server:
            server.publish(robot_key("room", "r1", "wanted"), encode_message(current))
        # Taken by the thread that localizes, between frames.
        assert eventually(lambda: len(robot.versions.held) == 2, 20)

    source.before[70] = publish
    estimates = started(parts)
    assert estimates[-1].map_version == 2
    assert [e.cause for e in estimates[60:] if e.status != "TRACKING"] == []
    (first, none, why), (second, grid, _) = listener.grids
    assert (first, none, second) == (1, None, 2)
    assert "version 1 of site room has no grid" in why
    assert ((grid.cells == 100).sum(), (grid.cells == 0).sum()) == (400, 800)
    assert parts.server.client.active().version == 2
    assert world.fleet.robots("room")[0].version == 2


def test_a_robot_that_is_told_its_place_believes_it_until_fixes_outweigh_it(world: World) -> None:
    robot = robot_world.new_robot()
    place = robot_world.truth(60) @ se3_inverse(robot.base_from_body)
    x_m, y_m = place[:2, 3].tolist()
    told = InitialPoseMessage(site="room", robot="r1", x_map_m=x_m + 6.0, y_map_m=y_m, heading_rad=0.0)

    def tell() -> None:
        with MemoryBus(world.hub) as server:
            place_robot(world.store, world.fleet, server, told, Actor("ada", "it was pushed"))

    said = world.drive(list(robot_world.bundles(150)), {60: tell}, robot=robot)
    assert {one.status for one in said[30:60]} == {Status.TRACKING}
    moved = [n for n, one in enumerate(said[60:70], 60) if one.status is Status.DEGRADED]
    assert moved
    assert moved[0] <= 63, "within a few frames"
    off_m = said[moved[0]].map_from_body[:2, 3] - robot_world.truth(moved[0])[:2, 3]
    assert np.linalg.norm(off_m) == pytest.approx(6.0, abs=0.3)
    assert said[-1].status is Status.TRACKING
    (event,) = [event for event in world.store.events("room") if event.kind == "robot placed"]
    assert (event.actor, event.reason) == ("ada", "it was pushed")


def test_a_level_above_the_alert_limit_is_told_as_a_degraded_pose(world: World) -> None:
    bundles = list(robot_world.bundles(100))
    free = world.drive(bundles)
    limit_m = float(np.median([one.protection_m for one in free if one.protection_m < np.inf]))
    robot = robot_world.new_robot()
    source = ScriptedSource(bundles, {}, lambda: robot.running is not None)
    said = started(world.parts(source, robot, Listener())._replace(stop_above_m=limit_m))
    is_stopped = [one.status is Status.TRACKING and not one.protection_m <= limit_m for one in free]
    assert 0 < sum(is_stopped) < sum(one.status is Status.TRACKING for one in free)
    assert [one.protection_m for one in said] == [one.protection_m for one in free]
    wanted = [Status.DEGRADED if is_above else one.status for one, is_above in zip(free, is_stopped, strict=True)]
    assert [one.status for one in said] == wanted


@pytest.mark.parametrize(("at", "ahead_ns"), [(0, 5 * 10**9), (60, 4 * 10**8), (60, 5 * 10**9), (60, 2**62)])
def test_one_wrong_stamp_of_a_camera_and_an_imu_costs_a_frame(world: World, at: int, ahead_ns: int) -> None:
    bundles = list(robot_world.bundles(100))
    wrong, stamps_ns = bundles[at], bundles[at].imu.stamps_ns.copy()
    stamps_ns[-1] = wrong.frame.stamp_ns + ahead_ns
    wrong_frame = replace(wrong.frame, stamp_ns=wrong.frame.stamp_ns + ahead_ns)
    bundles[at] = replace(wrong, frame=wrong_frame, imu=replace(wrong.imu, stamps_ns=stamps_ns))
    said = world.drive(bundles)
    assert [one.stamp_ns for one in said[-99:]] == [b.frame.stamp_ns for b in bundles if b is not bundles[at]]
    assert {one.status for one in said[35:67]} == {said[-1].status} == {Status.TRACKING}
    assert np.linalg.norm((said[-1].map_from_body - robot_world.truth(99))[:3, 3]) < 0.1


@pytest.mark.parametrize("is_imu", [True, False])
def test_a_clock_that_is_set_back_costs_its_sensor_and_people_see_it(world: World, is_imu: bool) -> None:
    """Of wheels or an IMU. That of the cameras, and thus of all, ends the run."""
    bundles = list(robot_world.bundles(110))
    for number, bundle in enumerate(bundles):
        imu_ns, wheels_ns = (10**10 if number >= 60 and is_back else 0 for is_back in (is_imu, not is_imu))
        wheel = robot_world.rolled(number, bundle.frame.stamp_ns - wheels_ns)
        imu = replace(bundle.imu, stamps_ns=bundle.imu.stamps_ns - imu_ns)
        bundles[number] = replace(bundle, imu=imu, wheel=wheel)
    said = world.drive(bundles)
    assert [one.stamp_ns for one in said] == [bundle.frame.stamp_ns for bundle in bundles]
    check_tracking(list(enumerate(said))[35:])
    (status,) = world.fleet.robots("room")
    assert status.last_health["flags"] == ("imu_refused" if is_imu else "wheels_refused",)


def test_an_imu_that_is_late_and_later_falls_silent_costs_no_pose_and_people_see_it(
    world: World, caplog: pytest.LogCaptureFixture
) -> None:
    """In the light. It begins while the robot drives, and counts as odometry that is lost for a moment when it ends."""
    bundles = list(robot_world.bundles(114))
    for number in (*range(20), *range(100, 114)):
        bundles[number] = replace(bundles[number], imu=ImuSamples.empty())
    robot, listener = robot_world.new_robot(), Listener()
    source = ScriptedSource(bundles, {}, lambda: robot.running is not None)
    brief = Intake(frames=1, imu_minus_cam_s=0.0, has_imu=True, imu_wait_s=0.06)
    said = started(world.parts(source, robot, listener)._replace(intake=brief))
    check_tracking([(n, one) for n, one in enumerate(said) if n not in range(101, 104)])
    assert [said[n].odometry.inertial for n in (19, 50, 99)] == [False, True, True]
    assert sum("the IMU is silent" in text for text in caplog.messages) == 2
    (status,) = world.fleet.robots("room")
    assert status.last_health["flags"] == ("imu_silent",)


def test_a_lying_account_on_the_bus_ends_nothing(world: World) -> None:
    """From frame 30 on it answers and speaks in the server's place; at the next start the server hears the failure of then."""
    honest, spoken = list(world.hub.queryables), list[str]()
    wanted = {"site": "room", "version": 1, "manifest_sha256": "0" * 64, "restored_ns": 2**63 + 5}
    placed = {"site": "room", "robot": "r1", "x_map_m": 0.0, "y_map_m": 0.0, "heading_rad": 0.0, "sigma_m": 0.5}

    def lie(key: str, payload: bytes) -> bytes:
        spoken.append(key.rpartition("/")[2])
        told = wanted if key.endswith("wanted") else {"id": "", "received_bytes": 2**63 + 5}
        return encode_message(told)  # type: ignore[arg-type]

    def begin() -> None:
        world.hub.queryables.insert(0, (robot_key("room", "r1", "*"), lie, None))
        with MemoryBus(world.hub) as bus:
            for changed in ({"sigma_m": 1e-300}, {"x_map_m": 1e300}, {"y_map_m": float("nan")}, {"heading_rad": 1e300}):
                bus.publish(robot_key("room", "r1", "initial_pose"), encode_message(placed | changed))  # type: ignore[arg-type]
            bus.publish(robot_key("room", "r1", "wanted"), encode_message(wanted | {"restored_ns": 0}))  # type: ignore[arg-type]

    said = world.drive(list(robot_world.bundles(125, dark=range(55, 95))), {30: begin})
    assert {one.status for one in said[35:54]} == {said[-1].status} == {Status.TRACKING}
    assert {"wanted", "failures"} <= set(spoken)
    assert world.table == []
    world.hub.queryables = honest
    said = world.drive(list(robot_world.bundles(40)))
    assert (len(world.table), said[-1].status) == (1, Status.TRACKING)


def test_what_kills_a_thread_ends_the_daemon(world: World) -> None:
    def die() -> None:
        raise RuntimeError("the driver broke")

    with pytest.raises(FleetmapError, match=r"the thread sensors died \(RuntimeError: the driver broke\)"):
        world.drive(list(robot_world.bundles(3)), {1: die})
    assert not [thread for thread in threading.enumerate() if thread.name in {"sensors", "disk", "network"}]


def test_a_picture_that_cannot_be_read_costs_itself(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    robot, bundles = robot_world.new_robot(), list(robot_world.bundles(6))
    handle = robot.handle

    def sometimes(bundle: SensorBundle) -> object:
        if bundle.frame is bundles[2].frame:
            raise RecordingError("cut off")
        return handle(bundle)

    monkeypatch.setattr(robot, "handle", sometimes)
    parts = world.parts(ScriptedSource(bundles), robot, Listener())
    assert len(started(parts)) == 5
    assert parts.intake.counts.unreadable == 1


def test_faults_of_the_tile_cache_reach_the_server(world: World) -> None:
    record = world.folder / "cache" / "sites" / "room" / "active"
    record.parent.mkdir(parents=True)
    record.write_bytes(b"damaged")
    world.drive(list(robot_world.bundles(3)))
    assert world.fleet.robots("room")[0].last_health["metrics"]["cache_faults"] == 2


def test_a_robot_that_ends_without_frames_says_so(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime, "_SILENT_S", -1.0)
    started(world.parts(ScriptedSource(list(robot_world.bundles(3))), robot_world.new_robot(), Listener()))
    assert Cause.NO_FRAMES.value in world.fleet.robots("room")[0].last_health["flags"]


@pytest.mark.parametrize("error", [StoreError("attempt to write a readonly database"), OverflowError("too large")])
def test_a_spool_that_refuses_costs_no_estimate(
    world: World, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """And no report of health, whatever the error is."""

    def refuse(*_: object) -> object:
        raise error

    parts = world.parts(ScriptedSource(list(robot_world.bundles(5))), robot_world.new_robot(), Listener())
    for name in ("waiting", "put", *["counts"] * isinstance(error, StoreError)):
        monkeypatch.setattr(parts.outbox, name, refuse)
    assert len(started(parts)) == 5
    assert world.fleet.robots("room")[0].last_health is not None


@pytest.mark.parametrize("has_grid", [True, False])
def test_planners_get_the_grid_of_the_floor(tmp_path: Path, has_grid: bool) -> None:
    """At the change; of a floor without one an empty grid, and never that of the floor where the robot was."""
    with house(tmp_path / "store", robot_world.tiles(), robot_world.tiles(), has_grid=has_grid) as store:
        source = LocalMapSource(store.folder, "low")
        floors = BuildingMaps(source, lambda site: LocalMapSource(store.folder, site))
        floors.refresh()
        low, listener = robot_world.wanted(store, "low"), Listener(grid_height_m=0.5)
        parts = SimpleNamespace(
            server=None, publisher=listener, building=floors, tile_loader=TileLoader(source, TileSelectionSettings())
        )
        made = Runtime.__new__(Runtime)
        made._parts, made._server, made._publisher, made._shown_grid = parts, None, listener, None  # type: ignore[assignment]
        for made._site in ("", "high", "high", ""):
            made._show_grid(low)
    shown = [grid for _, grid, _ in listener.grids]
    if has_grid:
        assert [grid.cells.size > 1 for grid in shown if grid is not None] == [True] * 3
    else:
        assert [None if grid is None else grid.cells.tolist() for grid in shown] == [None, [[-1]], None, [[-1]], None]
