"""Who may say what: the same attacks on both buses, as a peer and as a client, each also where the rules are off.

Rows 1, 3, 6, 7 and 30 of the list of attacks in docs/security.md.
"""

import json
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest
import zenoh

from fleetmap.access import Access, Holder, Purpose
from fleetmap.bus.endpoints import TlsFiles, handshake_fault, with_free_port
from fleetmap.bus.zenoh_bus import Bus, _config
from fleetmap.errors import LinkError, UnreachableError
from mapserver.trust.authorities import Authorities
from support.fleet.memory_bus import MemoryBus, MemoryHub, permits
from support.waiting import eventually

OWN, OTHERS = "fleetmap/hall/robots/a/", "fleetmap/hall/robots/b/"
ROBOTS = Holder("a.1", "hall", "a"), Holder("b.1", "hall", "b"), Holder("c.1.enrol", "hall", "c", Purpose.ENROL)
ACCESS = Access([*ROBOTS, Holder("live.survey", purpose=Purpose.SURVEY)])


class Keys:
    """Authorities of a server, of its robots and of strangers, and files of theirs."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.ours, self.strangers = (Authorities(folder / name, datetime.now(UTC)) for name in ("ours", "strangers"))
        for authorities in (self.ours, self.strangers):
            authorities.init(["127.0.0.1"], None, None)

    def robot(self, certificate: str, authorities: Authorities | None = None) -> TlsFiles:
        signed_by = authorities or self.ours
        path = self.folder / f"{certificate}-{signed_by.folder.name}.pem"
        path.write_bytes(signed_by.make_own(certificate, "robot"))
        return TlsFiles(self.folder / "ours" / "servers-ca.crt", path)


class World:
    """A server that answers, and others who join by the names in their certificates."""

    def __init__(self, kind: str, is_guarded: bool, keys: Keys, stack: ExitStack) -> None:
        self.kind, self.keys, self.stack = kind, keys, stack
        if kind == "memory":
            self.hub = MemoryHub(ACCESS if is_guarded else None)
            self.server: Bus = MemoryBus(self.hub)
        else:
            access = ACCESS if is_guarded else None
            self.server = Bus("tls/127.0.0.1:0", is_server=True, tls=keys.ours.tls, access=access).open()
        stack.enter_context(self.server)
        self.heard: list[tuple[str, str]] = []  # what a publication holds, and its key
        for keys_of_all in ("robots/*/health", "live/*"):
            heard = lambda key, said: self.heard.append((said.decode(), key))  # noqa: E731
            self.server.subscribe(f"fleetmap/*/{keys_of_all}", heard)
        for what in ("robots/*/wanted", "blobs/*", "robots/*/blobs/*", "robots/*/renew"):
            self.server.queryable(f"fleetmap/*/{what}", lambda *_: b"honest")

    def join(self, certificate: str) -> Bus:
        if self.kind == "memory":
            return self.stack.enter_context(MemoryBus(self.hub, certificate))
        bus = Bus(self.server.endpoint, tls=self.keys.robot(certificate))
        if self.kind == "client":
            # Whoever attacks chooses the mode; between peers the server's router passes nothing on.
            tls = bus._tls.config("connect")
            entries = {"mode": "client", "connect/endpoints": [bus.endpoint], "transport/link/tls": tls}
            bus._session = zenoh.open(_config(entries))
        else:
            bus.open()
        self.stack.callback(bus.close)
        assert eventually(bus.connected)
        return bus

    def settle(self) -> None:
        if self.kind != "memory":
            time.sleep(0.4)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    return Keys(tmp_path_factory.mktemp("keys"))


@pytest.fixture(params=["memory", "peer", "client"])
def make(request: pytest.FixtureRequest, keys: Keys) -> Iterator[Callable[[bool], World]]:
    with ExitStack() as stack:
        yield lambda is_guarded: World(request.param, is_guarded, keys, stack)


def answer(bus: Bus, key: str) -> str:
    try:
        return bus.get(key, timeout_s=0.5).decode()
    except UnreachableError as error:
        return "silenced" if "lets this certificate say nothing" in str(error) else "silence"


ALLOWED, DENIED = "honest", "silenced"


def test_questions(make: Callable[[bool], World]) -> None:
    said = {
        OWN + "wanted": ALLOWED,
        OWN + "blobs/00ff": ALLOWED,
        "fleetmap/hall/blobs/00ff": DENIED,
        OTHERS + "blobs/00ff": DENIED,
        OWN + "renew": ALLOWED,
        OTHERS + "wanted": DENIED,
        OTHERS + "renew": DENIED,
        "fleetmap/yard/robots/a/blobs/00ff": DENIED,
        "fleetmap/yard/robots/a/wanted": DENIED,
    }
    guarded, control = (make(is_guarded).join("a.1") for is_guarded in (True, False))
    with ThreadPoolExecutor(len(said)) as pool:  # an answer that never comes is waited for
        assert dict(zip(said, pool.map(partial(answer, guarded), said), strict=True)) == said
    assert {answer(control, key) for key in said} == {ALLOWED}


def test_publications(make: Callable[[bool], World]) -> None:
    allowed = {("a.1", OWN + "health"), ("live.survey", "fleetmap/hall/live/survey")}
    denied = {
        ("a.1", OTHERS + "health"),
        ("a.1", "fleetmap/yard/robots/a/health"),
        ("a.1", "fleetmap/hall/live/survey"),
        ("live.survey", OWN + "health"),
        ("c.1.enrol", "fleetmap/hall/robots/c/health"),
        ("nobody.1", OWN + "health"),
    }
    for is_guarded in (True, False):
        world = make(is_guarded)
        robots = {certificate: world.join(certificate) for certificate, _ in allowed | denied}
        world.settle()
        arriving: set[tuple[str, str]] = set()
        # zenoh may drop a batch with a denied one whole
        for sent, arrives in ((allowed, True), (denied, not is_guarded)):
            arriving |= sent if arrives else set()
            for certificate, key in sent:
                robots[certificate].publish(key, certificate.encode())
            assert eventually(lambda w=world, a=arriving: set(w.heard) >= a, 5)
            world.settle()
        assert sorted(world.heard) == sorted(arriving)


def test_a_pattern_of_keys_is_no_way_round(make: Callable[[bool], World]) -> None:
    """The bus refuses nothing here: zenoh delivers a put under a wildcard to everybody whom it matches."""
    world = make(True)
    robot = world.join("a.1")
    world.settle()
    robot.publish("fleetmap/hall/robots/*/health", b"x")
    world.settle()
    assert world.heard == []
    assert answer(robot, "fleetmap/hall/robots/*/wanted") == DENIED


@pytest.mark.parametrize("is_guarded", [True, False])
def test_nobody_answers_in_the_servers_place(make: Callable[[bool], World], is_guarded: bool) -> None:
    world = make(is_guarded)
    eve, bob = world.join("a.1"), world.join("b.1")
    lie = Mock(return_value=b"EVIL")
    for key in ("fleetmap/hall/robots/*/manifests/*", "fleetmap/**"):
        eve.queryable(key, lie)
    world.settle()
    said = answer(bob, OTHERS + "manifests/7")
    if is_guarded:
        assert (said, lie.call_count) == (DENIED, 0)
    elif world.kind != "peer":  # a router passes nothing on between peers, so that there is no attack
        assert said == "EVIL", "the control"


@pytest.mark.parametrize("is_guarded", [True, False])
def test_nobody_hears_what_is_for_others(make: Callable[[bool], World], is_guarded: bool) -> None:
    world = make(is_guarded)
    eve, bob = world.join("a.1"), world.join("b.1")
    heard: list[str] = []
    for key_expr in (OWN + "wanted", OWN + "initial_pose", OTHERS + "wanted", "**", "fleetmap/hall/robots/*/health"):
        eve.subscribe(key_expr, lambda key, _: heard.append(key))
    world.settle()
    world.server.publish(OTHERS + "wanted", b"3")
    bob.publish(OTHERS + "health", b"x")
    for key in (OTHERS, OWN):
        world.server.publish(key + "initial_pose", b"4")
    world.server.publish(OWN + "wanted", b"3")
    assert eventually(lambda: OWN + "wanted" in heard, 5)
    world.settle()
    if is_guarded:
        assert set(heard) == {OWN + "wanted", OWN + "initial_pose"}
    else:
        assert OTHERS + "wanted" in heard, "the control"


def test_only_the_server_orders_robots(make: Callable[[bool], World]) -> None:
    """A copied identity: it moves neither its original nor others, and cannot answer in their place either."""
    for is_guarded in (True, False):
        world = make(is_guarded)
        original, other = world.join("a.1"), world.join("b.1")
        kinds = ("client",) if world.kind == "client" else (world.kind, "client")[: 1 + (world.kind == "peer")]
        for kind in kinds:  # whoever attacks chooses the mode
            before, world.kind = world.kind, kind
            copy = world.join("a.1")
            world.kind = before
            heard: list[tuple[str, bytes]] = []
            for bus, own in ((original, OWN), (other, OTHERS)):
                for what in ("wanted", "initial_pose", "renew", "*"):
                    bus.subscribe(own + what, lambda *sample, h=heard: h.append(sample))
            copy.queryable(OWN + "wanted", lambda *_: b"EVIL")
            world.settle()
            for own in (OWN, OTHERS):
                for what in ("wanted", "initial_pose", "renew", "failures", "alive"):
                    copy.publish(own + what, b"EVIL")
            world.settle()
            said = answer(original, OWN + "wanted")
            world.server.publish(OWN + "initial_pose", b"honest")
            assert eventually(lambda h=heard: (OWN + "initial_pose", b"honest") in h, 5)
            if is_guarded:
                assert {payload for _, payload in heard} == {b"honest"}
                assert said == ALLOWED
            elif kind == "client":
                assert (OWN + "initial_pose", b"EVIL") in heard, "the control"


def test_presence_is_shown_for_oneself_alone(make: Callable[[bool], World]) -> None:
    for is_guarded in (True, False):
        world = make(is_guarded)
        eve, bob = world.join("a.1"), world.join("b.1")
        eve.declare_alive(OWN + "alive")
        eve.declare_alive(OTHERS + "alive")
        expected = [OWN + "alive"] if is_guarded else [OWN + "alive", OTHERS + "alive"]
        assert eventually(lambda w=world, e=expected: w.server.alive("fleetmap/**") == e, 5)
        if is_guarded:
            assert bob.alive("fleetmap/**") == []


def test_the_admin_space_is_closed(keys: Keys) -> None:
    """Row 30: nothing of the server is read there, and rules that are written there change nothing."""
    with ExitStack() as stack:
        world = World("client", True, keys, stack)
        robot = world.join("a.1")
        server = str(world.server._session.zid())
        found = [str(r.ok.key_expr) for r in robot._session.get("@/**", timeout=1) if r.ok is not None]
        assert not [key for key in found if key.startswith(f"@/{server}/")]
        rules = {"enabled": False, "default_permission": "allow"}
        robot._session.put(f"@/{server}/router/config/access_control", json.dumps(rules))
        world.settle()
        assert answer(robot, OTHERS + "wanted") == DENIED
        endpoint = with_free_port("tcp/127.0.0.1:0")
        control = _config({"mode": "router", "listen/endpoints": [endpoint], "adminspace/enabled": True})
        with zenoh.open(control) as bare, Bus(endpoint).open() as reader:
            assert eventually(reader.connected)
            where = f"@/{bare.zid()}/**"
            assert [reply for reply in reader._session.get(where, timeout=1) if reply.ok is not None], "the control"


def test_certificates_of_others(keys: Keys, tmp_path: Path) -> None:
    """Row 3, and why TLS refuses: zenoh tries on and says nothing, the handshake says it."""
    with ExitStack() as stack:
        world = World("peer", True, keys, stack)
        endpoint = world.server.endpoint
        assert handshake_fault(endpoint, keys.robot("a.1")) == ""
        stranger = keys.robot("a.1", keys.strangers)
        assert "does not know who signed" in handshake_fault(endpoint, stranger)
        wrong_server = TlsFiles(tmp_path / "other.ca", keys.robot("a.1").own)
        wrong_server.authority.write_text(keys.strangers.servers)
        assert "server's certificate is refused" in handshake_fault(endpoint, wrong_server)
        for files in (stranger, wrong_server):
            bus = stack.enter_context(Bus(endpoint, tls=files).open())
            with pytest.raises(UnreachableError):
                bus.get(OWN + "wanted", timeout_s=1.0)
            assert not bus.connected()
        # A robot's certificate cannot play the server, and neither can the server under another name.
        played = TlsFiles(keys.ours.tls.authority, keys.robot("a.1").own)
        fake = stack.enter_context(Bus("tls/127.0.0.1:0", is_server=True, tls=played, access=ACCESS).open())
        fake.queryable("fleetmap/**", lambda *_: b"EVIL")
        elsewhere = world.server.endpoint.replace("127.0.0.1", "localhost")
        for wrong in (fake.endpoint, elsewhere):
            victim = stack.enter_context(Bus(wrong, tls=keys.robot("b.1")).open())
            with pytest.raises(UnreachableError):
                victim.get(OTHERS + "blobs/00ff", timeout_s=1.0)
            assert not victim.connected()
            assert "server's certificate is refused" in handshake_fault(wrong, keys.robot("b.1"))
        good = stack.enter_context(Bus(endpoint, tls=keys.robot("b.1")).open())
        assert good.get(OTHERS + "blobs/00ff") == b"honest"
        # The control: without TLS, or where it is not looked at who signed the server's certificate, the robot believes both.
        for how, robot in ((None, None), (keys.strangers.tls, TlsFiles(wrong_server.authority, stranger.own))):
            endpoint = "tls/127.0.0.1:0" if how else "tcp/127.0.0.1:0"
            fake = stack.enter_context(Bus(endpoint, is_server=True, tls=how).open())
            fake.queryable("fleetmap/**", lambda *_: b"EVIL")
            victim = stack.enter_context(Bus(fake.endpoint, tls=robot).open())
            assert victim.get(OTHERS + "blobs/00ff") == b"EVIL"
    with pytest.raises(UnreachableError, match="nothing listens at"):
        handshake_fault(world.server.endpoint, keys.robot("a.1"))
    late = Bus(with_free_port("tcp/127.0.0.1:0"), is_server=True)
    start = threading.Timer(0.3, late.open)
    start.start()
    assert handshake_fault(late.endpoint, None, patience_s=20.0) == "", "a server that starts is waited for"
    start.join()
    late.close()


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_a_revoked_robot_is_out_while_it_is_connected(keys: Keys, protocol: str) -> None:
    """Row 6: what robots and the server had declared comes back by itself, but not the revoked one's."""
    heard: list[str] = []
    with Bus(f"{protocol}/127.0.0.1:0", is_server=True, tls=keys.ours.tls, access=ACCESS).open() as server:
        server.queryable("fleetmap/*/robots/*/wanted", lambda key, _: key.encode())
        server.subscribe("fleetmap/*/robots/*/health", lambda key, _: heard.append(key))
        server.queryable("fleetmap/*/robots/*/blobs/*", lambda *_: b"").close()
        with (
            Bus(server.endpoint, tls=keys.robot("a.1")).open() as a,
            Bus(server.endpoint, tls=keys.robot("b.1")).open() as b,
        ):
            for bus, own in ((a, OWN), (b, OTHERS)):
                assert bus.get(own + "wanted", timeout_s=10)
                bus.declare_alive(own + "alive")
            assert eventually(lambda: len(server.alive("fleetmap/**")) == 2)
            assert server.certificates() == ["a.1", "b.1"]
            told: list[bytes] = []
            b.subscribe(OTHERS + "wanted", lambda _, payload: told.append(payload))
            server.reopen(Access([Holder("b.1", "hall", "b")]))
            assert b.get(OTHERS + "wanted", timeout_s=5)
            assert eventually(lambda: server.alive("fleetmap/**") == [OTHERS + "alive"], 5)
            assert eventually(lambda: server.publish(OTHERS + "wanted", b"4") or bool(told), 5)
            assert eventually(a.connected)
            with pytest.raises(UnreachableError, match="lets this certificate say nothing"):
                a.get(OWN + "wanted", timeout_s=0.5)
            heard.clear()
            for bus, own in ((a, OWN), (b, OTHERS)):
                bus.publish(own + "health", b"x")
            assert eventually(lambda: heard == [OTHERS + "health"], 3)
            with pytest.raises(UnreachableError):
                b.get(OTHERS + "blobs/00", timeout_s=0.3)  # a closed handle stays closed
            server.reopen(ACCESS)
            assert a.get(OWN + "wanted", timeout_s=5), "the control"


