"""Nothing that robots send grows without bound: failures in rate, size and number, pictures in bytes, traces, robots. Rows 8, 9, 23."""

from pathlib import Path
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest

from fleetmap.errors import LinkError, UsageError
from fleetmap.messages import FailureReport, PoseMessage, RobotHealth, Thumbnail, decode_message, encode_message
from mapserver.fleet import fleet as fleet_module
from mapserver.fleet.fleet import MAX_FAILURE_BYTES, Fleet
from mapserver.fleet.ingest import IngestSettings
from mapserver.fleet.rate_limit import RateLimit
from mapserver.serving.bus_service import BusService
from mapserver.store import Actor, FailureFilter, FleetRetention, MapStore
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.fleet.reports import blindness
from support.storage.clock import Clock
from support.storage.map_samples import publish_samples

SECOND_NS = 10**9


@pytest.fixture
def store(store: MapStore) -> MapStore:
    publish_samples(store, 1)
    return store


@pytest.fixture
def fleet(store: MapStore, clock: Clock) -> Fleet:
    return Fleet(store, clock_ns=clock)


def failure(clock: Clock, number: int, robot: str = "r1", jpeg: bytes = b"") -> FailureReport:
    pictures = (Thumbnail(stamp_ns=1, kind="frame", jpeg=jpeg),) if jpeg else ()
    return blindness(f"f{number}", robot, wall_ns=clock.now_ns, thumbnails=pictures)


def health(robot: str, stamp_ns: int = 1, status: str = "LOST") -> RobotHealth:
    return RobotHealth(site="lab", robot=robot, stamp_ns=stamp_ns, version=1, status=status)


def send(fleet: Fleet, clock: Clock, number: int, robot: str = "r1", jpeg: bytes = b"") -> bool:
    """Whether it was taken; False for later."""
    try:
        ack = fleet.take_failure_bytes("lab", robot, encode_message(failure(clock, number, robot, jpeg)))
    except LinkError as error:
        assert str(error).startswith("later")
        return False
    assert ack.refused == ""
    return True


def test_failures_of_a_robot_come_at_a_rate(fleet: Fleet, store: MapStore, clock: Clock, monkeypatch) -> None:
    assert [send(fleet, clock, number) for number in range(100)] == [True] * 60 + [False] * 40
    assert send(fleet, clock, 0, "r2"), "another robot is not in its way"
    clock.now_ns += 180 * SECOND_NS
    assert [send(fleet, clock, number) for number in range(60, 65)] == [True] * 3 + [False] * 2
    assert len(store.fleet.failures(FailureFilter(robot="r1"))) == 63
    assert not (store.folder / "refused").exists(), "later is no refusal"
    monkeypatch.setattr(fleet_module, "FAILURE_BURST", 1e9)
    assert all(send(Fleet(store, clock_ns=clock), clock, number, "r3") for number in range(100)), "the control"


def test_rates_forget_nobody_who_floods(clock: Clock) -> None:
    limit = RateLimit(2, 1.0, clock)
    assert [limit.admits("a") for _ in range(3)] == [True, True, False]
    for number in range(19_999):
        limit.admits(number)
    assert not limit.admits("one more")
    assert not limit.admits("a")
    clock.now_ns += 3 * SECOND_NS
    assert limit.admits("one more")
    assert [limit.admits("a") for _ in range(3)] == [True, True, False]
    clock.now_ns -= 100 * SECOND_NS  # a clock that is set back gives nothing
    assert not limit.admits("a")


def test_a_full_table_of_rates_is_not_searched_at_every_message(clock: Clock, monkeypatch) -> None:
    """Invented names would else cost milliseconds each, and everybody waits for them."""
    limit = RateLimit(2, 1.0, clock)
    monkeypatch.setattr(limit, "_forget", search := Mock(side_effect=limit._forget))
    for number in range(20_000):
        limit.admits(number)
    for number in range(1000):
        assert not limit.admits(f"invented {number}")
    search.assert_called_once()
    clock.now_ns += 3 * SECOND_NS
    assert limit.admits("invented 1")


