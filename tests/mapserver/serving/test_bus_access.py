"""Admission to the bus: the policy of endpoints, names that are not enrolled (row 9), and rules that follow the register."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fleetmap.access import Access, Holder
from fleetmap.bus import MemoryBus, MemoryHub
from fleetmap.errors import LinkError, StateError, UnreachableError, UsageError
from fleetmap.messages import RobotHealth, encode_message, robot_key
from fleetmap.trust import enrolment
from mapserver import releases
from mapserver.fleet import fleet as fleet_module
from mapserver.fleet.fleet import Fleet
from mapserver.serving.bus_access import BusGuard, check_binding, prepare_bus
from mapserver.serving.bus_service import BusService
from mapserver.store import MapStore
from mapserver.trust import init_here
from mapserver.trust.enrolment import RobotRegister
from support.storage.map_samples import save_sample_draft


@pytest.mark.parametrize(
    ("endpoint", "insecure", "is_allowed"),
    [
        ("tcp/127.0.0.1:7447", False, True),
        ("tcp/[::1]:7447", False, True),
        ("tcp/localhost:7447", False, True),
        ("tcp/0.0.0.0:7447", False, False),
        ("tcp/[::]:7447", False, False),
        ("udp/10.0.0.1:7447", False, False),
        ("tcp/maps.example:7447", False, False),
        ("tcp/0.0.0.0:7447", True, True),
        ("tls/0.0.0.0:7447", False, True),
        ("quic/0.0.0.0:7447", False, True),
    ],
)
def test_which_endpoints_are_allowed(endpoint: str, insecure: bool, is_allowed: bool) -> None:
    if is_allowed:
        check_binding(endpoint, insecure=insecure)
        return
    with pytest.raises(UsageError, match=r"trust init --here .* --zenoh tls/.*--insecure"):
        check_binding(endpoint, insecure=insecure)


@pytest.fixture
def register(tmp_path: Path) -> Iterator[RobotRegister]:
    with MapStore.open(tmp_path / "store", create=True) as store:
        save_sample_draft(store)
        releases.publish(store, "lab")
        init_here(store)
        RobotRegister(store).authorities.init(["127.0.0.1"], None, None)
        yield RobotRegister(store)


def test_tls_needs_certificates_and_loopback_nothing(tmp_path: Path, register: RobotRegister) -> None:
    store = register._store
    bus, guard = prepare_bus(store, "tcp/127.0.0.1:0", insecure=False)
    assert (bus.access, guard) == (None, None)
    bus, guard = prepare_bus(store, "tls/0.0.0.0:0", insecure=False)
    assert guard is not None
    assert bus.access == register.access()
    with MapStore.open(tmp_path / "other", create=True) as other, pytest.raises(StateError, match="trust init"):
        prepare_bus(other, "tls/0.0.0.0:0", insecure=False)


def health(robot: str) -> bytes:
    return encode_message(RobotHealth(site="lab", robot=robot, stamp_ns=1, version=1, status="TRACKING"))


@pytest.mark.parametrize("is_guarded", [True, False])
def test_row_9_invented_robots(register: RobotRegister, monkeypatch: pytest.MonkeyPatch, is_guarded: bool) -> None:
    """The program refuses them too, where the bus let them through."""
    monkeypatch.setattr(fleet_module, "MAX_ROBOTS", 200)
    store, hub = register._store, MemoryHub()
    register.enrol("lab", ["r1"], "tls/127.0.0.1:7447")
    with MemoryBus(hub) as bus, MemoryBus(hub) as anybody:
        fleet = Fleet(store)
        guard = BusGuard(register, bus) if is_guarded else None
        service = BusService(store, fleet, bus, lambda *_: None, guard)
        for number in range(201):
            name = f"invented-{number}"
            if is_guarded:
                with pytest.raises(LinkError, match="not enrolled"):
                    anybody.get(robot_key("lab", name, "wanted"))
            anybody.publish(robot_key("lab", name, "health"), health(name))
        anybody.publish(robot_key("lab", "r1", "health"), health("r1"))
        names = {status.robot for status in fleet.robots("lab")}
        assert names == {"r1"} if is_guarded else ("r1" not in names and len(names) == 200), "the control"
        service.close()


def test_rules_follow_the_register(register: RobotRegister, caplog: pytest.LogCaptureFixture) -> None:
    hub = MemoryHub()
    with MemoryBus(hub) as bus:
        register.enrol("lab", ["r1"], "tls/127.0.0.1:7447")
        guard = BusGuard(register, bus)
        bus.reopen(guard.access)
        service = BusService(register._store, Fleet(register._store), bus, lambda *_: None, guard)
        assert not guard.follow()
        bundle = enrolment.decode_bundle(register.enrol("lab", ["r2"], "tls/127.0.0.1:7447")["r2"])
        register.revoke("lab", ["r1"])
        assert guard.follow()
        assert not guard.follow()
        (entry,) = register.robots()
        with MemoryBus(hub, entry.bundle) as fresh:
            key = enrolment.new_key()
            question = enrolment.renewal_request(bundle.own.encode(), key)
            assert fresh.get(robot_key("lab", "r2", "renew"), question)
            with pytest.raises(UnreachableError):
                fresh.get(robot_key("lab", "r2", "wanted"))
            for _ in range(4):
                fresh.get(robot_key("lab", "r2", "renew"), question)
            with pytest.raises(LinkError, match="too often"):
                fresh.get(robot_key("lab", "r2", "renew"), question)
        assert not guard.follow(), "a renewal opens nothing anew"
        with MemoryBus(hub, entry.certificate) as robot, MemoryBus(hub, "old.00000000"):
            assert robot.get(robot_key("lab", "r2", "wanted"))
            assert [words for words in guard.look() if "not enrolled" in words]
            guard.look()
            with MemoryBus(hub, entry.certificate):
                assert [words for words in guard.look() if "connected 2 times" in words]
        assert caplog.text.count("'old.00000000'") == 1
        register.authorities.rotate_server(None, None)
        assert guard.follow()
        service.close()


def test_a_guard_without_robots(register: RobotRegister) -> None:
    access = register.access()
    assert access.robot_count == 0
    assert access != Access([Holder("r.1", "lab", "r")])
