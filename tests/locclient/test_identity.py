"""Where a robot's map comes from, and its identity: enrolment over real TLS, lost answers, renewal; row 37."""

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest

import locclient.identity as identity_module
from fleetmap.bus.endpoints import TlsFiles
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import LinkError, StateError, UnreachableError, UsageError
from fleetmap.messages import robot_key
from locclient.config import LocclientConfig, RunSection
from locclient.daemon.daemon import check_run
from locclient.identity import MapAddress, RobotIdentity, check_reach, identity_folder
from locclient.outputs import OutputSection
from mapserver.store import MapStore
from mapserver.trust import init_here
from mapserver.trust.enrolment import RobotRegister
from support.storage.map_samples import save_sample_draft


@dataclass
class Server:
    """Authorities and a bus that renews; `answers` False loses them."""

    register: RobotRegister
    bus: Bus
    answers: bool = True

    def bundle(self, robot: str) -> bytes:
        made = self.register.enrol("lab", [robot], self.bus.endpoint)[robot]
        self.bus.reopen(self.register.access())
        return made

    def renew(self, key: str, payload: bytes) -> bytes:
        answer = self.register.renew("lab", key.split("/")[3], payload)
        if not self.answers:
            raise LinkError("lost on its way")
        return answer


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with MapStore.open(tmp_path / "store", create=True) as store:
        save_sample_draft(store)
        init_here(store)
        register = RobotRegister(store)
        register.authorities.init(["127.0.0.1"], None, None)
        with Bus("tls/127.0.0.1:0", is_server=True, tls=register.tls, access=register.access()).open() as bus:
            made = Server(register, bus)
            bus.queryable(robot_key("*", "*", "renew"), made.renew)
            bus.queryable(robot_key("*", "*", "wanted"), lambda key, _: key.encode())
            yield made


def asks(identity: RobotIdentity, robot: str) -> bytes:
    with Bus(identity.who.endpoint, tls=identity.tls).open() as bus:
        return bus.get(robot_key("lab", robot, "wanted"), timeout_s=5)


def test_enrolment_and_renewal(tmp_path: Path, server: Server) -> None:
    folder = tmp_path / "identity"
    bundle = server.bundle("r1")
    identity = RobotIdentity.enrol(folder, bundle)
    assert asks(identity, "r1")
    with pytest.raises(UnreachableError, match="lets this certificate say nothing"):
        asks(identity, "r2")
    assert folder.stat().st_mode & 0o077 == 0
    assert all(path.stat().st_mode & 0o077 == 0 for path in folder.iterdir())
    assert {path.name for path in folder.iterdir()} == {"identity.json", "robot.pem", "root.json", "servers.ca"}
    with pytest.raises(StateError, match="holds the identity of r1 at lab"):
        RobotIdentity.enrol(folder, bundle)
    with pytest.raises(LinkError, match="the bundle was already used"):
        RobotIdentity.enrol(tmp_path / "thief", bundle)
    with pytest.raises(UsageError, match=r"half an identity, without robot\.pem: its enrolment did not end; enrol it"):
        address(identity=tmp_path / "thief")
    assert address(identity=tmp_path / "thief", server="tcp/127.0.0.1:7447").robot == "r1"
    before = identity.certificate()
    now = datetime.now(UTC)
    assert not identity.is_renewal_due(now)
    assert identity.is_renewal_due(now + timedelta(days=31))
    with Bus(identity.who.endpoint, tls=identity.tls).open() as bus:
        identity.renew(bus)
        assert bus.get(robot_key("lab", "r1", "wanted"), timeout_s=5), "the connection that stands goes on"
    after = RobotIdentity.load(folder).certificate()
    assert after.name != before.name, "so that rules can end the one before"
    assert after.fingerprint != before.fingerprint
    assert asks(identity, "r1")


def test_a_server_that_takes_up_other_robots_is_waited_for(tmp_path: Path, server: Server) -> None:
    bundle, is_closed, opens = server.bundle("r1"), threading.Event(), server.bus._open
    server.bus._open = lambda: [is_closed.set(), time.sleep(0.5), opens()]  # type: ignore[assignment]
    threading.Thread(target=server.bus.reopen, args=(server.register.access(),)).start()
    assert is_closed.wait(10.0)
    assert asks(RobotIdentity.enrol(tmp_path / "identity", bundle), "r1")


def test_lost_answers_do_no_harm(tmp_path: Path, server: Server) -> None:
    folder, bundle = tmp_path / "identity", server.bundle("r1")
    server.answers = False
    with pytest.raises(LinkError, match="lost on its way"):
        RobotIdentity.enrol(folder, bundle)
    with pytest.raises(UsageError, match="half an identity"):
        RobotIdentity.load(folder)
    server.answers = True
    identity = RobotIdentity.enrol(folder, bundle)
    server.answers = False
    with Bus(identity.who.endpoint, tls=identity.tls).open() as bus:
        before = identity.certificate()
        with pytest.raises(LinkError, match="lost on its way"):
            identity.renew(bus)
        assert identity.certificate() == before
        assert asks(identity, "r1"), "the old certificate goes on"
        server.answers = True
        identity.renew(bus)
    assert identity.certificate().fingerprint != before.fingerprint
    assert asks(identity, "r1")