def test_names_that_went_leave_nothing_behind(store: MapStore, fleet: Fleet, clock: Clock) -> None:
    with MemoryBus(MemoryHub()) as bus:
        service = BusService(store, fleet, bus, lambda *_: None)
        for number in range(50):
            fleet.take_pose("lab", f"x{number}", PoseMessage.of(1, np.eye(4), np.eye(6), "LOST", 1))
        service.announce_changes()
        clock.now_ns += 3600 * SECOND_NS
        fleet.take_presence([])
        service.announce_changes()
        assert list(fleet.wanted_versions("lab")) == []
        assert len(service._announced) == 0
        service.close()


def test_a_long_key_is_kept_nowhere(store: MapStore, fleet: Fleet, caplog) -> None:
    """Of 64 kB in the place of a site: no rate is kept for it, and the log shows its beginning."""
    with MemoryBus(MemoryHub()) as bus:
        service = BusService(store, fleet, bus, lambda *_: None)
        bus.publish(f"fleetmap/{'x' * 60_000}/robots/r1/health", b"nonsense")
        with pytest.raises(LinkError):
            service._failure(f"fleetmap/lab/robots/{'x' * 60_000}/failures", b"nonsense")
        assert not any(rate._buckets for rate in (*service._rates.values(), fleet._failures))
        assert "refused" in caplog.text
        assert len(caplog.text) < 2000
        service.close()


def test_a_failure_has_a_size(store: MapStore, fleet: Fleet, clock: Clock, monkeypatch) -> None:
    large = msgspec.msgpack.encode({**msgspec.to_builtins(failure(clock, 1)), "more": "x" * MAX_FAILURE_BYTES})
    assert "the limit is" in fleet.take_failure_bytes("lab", "r1", large).refused
    (kept,) = (store.folder / "refused").glob("*.msgpack")
    assert len(large) > kept.stat().st_size == MAX_FAILURE_BYTES, "of what is too large its beginning is set aside"
    monkeypatch.setattr(fleet_module, "MAX_FAILURE_BYTES", 1 << 30)
    assert fleet.take_failure_bytes("lab", "r1", large).refused == "", "the control"


def test_text_that_a_database_cannot_hold_is_refused(fleet: Fleet, clock: Clock) -> None:
    """One robot's report would keep those of all others from the database."""
    nul = msgspec.structs.replace(failure(clock, 1), cause="dark\0")
    assert "matching regex" in fleet.take_failure_bytes("lab", "r1", encode_message(nul)).refused
    for text in (health("r1", 1, "TRACKING\0"), msgspec.structs.replace(health("r1"), metrics={"a": "b\0"})):
        with pytest.raises(LinkError, match="matching regex"):
            decode_message(encode_message(text), RobotHealth)


@pytest.mark.parametrize("jpeg", [b"<html><script>alert(1)</script>", b"<svg/>", b"\x89PNG", b"\xff\xd8 cut"])
def test_pictures_that_are_none_are_refused(fleet: Fleet, store: MapStore, clock: Clock, jpeg: bytes) -> None:
    ack = fleet.take_failure_bytes("lab", "r1", encode_message(failure(clock, 1, jpeg=jpeg)))
    assert "is not a JPEG" in ack.refused
    assert store.fleet.failures(FailureFilter()) == []
    store.fleet.add_failure(failure(clock, 1, jpeg=jpeg), (1, 1), {})
    assert store.fleet.picture(1, 0) == jpeg, "the control: the store itself gives back what it was given"


def test_pictures_have_a_bound_at_once(store: MapStore, clock: Clock) -> None:
    def kept_bytes() -> int:
        return store._database.query("SELECT sum(length(jpeg)) size FROM failure_pictures")[0]["size"]

    picture = b"\xff\xd8" + bytes(10_000) + b"\xff\xd9"
    fleet = Fleet(store, clock_ns=clock, settings=IngestSettings(picture_bytes=100_000))
    for number in range(50):
        assert send(fleet, clock, number, jpeg=picture)
        assert kept_bytes() <= 100_000
        assert store.fleet.picture(number + 1, 0) == picture, "the oldest go"
    assert len(store.fleet.failures(FailureFilter())) == 50
    other = Fleet(store, clock_ns=clock)
    assert all(send(other, clock, number, "r2", picture) for number in range(50))
    assert kept_bytes() > 500_000, "the control"
    again = Fleet(store, clock_ns=clock, settings=IngestSettings(picture_bytes=100_000))
    send(again, clock, 0, "r3", picture)
    assert kept_bytes() <= 100_000


