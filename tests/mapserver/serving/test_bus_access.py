"""Admission to the bus: the policy of endpoints, names that are not enrolled (row 9), and rules that follow the register."""

import time
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509 import load_pem_x509_certificate

from fleetmap.access import Purpose
from fleetmap.bus.endpoints import TlsFiles
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import LinkError, StateError, UnreachableError, UsageError
from fleetmap.messages import RobotHealth, decode_message, encode_message, robot_key
from fleetmap.trust import enrolment
from mapserver.fleet import fleet as fleet_module
from mapserver.fleet.alerts import AlertSettings, active_alerts
from mapserver.fleet.fleet import Fleet
from mapserver.serving.bus_access import COPIED_AFTER_S, BusGuard, check_binding, prepare_bus
from mapserver.serving.bus_service import BusService
from mapserver.store import MapStore
from mapserver.trust import init_here
from mapserver.trust.authorities import Authorities, Authority
from mapserver.trust.enrolment import Enrolment, RobotRegister
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.storage.clock import Clock
from support.storage.map_samples import publish_samples

DAY_NS = 86_400_000_000_000


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
def register(store: MapStore, clock: Clock) -> RobotRegister:
    clock.now_ns = time.time_ns()
    publish_samples(store, 1)
    init_here(store)
    RobotRegister(store).authorities.init(["127.0.0.1"], None, None)
    return RobotRegister(store)


def test_tls_needs_certificates_and_loopback_nothing(tmp_path: Path, register: RobotRegister, caplog) -> None:
    store = register.store
    bus, guard = prepare_bus(store, "tcp/127.0.0.1:0", insecure=False)
    assert (bus.access, guard) == (None, None)
    bus, guard = prepare_bus(store, "tls/0.0.0.0:0", insecure=False)
    assert guard is not None
    assert bus.access == register.access()
    assert "use tls/" not in caplog.text
    prepare_bus(store, "quic/0.0.0.0:0", insecure=False)
    assert "one packet of a stranger keeps robots from connecting" in caplog.text
    with MapStore.open(tmp_path / "other", create=True) as other, pytest.raises(StateError, match="trust init"):
        prepare_bus(other, "tls/0.0.0.0:0", insecure=False)


@pytest.mark.parametrize(
    ("file", "days", "words"),
    [
        ("server.pem", 398, "server.pem ended at .* trust rotate server"),
        ("robots-ca.crt", 1826, "rotate robots-ca"),
        ("server.pem", -1, "server.pem begins at .*timedatectl"),
        ("server.pem", 390, ""),
    ],
)
def test_a_certificate_that_nobody_would_believe_is_an_error_at_start(
    register: RobotRegister, caplog, file: str, days: int, words: str
) -> None:
    at = Authorities(register._keys, datetime.now(UTC) + timedelta(days=days))
    if file == "robots-ca.crt":  # the server's own was renewed meanwhile
        path, key = at._path("server.pem"), at._read("servers-ca.pem")
        servers = Authority(load_pem_private_key(key, None), load_pem_x509_certificate(at._read("servers-ca.crt")))
        path.write_bytes(servers.sign(servers.key.public_key(), "s", 3000, hosts=["127.0.0.1"]))
        path.write_bytes(key + path.read_bytes())
    if words:
        with pytest.raises(UsageError, match=words):
            at.check()
    else:
        at.check()
        assert "expires in 6 days" in caplog.text


def test_a_key_that_is_not_the_certificates_is_an_error_at_start(register: RobotRegister) -> None:
    path = register._keys / "server.pem"
    certificate = path.read_text().partition("-----END PRIVATE KEY-----\n")[2]
    path.write_text(enrolment.new_key().decode() + certificate)
    with pytest.raises(UsageError, match="rotate server"):
        prepare_bus(register.store, "tls/127.0.0.1:0", insecure=False)


def test_what_was_signed_while_the_clock_was_ahead_counts_once_it_is_right(register: RobotRegister) -> None:
    """A certificate begins with its authority; a session, bundle or old certificate of the future lives no longer for it."""
    made = register.authorities.make_own("r1.1", "robot")
    assert load_pem_x509_certificate(made).not_valid_before_utc <= datetime.now(UTC) - timedelta(minutes=10)
    marks = {"mark": "2", "mark_before": "1"}
    entry = Enrolment(site="lab", robot="r1", key="", enrolled_ns=0, renewed_ns=400 * DAY_NS, **marks)
    assert {holder.purpose for holder in entry.holders(35 * DAY_NS) if holder.certificate == "r1.1"} == {Purpose.ENROL}


