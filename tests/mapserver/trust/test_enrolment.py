"""Enrolment on the in-memory bus: bundles, renewals, lost answers, copies (row 35), and the authorities behind them."""

import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest

from fleetmap.access import Purpose
from fleetmap.errors import LinkError, StateError, StoreError, UsageError
from fleetmap.messages import decode_message
from fleetmap.trust import enrolment
from mapserver.store import MapStore
from mapserver.trust import init_here
from mapserver.trust.enrolment import RobotRegister
from mapserver.trust.status import trust_status
from support.storage.clock import Clock
from support.storage.map_samples import save_sample_draft

ENDPOINT = "tls/127.0.0.1:7447"
DAY_NS = 86_400_000_000_000


class World:
    def __init__(self, store: MapStore, clock: Clock) -> None:
        self.store, self.clock, self.register = store, clock, RobotRegister(store)

    def bundle(self, robot: str = "r1", site: str = "lab") -> enrolment.Bundle:
        return enrolment.decode_bundle(self.register.enrol(site, [robot], ENDPOINT)[robot])

    def ask(self, old: bytes, new: bytes, robot: str = "r1") -> enrolment.CertificateInfo:
        answer = self.register.renew("lab", robot, enrolment.renewal_request(old, new))
        return enrolment.certificate_info(decode_message(answer, enrolment.RenewalAnswer).certificate.encode())

    def refusals(self) -> list[str]:
        return [event.detail for event in self.store.events("lab") if event.kind == "renewal refused"]


@pytest.fixture
def world(store: MapStore, clock: Clock) -> World:
    clock.now_ns = time.time_ns()
    save_sample_draft(store)
    init_here(store)
    made = World(store, clock)
    made.register.authorities.init(["127.0.0.1", "maps.example"], None, None)
    return made


def test_a_robot_gets_a_certificate_and_renews_it(world: World) -> None:
    bundle = world.bundle()
    assert (bundle.site, bundle.robot, bundle.endpoint) == ("lab", "r1", ENDPOINT)
    first, second = enrolment.new_key(), enrolment.new_key()
    about = world.ask(bundle.own.encode(), first)
    assert about.name.startswith("r1.")
    assert about.fingerprint == enrolment.key_fingerprint(first)
    assert timedelta(days=364) < about.ends - datetime.now(UTC) < timedelta(days=366)
    (entry,) = world.register.robots("lab")
    assert (entry.certificate, world.register.access().holder(about.name).robot) == (about.name, "r1")
    world.clock.now_ns += DAY_NS
    before = world.register.access()
    renewed = world.ask(first, second)
    assert world.register.access() == before, "a renewal interrupts nobody"
    assert world.ask(first, second).name == renewed.name != about.name
    world.clock.now_ns += DAY_NS  # from here on the certificate before may only ask again, for an answer that was lost
    purposes = [world.register.access().holder(name).purpose for name in (renewed.name, about.name)]
    assert purposes == [Purpose.ROBOT, Purpose.ENROL]
    kinds = [event.kind for event in world.store.events("lab")]
    assert kinds[-4:] == ["robot enrolled", *["robot renewed"] * 3]


def test_row_35_a_copied_bundle(world: World) -> None:
    bundle, own, thiefs = world.bundle().own.encode(), enrolment.new_key(), enrolment.new_key()
    register = world.store.folder / "keys" / "robots.json"
    before = register.read_bytes()
    world.ask(bundle, own)
    with pytest.raises(LinkError, match="the bundle was already used"):
        world.ask(bundle, thiefs)
    assert "the bundle was already used" in world.refusals()[0]
    # Who is first cannot be told; the robot's own refusal tells it.
    other = world.bundle("r2").own.encode()
    assert world.ask(other, thiefs, "r2")
    with pytest.raises(LinkError, match="the bundle was already used"):
        world.ask(other, own, "r2")
    world.register.revoke("lab", ["r2"])
    with pytest.raises(LinkError, match="not enrolled"):
        world.ask(thiefs, enrolment.new_key(), "r2")
    register.write_bytes(before)
    assert world.ask(bundle, thiefs), "the control: a server that does not remember the use"


@pytest.mark.parametrize("spoiled", ["nothing", "no message", "another proof", "another key", "bytes"])
def test_what_proves_nothing_is_refused(world: World, spoiled: str) -> None:
    bundle, key = world.bundle().own.encode(), enrolment.new_key()
    payload = enrolment.renewal_request(bundle, key)
    asked = decode_message(payload, enrolment.RenewalRequest)
    strangers = decode_message(enrolment.renewal_request(enrolment.new_key(), key), enrolment.RenewalRequest)
    wrong = {
        "nothing": b"",
        "no message": b"\xc1" * 50,
        "another proof": msgspec.msgpack.encode(msgspec.structs.replace(asked, proof=strangers.proof)),
        "another key": msgspec.msgpack.encode(strangers),
        "bytes": msgspec.msgpack.encode(msgspec.structs.replace(asked, csr=b"x", old_key=b"y")),
    }[spoiled]
    with pytest.raises(LinkError):
        world.register.renew("lab", "r1", wrong)
    assert len(world.refusals()) == 1
    assert world.register.renew("lab", "r1", payload), "the control"