def test_failures_of_a_robot_have_a_number(store: MapStore, clock: Clock, monkeypatch) -> None:
    monkeypatch.setattr(IngestSettings, "retention", lambda _: FleetRetention(failures_per_robot=20))
    fleet = Fleet(store, clock_ns=clock)
    send(fleet, clock, 0, "calm")
    for number in range(50):
        assert send(fleet, clock, number)
    kept = [row.failure_id for row in store.fleet.failures(FailureFilter(robot="r1"))]
    assert kept == [f"f{n}" for n in range(49, 29, -1)]
    assert len(store.fleet.failures(FailureFilter(robot="calm"))) == 1
    assert store.fleet.counters("lab", "robot")["lab", "r1"].failures == 50, "the counts stay"


def test_a_status_that_changes_all_the_time_makes_a_trace_a_second(store: MapStore, fleet: Fleet, clock: Clock) -> None:
    begun_ns = clock.now_ns
    for number in range(400):
        clock.now_ns = begun_ns + number * SECOND_NS // 20
        fleet.take_health("lab", "r1", health("r1", clock.now_ns, ("LOST", "TRACKING")[number % 2]))
    fleet.flush()
    assert 15 <= len(store.fleet.trace("lab", "r1")) <= 22, "in 20 s; 400 without the bound"


def test_a_robot_that_is_removed_is_forgotten(store: MapStore, fleet: Fleet, clock: Clock) -> None:
    for robot in ("r1", "r2"):
        fleet.take_health("lab", robot, health(robot))
    fleet.flush()
    fleet.take_question("lab", "asked")
    fleet.take_presence([])
    assert list(fleet.wanted_versions("lab")) == ["asked", "r1", "r2"]
    assert store.remove_robots("lab", ["r2", "nobody"], actor=Actor("ada", "sold")) == ["r2"]
    fleet.take_presence([])
    assert list(fleet.wanted_versions("lab")) == ["asked", "r1"]
    assert [robot.robot for robot in store.robots("lab")] == ["r1"]
    event = store.events("lab")[-1]
    assert (event.kind, event.detail, event.actor, event.reason) == ("robot removed", "r2", "ada", "sold")
    clock.now_ns += 3600 * SECOND_NS
    fleet.take_presence([("lab", "asked")])
    assert list(fleet.wanted_versions("lab")) == ["asked", "r1"]
    fleet.take_presence([])
    assert list(fleet.wanted_versions("lab")) == ["r1"], "a name that only asked is not kept for ever"
    fleet.take_health("lab", "r2", health("r2", 2))
    assert list(fleet.wanted_versions("lab")) == ["r1", "r2"]
    with pytest.raises(UsageError, match="no site"):
        store.remove_robots("other", ["r1"])


def test_the_database_shrinks_again(tmp_path: Path, clock: Clock) -> None:
    picture = b"\xff\xd8" + bytes(60_000) + b"\xff\xd9"
    root = tmp_path / "store"

    def pages() -> int:
        return (root / "store.sqlite3").stat().st_size // 4096

    with MapStore.open(root, create=True, clock_ns=clock) as store:
        publish_samples(store, 1)
        fleet = Fleet(store, clock_ns=clock, settings=IngestSettings(failure_days=1.0))
        for number in range(50):
            assert send(fleet, clock, number, jpeg=picture)
    full = pages()
    assert full > 700
    clock.now_ns += 2 * 86_400 * SECOND_NS
    with MapStore.open(root, clock_ns=clock) as store:
        store._database.shrink = lambda _: None  # type: ignore[method-assign]  # the control
        Fleet(store, clock_ns=clock, settings=IngestSettings(failure_days=1.0)).prune()
    assert pages() >= full
    with MapStore.open(root, clock_ns=clock) as store:
        Fleet(store, clock_ns=clock).prune()
    assert pages() < full / 4
