"""A running robot and its server: versions that cannot be used, a network that is away, reports that must arrive once."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest

from fleetmap.errors import LinkError, StoreError
from fleetmap.failure_summary import ReplayPart
from fleetmap.mapformat.names import blob_path
from fleetmap.messages import (
    PART_BYTES,
    FailureAck,
    FailureReport,
    InitialPoseMessage,
    RobotHealth,
    WantedVersion,
    decode_message,
    encode_message,
    part_of,
    robot_key,
)
from fleetmap.sensors.samples import PositionPrior
from locclient.daemon.server_sync import ServerSync
from locclient.delivery.outbox import Outbox, QueuedReport
from locclient.robot.version_trial import Change, VersionChange
from mapserver import releases
from support.fleet import served_world
from support.fleet.memory_bus import MemoryBus
from support.fleet.reports import blindness
from support.storage.map_samples import publish_samples, save_sample_draft


@dataclass
class World(served_world.World):
    """A server, the robot's synchronization with it, and the table of failures that the server keeps."""

    table: list[str] = field(default_factory=list)
    lose_answers: bool = False
    refuse: str = ""
    takes_parts: bool = False
    parts: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.client, self.clock = self.link, {"s": 1000.0}
        self.outbox = Outbox(self.folder.parent / "outbox", max_bytes=10**6)
        self.sync = ServerSync(self.client, self.outbox, retry_s=600.0, clock_s=lambda: self.clock["s"])
        # Before the service's own table: what arrives is looked at here.
        for name, take in (("failures", self.take_failure), ("replays", self.take_part)):
            self.hub.queryables.insert(0, (robot_key("*", "*", name), take, None))

    def take_failure(self, key: str, payload: bytes) -> bytes:
        report = decode_message(payload, FailureReport)
        assert key == robot_key("lab", "r1", "failures")
        if self.refuse:
            raise LinkError(self.refuse)
        if report.id not in self.table:
            self.table.append(report.id)
        if self.lose_answers:
            self.hub.reachable = False
            return encode_message(FailureAck(id="lost on its way"))
        return encode_message(FailureAck(id=report.id))

    def take_part(self, _key: str, payload: bytes) -> bytes:
        part = decode_message(payload, ReplayPart)
        if not self.takes_parts:
            return encode_message(FailureAck(id=part.id))
        self.parts.append(part.offset)
        return encode_message(FailureAck(id=part.id, received_bytes=part.offset + len(part.data)))

    def step(self, seconds: float = 0.1) -> None:
        self.clock["s"] += seconds
        self.sync.step()

    def ack(self) -> dict[str, object]:
        return self.fleet.robots("lab")[0].last_ack or {}

    def publish_sample(self, seed: int) -> int:
        number = save_sample_draft(self.store, seed=seed)
        releases.publish(self.store, "lab")
        return number


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    with served_world.served_world(tmp_path) as served:
        made = World(**vars(served))
        yield made
        made.sync.close()


def report(name: str) -> QueuedReport:
    return QueuedReport(name, encode_message(blindness(name)))


def adopt(world: World) -> WantedVersion:
    """What the main thread does with a fetched version."""
    world.step()
    wanted = world.sync.fetched.popleft()
    world.sync.changes.append(VersionChange(wanted, Change.ADOPTED))
    world.step()
    return wanted


def test_a_version_is_active_only_once_it_was_adopted(world: World) -> None:
    world.step()
    assert [wanted.version for wanted in world.sync.fetched] == [1]
    assert world.client.active() is None
    assert adopt(world).version == 1
    assert world.client.active() == world.client.wanted()
    assert world.ack()["version"] == 1
    world.publish_sample(seed=1)
    world.step(61.0)
    assert [wanted.version for wanted in world.sync.fetched] == [2]
    assert world.client.active().version == 1
    wanted = world.sync.fetched.popleft()
    world.sync.changes.append(VersionChange(wanted, Change.REFUSED, "it puts the robot 2 m away"))
    world.step()
    assert world.client.active().version == 1
    assert (world.ack()["version"], world.ack()["refused"]) == (1, "version 2: it puts the robot 2 m away")
    world.step(61.0)
    assert not world.sync.fetched, "refused is refused"


