"""From a store to enrolled robots with the programs, on loopback with TLS: enrolment, a thief among the robots, revocation."""

from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from fleetmap.bus.zenoh_bus import Bus, _config
from fleetmap.errors import UnreachableError
from fleetmap.messages import WantedVersion, decode_message, encode_message, robot_key
from locclient.identity import MapAddress, RobotIdentity
from locclient.maps.map_client import connected
from mapserver import releases
from mapserver.store import MapStore
from support.fleet.tls_site import TlsSite
from support.storage.map_samples import save_sample_draft
from support.waiting import eventually

SITE = "lab"
FORGED = encode_message(WantedVersion(site=SITE, version=99, manifest_sha256="f" * 64))


@pytest.fixture
def site(tmp_path: Path) -> TlsSite:
    made = TlsSite(tmp_path, SITE)
    with MapStore.open(made.store, create=True) as store:
        save_sample_draft(store)
        releases.publish(store, SITE)
    return made


def wanted(bus: Bus, robot: str, timeout_s: float = 10.0) -> int | None:
    try:
        return decode_message(bus.get(robot_key(SITE, robot, "wanted"), timeout_s=timeout_s), WantedVersion).version
    except UnreachableError:
        return None


def attacker(endpoint: str, identity: RobotIdentity | None) -> zenoh.Session:
    """Somebody in client mode who answers every robot's question for its version."""
    entries = {"mode": "client", "connect/endpoints": [endpoint]}
    tls = {} if identity is None else {"transport/link/tls": identity.tls.config("connect")}
    session = zenoh.open(_config(entries | tls))

    def lie(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, FORGED)

    session.declare_queryable(robot_key("*", "*", "wanted"), lie, complete=True)
    return session


def test_two_robots_from_an_empty_folder(site: TlsSite) -> None:
    to_store = "--store", site.store
    assert "mapserver trust init --here" in site.run("mapserver", "serve", *to_store, "--zenoh", "tcp/0.0.0.0:0")
    said = site.run("mapserver", "trust", "init", "--here", "--host", "127.0.0.1", *to_store)
    assert "--host 127.0.0.1" not in said
    with ExitStack() as stack:
        with site.serving("tls/127.0.0.1:0"):
            one, two = site.enrol("r1"), site.enrol("r2")
            bundle, elsewhere = site.folder / "r1.fleetmap", site.folder / "thief"
            assert "the bundle was already used" in site.run("locclient", "enrol", bundle, "--identity", elsewhere)
            listed = site.run("mapserver", "robots", "list", "--store", site.store)
            assert listed.count("certificate for 365 days") == 2
            # Row 1: a robot that answers in the server's place.
            thief = stack.enter_context(attacker(site.endpoint, one))
            honest = stack.enter_context(Bus(two.who.endpoint, tls=two.tls).open())
            assert [wanted(honest, "r2") for _ in range(10)] == [1] * 10
            address = MapAddress.of(None, identity=two.folder)
            with connected(address, site.folder / "cache", 10**8) as maps:
                assert (maps.ready().wanted.version, address.robot) == (1, "r2")
        # Row 2: the same while the server starts; who was connected before is there first.
        with site.serving(site.endpoint):
            assert [wanted(honest, "r2") for _ in range(10)] == [1] * 10
            # Row 6: revoked while it is connected.
            with Bus(one.who.endpoint, tls=one.tls).open() as stolen:
                assert wanted(stolen, "r1") == 1
                site.run("mapserver", "robots", "revoke", "r1", "--site", SITE, "--store", site.store)
                assert eventually(lambda: wanted(stolen, "r1", 0.3) is None, 5)
                assert eventually(lambda: wanted(honest, "r2", 1.0) == 1, 10)
                assert wanted(stolen, "r1", 2.0) is None
            thief.close()


def test_the_same_thief_without_tls_is_heard(site: TlsSite) -> None:
    """The control: on an open bus he answers first, most of the time."""
    with site.serving("tcp/127.0.0.1:0"), Bus(site.endpoint).open() as honest, attacker(site.endpoint, None) as thief:
        assert eventually(lambda: wanted(honest, "r2") == 99, 20)
        thief.close()


def test_a_bus_that_listens_before_the_server_answers_is_the_thiefs() -> None:
    """The control of row 2: as it was while the server still read its store."""
    with Bus("tcp/127.0.0.1:0", is_server=True).open() as bare, Bus(bare.endpoint).open() as honest:
        thief = attacker(bare.endpoint, None)
        assert wanted(honest, "r2") == 99
        thief.close()


def test_the_demo_needs_no_keys(site: TlsSite) -> None:
    with site.serving("tcp/127.0.0.1:0"), Bus(site.endpoint).open() as robot:
        assert wanted(robot, "anybody") == 1
    addresses = "--http", "127.0.0.1:0", "--zenoh", "tls/127.0.0.1:0"
    refused = site.run("mapserver", "serve", "--store", site.store, *addresses)
    assert "has no certificate" in refused