def health(robot: str) -> bytes:
    return encode_message(RobotHealth(site="lab", robot=robot, stamp_ns=1, version=1, status="TRACKING"))


@pytest.mark.parametrize("is_guarded", [True, False])
def test_row_9_invented_robots(register: RobotRegister, monkeypatch, is_guarded: bool) -> None:
    """The program refuses them too, where the bus let them through."""
    monkeypatch.setattr(fleet_module, "MAX_ROBOTS", 200)
    store, hub = register.store, MemoryHub()
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


def test_rules_follow_the_register(register: RobotRegister, caplog) -> None:
    hub = MemoryHub()
    with MemoryBus(hub) as bus:
        register.enrol("lab", ["r1"], "tls/127.0.0.1:7447")
        clock, fleet = {"s": 0.0}, Fleet(register.store)
        guard = BusGuard(register, bus, lambda: clock["s"])
        bus.reopen(guard.access)
        service = BusService(register.store, fleet, bus, lambda *_: None, guard)
        assert not guard.follow()
        bundle = enrolment.decode_bundle(register.enrol("lab", ["r2"], "tls/127.0.0.1:7447")["r2"])
        register.revoke("lab", ["r1"])
        assert guard.follow()
        assert not guard.follow()
        (entry,) = register.robots()
        with MemoryBus(hub, entry.bundle) as fresh:
            question = enrolment.renewal_request(bundle.own.encode(), enrolment.new_key())
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
                # So it is also where a robot connects again before its old session is known to be lost.
                assert not [words for words in guard.look() if "connected" in words and "r2" in words]
                clock["s"] += COPIED_AFTER_S
                assert [words for words in guard.look() if "connected 2 times" in words]
                guard.look()
                fleet.take_copied(guard.copied)
            assert [event.kind for event in register.store.events("lab")].count("robot connected twice") == 1
            (status,) = fleet.robots("lab")
            assert status.is_copied
            found = active_alerts(register.store, fleet, AlertSettings(), register.store.now_ns())
            assert [(alert.name, alert.about) for alert in found if alert.about] == [("FleetmapRobotCopied", "r2")]
            clock["s"] += COPIED_AFTER_S
            guard.look()
            assert not guard.copied
        assert caplog.text.count("'old.00000000'") == 1
        register.authorities.rotate_server(None, None)
        assert guard.follow()
        service.close()


def test_a_renewed_certificate_ends_within_a_day_and_its_robot_goes_on(
    tmp_path: Path, register: RobotRegister, clock: Clock
) -> None:
    """Over TLS: who copied the key before is silenced, and the robot's session takes the new files by itself."""
    store = register.store
    with ExitStack() as stack:
        bundle = enrolment.decode_bundle(register.enrol("lab", ["r1"], "tls/127.0.0.1:7447")["r1"]).own.encode()
        servers = tmp_path / "servers.ca"
        servers.write_text(register.authorities.servers)

        def renewed(old: bytes) -> bytes:
            key = enrolment.new_key()
            answer = register.renew("lab", "r1", enrolment.renewal_request(old, key))
            return key + decode_message(answer, enrolment.RenewalAnswer).certificate.encode()

        own, stolen = tmp_path / "own.pem", tmp_path / "stolen.pem"
        own.write_bytes(renewed(bundle))
        clock.now_ns += 2 * DAY_NS
        bus, guard = prepare_bus(store, "tls/127.0.0.1:0", insecure=False)
        stack.callback(BusService(store, Fleet(store), bus, lambda *_: None, guard).close)
        stack.enter_context(bus)
        bus.open()
        robot = stack.enter_context(Bus(bus.endpoint, tls=TlsFiles(servers, own)).open())
        wanted, renew = robot_key("lab", "r1", "wanted"), robot_key("lab", "r1", "renew")
        assert robot.get(wanted, timeout_s=20)
        stolen.write_bytes(own.read_bytes())
        own.write_bytes(renewed(own.read_bytes()))
        assert not guard.follow()
        thief = stack.enter_context(Bus(bus.endpoint, tls=TlsFiles(servers, stolen)).open())
        assert thief.get(wanted, timeout_s=20), "the control: at once both certificates are let in"
        clock.now_ns += DAY_NS
        guard._due_s = 0.0
        assert guard.follow()
        assert robot.get(wanted, timeout_s=20)
        with pytest.raises(UnreachableError, match="lets this certificate say nothing"):
            thief.get(wanted, timeout_s=2)
        with pytest.raises(LinkError, match="may not renew"):
            thief.get(renew, enrolment.renewal_request(stolen.read_bytes(), enrolment.new_key()), timeout_s=10)