def test_what_was_put_off_is_offered_again_later(world: World, caplog: pytest.LogCaptureFixture) -> None:
    adopt(world)
    world.publish_sample(seed=1)
    world.step(61.0)
    world.sync.changes.append(VersionChange(world.sync.fetched.popleft(), Change.POSTPONED, "dark"))
    world.step(61.0)
    assert caplog.messages == ["version 2 is postponed: dark"]
    assert not world.sync.fetched
    world.step(600.0)
    assert [wanted.version for wanted in world.sync.fetched] == [2]


@pytest.mark.parametrize("damage", ["flipped", "truncated", "missing", "hostile"])
def test_a_version_with_a_bad_tile_is_refused_and_the_good_one_goes_on(world: World, damage: str) -> None:
    adopt(world)
    number = world.publish_sample(seed=1)
    victim = world.folder / blob_path(world.store.manifest("lab", number).tiles[0].sha256)
    data = bytearray(victim.read_bytes())
    victim.chmod(0o644)
    if damage == "missing":
        victim.unlink()
    else:
        data[len(data) // 2] ^= 0x40
        content = {"flipped": bytes(data), "truncated": bytes(data[:-9]), "hostile": b"\xff" * len(data)}
        victim.write_bytes(content[damage])
    world.step(61.0)
    assert not world.sync.fetched
    assert world.client.active().version == 1
    assert world.ack()["version"] == 1
    assert re.fullmatch(rf"version {number}: .{{10,}}", world.ack()["refused"])


def test_a_manifest_of_another_site_is_refused(world: World) -> None:
    adopt(world)
    publish_samples(world.store, 1, first=3, site="elsewhere")
    foreign = world.store.current("elsewhere")
    told = WantedVersion(site="lab", version=7, manifest_sha256=foreign.manifest_sha256)
    manifest = world.store.blob(foreign.manifest_sha256)
    # In front of the real server's answers: a server that lies, or whose store was mixed up.
    answers = ("wanted", lambda *_: encode_message(told)), ("manifests/7", lambda _, asked: part_of(manifest, asked))
    world.hub.queryables[:0] = [(robot_key("lab", "r1", what), answer, None) for what, answer in answers]
    world.step(61.0)
    assert not world.sync.fetched
    assert world.client.active().version == 1
    assert "manifest is of elsewhere" in str(world.ack()["refused"])


def test_ten_minutes_without_a_network_cost_no_report_and_double_none(world: World) -> None:
    """Every report is in the server's table once, in order, though answers were lost and the robot was started again."""
    adopt(world)
    world.outbox.put(report("before"))
    world.step()
    world.hub.reachable = False
    for minute in range(10):
        world.outbox.put(report(f"away {minute}"))
        for _ in range(60):
            world.step(1.0)
    assert world.table == ["before"]
    assert world.outbox.counts()["waiting"] == 10
    # The program dies, and begins anew with what its disk holds.
    world.sync.close()
    world.sync = ServerSync(world.client, world.outbox, retry_s=600.0, clock_s=lambda: world.clock["s"])
    world.hub.reachable, world.lose_answers = True, True
    world.step()
    world.hub.reachable, world.lose_answers = True, False
    world.outbox.put(report("after"))
    for _ in range(40):
        world.step(1.0)
    assert world.table == ["before", *(f"away {minute}" for minute in range(10)), "after"]
    assert world.outbox.counts() == {"waiting": 0, "delivered": 12, "dropped": 0, "refused": 0}


def test_a_server_that_is_not_there_is_named_once_an_outage(world: World, caplog: pytest.LogCaptureFixture) -> None:
    """Without `--verbose`: a wrong [run] server left an empty log, and a warning that pointed to it."""
    world.hub.reachable = False
    for _ in range(300):
        world.step(1.0)
    world.hub.reachable = True
    world.step()
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == [
        "no connection to the map server for 10 s: is it running, and is tls/0.0.0.0:7447 its zenoh endpoint? no map until then",
        "connected to the map server again",
    ]
    adopt(world)
    world.hub.reachable = False
    world.step(1.0)
    assert len(caplog.records) == 2, "a short gap is no news"


@pytest.mark.parametrize(
    "payload",
    [b"", b"\x00" * 40, report("damaged").payload[:-3], report("of another failure").payload],
    ids=["empty", "zeros", "truncated", "another"],
)
def test_a_report_that_the_disk_has_damaged_is_dropped_and_counted(world: World, payload: bytes) -> None:
    """It is told neither once nor for ever, and those before and behind it arrive."""
    world.outbox.put(report("before"))
    world.outbox.put(QueuedReport("damaged", payload))
    world.outbox.put(report("behind"))
    world.step()
    assert world.table == ["before", "behind"]
    assert world.outbox.counts() == {"waiting": 0, "delivered": 2, "dropped": 0, "refused": 1}


def test_health_is_the_last_one_only(world: World) -> None:
    told = RobotHealth(site="lab", robot="r1", stamp_ns=1, version=1, status="TRACKING", wall_ns=5)
    world.sync.health += [msgspec.structs.replace(told, stamp_ns=stamp_ns) for stamp_ns in (1, 2, 3)]
    world.step()
    assert world.fleet.robots("lab")[0].last_health["stamp_ns"] == 3
    assert not world.sync.health


def test_tiles_that_a_robot_cannot_read_are_fetched_again(world: World) -> None:
    wanted = adopt(world)
    world.sync.refetch.append(wanted)
    world.step()
    assert list(world.sync.fetched) == [wanted]


@pytest.mark.parametrize(
    ("changes", "is_taken"),
    [
        ({}, True),
        ({"heading_rad": 1.0}, True),
        ({"robot": "r2"}, False),
        ({"site": "yard"}, False),
        ({"x_map_m": float("nan")}, False),
        ({"sigma_m": 0.0}, False),
    ],
)
def test_a_persons_word_is_a_prior_that_fixes_may_outweigh(
    world: World, changes: dict[str, object], is_taken: bool
) -> None:
    told = msgspec.structs.replace(InitialPoseMessage(site="lab", robot="r1", x_map_m=3.0, y_map_m=-2.0), **changes)
    priors: list[PositionPrior] = []
    sync = ServerSync(world.client, world.outbox, retry_s=600.0, put_prior=priors.append)
    with MemoryBus(world.hub) as server:
        server.publish(robot_key("lab", "r1", "initial_pose"), encode_message(told))
    sync.close()
    assert len(priors) == is_taken
    for prior in priors:
        assert prior.is_revisable
        assert prior.floor == "", "the server knows the robot's own site alone"
        assert prior.map_from_base[:3, 3].tolist() == [3.0, -2.0, 0.0]
        assert np.sqrt(np.diag(prior.cov_rot_trans))[3:5].tolist() == [0.5, 0.5]
        heading_rad = changes.get("heading_rad")
        assert np.isfinite(prior.cov_rot_trans[2, 2]) == (heading_rad is not None)
        assert prior.map_from_base[1, 0] == pytest.approx(np.sin(heading_rad or 0.0))


def test_a_recording_travels_a_part_a_second_and_behind_all_reports(world: World, tmp_path: Path) -> None:
    replays = world.sync.replays = Outbox(tmp_path / "replays", max_bytes=10**7)
    replays.put(QueuedReport("f1", bytes(5 * PART_BYTES // 2)))
    adopt(world)
    assert not world.parts, "a server that takes none is asked again half a minute later"
    world.takes_parts = True
    world.step(31.0)
    assert world.parts == [0]
    for _ in range(5):
        world.step(0.1)
    assert world.parts == [0], "the radio is for maps and reports"
    world.outbox.put(report("f2"))
    world.refuse = "later"
    world.step(1.0)
    assert world.parts == [0], "a report waits"
    world.refuse = ""
    for _ in range(40):
        world.step(1.0)
    assert world.parts == [0, PART_BYTES, 2 * PART_BYTES]
    assert world.table == ["f2"]
    assert replays.counts()["delivered"] == 1


def test_a_spool_that_refuses_holds_up_neither_maps_nor_health(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = Mock(side_effect=StoreError("attempt to write a readonly database"))
    monkeypatch.setattr(world.outbox, "waiting", waiting)
    world.sync.replays = world.outbox
    number = world.publish_sample(seed=8)
    for _ in range(5):
        world.step()
    assert [version.version for version in world.sync.fetched] == [number]
    assert waiting.call_count == 2, "reports and recordings are tried again after half a minute"
    world.step(31.0)
    assert waiting.call_count == 4


def test_after_a_restoration_delivered_reports_are_sent_again_once(world: World) -> None:
    world.outbox.put(report("f1"))
    world.step(61.0)
    assert world.outbox.counts()["delivered"] == 1
    world.table.clear()  # what the server has lost
    for restored_ns, again in ((5, ["f1"]), (5, []), (3, ["f1"]), (0, [])):
        world.client.restored_ns = restored_ns
        world.sync._send_again()
        world.step(0.1)
        assert world.table == again
        world.table.clear()