def test_enrolling_again(world: World) -> None:
    bundle = world.bundle()
    again = world.bundle()  # it was not used: another one takes its place
    with pytest.raises(LinkError, match="may not renew"):
        world.ask(bundle.own.encode(), enrolment.new_key())
    world.ask(again.own.encode(), enrolment.new_key())
    with pytest.raises(StateError, match="robots revoke r1"):
        world.bundle()
    before = world.register.robots()[0].certificate
    assert world.register.revoke("lab", ["r1", "nobody"]) == ["r1"]
    world.bundle()
    assert world.register.robots()[0].certificate != before
    for robot, site in (("R 1", "lab"), ("r1", "a/b")):
        with pytest.raises(UsageError, match="name"):
            world.bundle(robot, site)
    with pytest.raises(UsageError, match=r"its certificate names 127.0.0.1, maps.example"):
        world.register.enrol("lab", ["r9"], "tls/elsewhere:7447")
    assert len(world.register.robots()) == 1


def test_the_bundles_name_leaves_the_rules_after_a_day(world: World) -> None:
    world.bundle()
    name = world.register.robots()[0].bundle
    assert world.register.access().holder(name).purpose is Purpose.ENROL
    world.clock.now_ns += DAY_NS + 1
    assert world.register.access().holder(name) is None
    assert "bundle expired" in world.register.robots()[0].shown(world.clock.now_ns).state


def test_long_names_differ_by_their_marks(world: World) -> None:
    names = ["x" * 63 + "1", "x" * 63 + "2"]
    world.register.enrol("lab", names, ENDPOINT)
    first, second = (entry.certificate for entry in world.register.robots())
    assert first != second
    assert max(len(entry.bundle) for entry in world.register.robots()) <= 64


def test_rotations(world: World) -> None:
    authorities = world.register.authorities
    before = world.register.tls_state()
    authorities.rotate_server(None, None)
    assert world.register.tls_state() != before
    assert authorities.hosts == ("127.0.0.1", "maps.example")
    bundle, key = world.bundle().own.encode(), enrolment.new_key()
    world.ask(bundle, key)
    authorities.rotate_robots_ca(is_stolen=False)
    assert authorities.tls.authority.read_text().count("BEGIN CERTIFICATE") == 2
    assert world.ask(key, enrolment.new_key())  # by the new one
    authorities.rotate_robots_ca(is_stolen=True)
    assert authorities.tls.authority.read_text().count("BEGIN CERTIFICATE") == 1
    assert world.register.revoke_all() == 1
    with pytest.raises(UsageError, match="is missing"):
        authorities.rotate_server(Path("nowhere.pem"), None)
    with pytest.raises(UsageError, match="not the key of servers-ca"):
        authorities.rotate_server(authorities.folder / "robots-ca.pem", None)
    with pytest.raises(StateError, match="already"):
        authorities.init(["a"], None, None)


def test_the_servers_key_on_a_stick(store: MapStore, tmp_path: Path) -> None:
    authorities = RobotRegister(store).authorities
    with pytest.raises(StateError, match="trust init --here --host NAME"):
        _ = RobotRegister(store).tls
    with pytest.raises(UsageError, match="an invalid name or address"):
        authorities.init(["a b"], None, None)
    stick = tmp_path / "ada" / "servers-ca.pem"
    authorities.init(["maps.example"], stick, "abcd-efgh")
    assert not (authorities.folder / "servers-ca.pem").exists()
    assert stick.stat().st_mode & 0o077 == 0
    with pytest.raises(UsageError, match="another passphrase"):
        authorities.rotate_server(stick, "wrong")
    authorities.rotate_server(stick, "abcd-efgh", ["other.example"])
    assert authorities.hosts == ("other.example",)


def test_status_warns_before_a_certificate_ends(world: World) -> None:
    assert not [fault for fault in trust_status(world.store).faults if "server.pem" in fault]
    world.clock.now_ns += 370 * DAY_NS
    assert "trust rotate server" in next(fault for fault in trust_status(world.store).faults if "server.pem" in fault)


def test_a_damaged_register_is_told(world: World) -> None:
    (world.store.folder / "keys" / "robots.json").write_text("[{")
    with pytest.raises(StoreError, match="restore it"):
        world.register.robots()
    with pytest.raises(UsageError, match="not an enrolment bundle"):
        enrolment.decode_bundle(b"{}")