def test_a_server_that_is_not_the_bundles(tmp_path: Path, server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(identity_module, "_ANSWER_S", 5.0)
    monkeypatch.setattr(identity_module, "_LISTENS_S", 0.0)
    bundle = msgspec.json.decode(server.bundle("r1"))
    with pytest.raises(UsageError, match="not an enrolment bundle"):
        RobotIdentity.enrol(tmp_path / "a", b"PK\x03\x04")
    with pytest.raises(UsageError, match="robot name"):
        RobotIdentity.enrol(tmp_path / "b", msgspec.json.encode({**bundle, "robot": "../r1"}))
    with pytest.raises(UnreachableError, match=r"nothing listens at tls/127\.0\.0\.1:1: is the server running"):
        RobotIdentity.enrol(tmp_path / "c", msgspec.json.encode({**bundle, "endpoint": "tls/127.0.0.1:1"}))
    server.register.revoke("lab", ["r1"])
    server.bus.reopen(server.register.access())
    begun_s = time.monotonic()
    with pytest.raises(UnreachableError, match="lets this certificate say nothing"):
        RobotIdentity.enrol(tmp_path / "d", msgspec.json.encode(bundle))
    assert time.monotonic() - begun_s < 40


def address(**given: object) -> MapAddress:
    return MapAddress.of(None, sign="--", **{"site": "lab", "robot": "r1", "identity": "nowhere"} | given)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"server": "tcp/127.0.0.1:7447", "store": "maps"}, "either --server"),
        ({}, "locclient enrol"),
        ({"site": None}, "--site is missing"),
        ({"server": "tcp/127.0.0.1:7447", "robot": None}, "--robot is missing"),
        ({"server": "tcp/10.0.0.1:7447"}, "another machine and without TLS"),
        ({"server": "tls/10.0.0.1:7447"}, "no identity in nowhere"),
        ({"server": "tls/127.0.0.1:7447", "insecure": True}, "no identity in nowhere"),
        ({"server": "nonsense"}, "endpoint"),
    ],
)
def test_addresses_that_cannot_be_right(given: dict[str, object], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        address(**given)


def test_addresses(tmp_path: Path, server: Server) -> None:
    folder = tmp_path / "identity"
    identity = RobotIdentity.enrol(folder, server.bundle("r1"))
    bare = {"site": None, "robot": None, "identity": str(folder)}
    found = address(**bare)
    assert (found.site, found.robot, found.server) == ("lab", "r1", identity.who.endpoint)
    assert found.root == folder / "root.json"
    assert found.identity.tls == TlsFiles(folder / "servers.ca", folder / "robot.pem")
    with pytest.raises(UsageError, match="robot r2 is asked for"):
        address(**bare | {"robot": "r2"})
    # On loopback and in a store's folder the identity is out of play.
    for other in ({"server": "tcp/127.0.0.1:7447"}, {"store": "maps"}):
        found = address(**other, site="yard", identity=str(folder))
        assert (found.site, found.identity, found.root) == ("yard", None, None)
    assert address(server="tcp/10.0.0.1:7447", insecure=True).identity is None


def test_the_usual_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/fleetmap:/elsewhere")
    assert identity_folder() == Path("/var/lib/fleetmap/identity")
    monkeypatch.delenv("STATE_DIRECTORY")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert identity_folder() == tmp_path / "fleetmap" / "identity"
    assert identity_folder("x") == Path("x")


def test_row_37_estimates_to_another_machine() -> None:
    def config(endpoint: str, *, insecure: bool = False) -> LocclientConfig:
        run = RunSection(store="maps", site="lab", robot="r1", insecure=insecure)
        return LocclientConfig(run=run, output=OutputSection(endpoint=endpoint))

    with pytest.raises(UsageError, match=r"\[output\] endpoint = tcp/10.0.0.1:7448 is on another machine"):
        check_run(config("tcp/10.0.0.1:7448"))
    for good in (config("tcp/10.0.0.1:7448", insecure=True), config("tls/10.0.0.1:7448"), config("tcp/[::1]:7448")):
        assert check_run(good).robot == "r1", "the control"
    check_reach(None, insecure=False)


def test_a_damaged_identity_is_told(tmp_path: Path) -> None:
    for name in ("robot.pem", "servers.ca", "root.json"):
        (tmp_path / name).write_text("x")
    with pytest.raises(UsageError, match=r"half an identity, without identity\.json: remove the folder"):
        RobotIdentity.load(tmp_path)
    (tmp_path / "identity.json").write_text("{")
    with pytest.raises(UsageError, match="is damaged"):
        RobotIdentity.load(tmp_path)
    (tmp_path / "identity.json").write_text('{"site": "lab", "robot": "r1", "endpoint": "tls/h:1"}')
    with pytest.raises(UsageError, match="no certificate"):
        RobotIdentity.load(tmp_path).certificate()