def test_a_damaged_certificate_does_not_close_the_bus(keys: Keys, tmp_path: Path) -> None:
    own = tmp_path / "server.pem"
    own.write_bytes(keys.ours.tls.own.read_bytes())
    files = TlsFiles(keys.ours.tls.authority, own)
    with Bus("tls/127.0.0.1:0", is_server=True, tls=files, access=ACCESS).open() as server:
        server.queryable("fleetmap/*/robots/*/blobs/*", lambda *_: b"honest")
        with Bus(server.endpoint, tls=keys.robot("a.1")).open() as robot:
            own.write_text("damaged")
            with pytest.raises(LinkError, match="the bus stays as it is"):
                server.reopen(ACCESS)
            assert robot.get(OWN + "blobs/00", timeout_s=10) == b"honest"


def test_rules_of_nobody_and_of_many() -> None:
    """zenoh refuses empty lists."""
    config = Access([]).zenoh_config()["access_control"]
    assert config["default_permission"] == "deny"
    assert all(config[name] for name in ("rules", "subjects", "policies"))
    many = Access(Holder(f"r{n}.1", f"s{n % 3}", f"r{n}") for n in range(300)).zenoh_config()["access_control"]
    assert len(many["rules"]) == 300 * 6
    assert len({rule["id"] for rule in many["rules"]}) == len(many["rules"])
    assert not permits(ACCESS, "a.1", "ingress", "declare_queryable", OWN + "blobs/*")
    assert not permits(ACCESS, "a.1", "ingress", "declare_subscriber", "fleetmap/hall/robots/*/wanted")
    assert not any("@" in key for rule in many["rules"] for key in rule["key_exprs"])
