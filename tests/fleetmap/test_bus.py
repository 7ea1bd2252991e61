"""Both buses keep the same promises; zenoh's own pitfalls are covered on loopback."""

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from unittest.mock import Mock

import pytest
import zenoh

from fleetmap.bus.endpoints import check_endpoint
from fleetmap.bus.zenoh_bus import MAX_MESSAGE_BYTES, Bus
from fleetmap.errors import LinkError, StoreError, UnreachableError, UsageError
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.waiting import eventually


@pytest.fixture(params=["memory", "zenoh"])
def pair(request: pytest.FixtureRequest) -> Iterator[tuple[Bus, Bus]]:
    """Server and robot."""
    if request.param == "memory":
        hub = MemoryHub()
        server, robot = MemoryBus(hub), MemoryBus(hub)
    else:
        server = Bus("tcp/127.0.0.1:0", is_server=True).open()
        robot = Bus(server.endpoint).open()
    with server, robot:
        yield server, robot
    assert server.closed()
    assert robot.closed()


def test_questions_are_answered(pair: tuple[Bus, Bus]) -> None:
    server, robot = pair
    server.queryable("site/*/blobs/*", lambda key, payload: key.encode() + b"|" + payload)
    assert robot.get("site/a/blobs/b", b"why") == b"site/a/blobs/b|why"
    big = bytes(range(256)) * 4096
    server.queryable("big", lambda *_: big)
    assert robot.get("big", big) == big
    assert eventually(robot.connected)


def test_refusals_and_faults_reach_the_asker(pair: tuple[Bus, Bus], caplog: pytest.LogCaptureFixture) -> None:
    server, robot = pair
    server.queryable("ask/known", Mock(side_effect=StoreError("the disk is gone")))
    server.queryable("ask/fault", Mock(side_effect=ZeroDivisionError))
    with pytest.raises(LinkError, match="disk is gone") as refusal:
        robot.get("ask/known")
    assert not isinstance(refusal.value, UnreachableError)
    with pytest.raises(LinkError, match=r"internal error.*ZeroDivisionError"):
        robot.get("ask/fault")
    assert "answering 'ask/fault' failed" in caplog.text


def test_no_message_exceeds_a_mebibyte(pair: tuple[Bus, Bus]) -> None:
    server, robot = pair
    larger = bytes(MAX_MESSAGE_BYTES + 1)
    server.queryable("larger", lambda *_: larger)
    with pytest.raises(LinkError, match="1048577 bytes under larger"):
        robot.get("larger")
    with pytest.raises(LinkError, match="parts"):
        robot.get("larger", larger)
    with pytest.raises(LinkError, match="parts"):
        server.publish("a", larger)


def test_silence_is_an_error(pair: tuple[Bus, Bus]) -> None:
    with pytest.raises(UnreachableError, match=r"no reply for nothing/here"):
        pair[1].get("nothing/here", timeout_s=0.2)


def test_a_slow_answer_is_silence_not_a_refusal() -> None:
    done = threading.Event()
    with Bus("tcp/127.0.0.1:0", is_server=True).open() as server, Bus(server.endpoint).open() as robot:
        server.queryable("slow", lambda *_: b"late" if done.wait(20) else b"")
        with pytest.raises(UnreachableError):
            robot.get("slow", timeout_s=0.3)
        done.set()
        assert robot.get("slow") == b"late"


def test_a_server_that_is_behind_answers_the_last_of_equal_questions() -> None:
    go, asked = threading.Event(), list[bytes]()

    def answer(_: str, payload: bytes) -> bytes:
        asked.append(payload)
        return payload if go.wait(20) else b""

    key = "fleetmap/s/robots/r/failures"
    with Bus("tcp/127.0.0.1:0", is_server=True).open() as server, Bus(server.endpoint).open() as robot:
        server.queryable(key, answer)
        assert eventually(robot.connected)
        for payload in (b"first", b"again", b"again", b"again", b"other"):
            with pytest.raises(UnreachableError):
                robot.get(key, payload, timeout_s=0.5)
        go.set()
        assert robot.get(key, b"again") == b"again"
        assert eventually(lambda: asked[:3] == [b"first", b"again", b"other"])
        assert asked.count(b"again") <= 2, "of four"


def test_who_connects_hears_bursts_and_images_whole() -> None:
    """As cameras publish them: a server alone drops what floods it."""
    with Bus("tcp/127.0.0.1:0", is_server=True).open() as server, Bus(server.endpoint).open() as robot:
        heard: dict[str, list[int]] = {"server": [], "robot": []}
        server.subscribe("fleetmap/s/robots/r/health", lambda _, payload: heard["server"].append(len(payload)))
        robot.subscribe("image", lambda _, payload: heard["robot"].append(len(payload)))
        assert eventually(robot.connected)
        # What the sender drops, because the machine is busy, says nothing of who hears.
        image, control = bytes(3_000_000), zenoh.CongestionControl.BLOCK

        def put(bus: Bus, key: str, payload: bytes) -> None:
            bus._session.put(key, payload, congestion_control=control)

        assert eventually(lambda: put(server, "image", b"") or bool(heard["robot"]))
        heard["robot"].clear()
        for _ in range(100):
            put(server, "image", image)
        put(robot, "fleetmap/s/robots/r/health", image)
        put(robot, "fleetmap/s/robots/r/health", b"small")
        assert eventually(lambda: len(heard["robot"]) >= 100 and len(heard["server"]) >= 1, 30.0)
        assert set(heard["robot"][-100:]) == {len(image)}
        assert heard["server"] == [5]


def test_publications_reach_matching_subscribers(pair: tuple[Bus, Bus], caplog: pytest.LogCaptureFixture) -> None:
    server, robot = pair
    heard: list[tuple[str, bytes]] = []
    robot.subscribe("a/*/c", lambda key, payload: heard.append((key, payload)))
    robot.subscribe("a/b/c", Mock(side_effect=ValueError))
    assert eventually(lambda: server.publish("a/b/c", b"1") or bool(heard))
    assert heard[0] == ("a/b/c", b"1")
    server.publish("a/b/other", b"2", may_drop=True)
    assert all(key == "a/b/c" for key, _ in heard)
    assert eventually(lambda: "subscriber for 'a/b/c' failed" in caplog.text)


def test_presence_ends_with_its_handle(pair: tuple[Bus, Bus]) -> None:
    server, robot = pair
    robot.declare_alive("robots/r1/alive")
    second = robot.declare_alive("robots/r2/alive")
    assert eventually(lambda: server.alive("robots/*/alive") == ["robots/r1/alive", "robots/r2/alive"])
    second.close()
    second.close()
    assert eventually(lambda: server.alive("robots/*/alive") == ["robots/r1/alive"])
    robot.close()
    assert eventually(lambda: server.alive("robots/*/alive") == [])


def test_a_closed_handle_answers_no_more(pair: tuple[Bus, Bus]) -> None:
    server, robot = pair
    handle = server.queryable("x", lambda *_: b"y")
    assert robot.get("x") == b"y"
    handle.close()
    with pytest.raises(UnreachableError):
        robot.get("x", timeout_s=0.2)
    server.close()
    with pytest.raises(LinkError, match="closed"):
        server.queryable("x", lambda *_: b"y")


def test_a_robot_survives_the_absence_of_its_server() -> None:
    server = Bus("tcp/127.0.0.1:0", is_server=True).open()
    endpoint = server.endpoint
    server.close()
    with Bus(endpoint).open() as robot:
        robot.publish("lost", b"")
        with pytest.raises(UnreachableError):
            robot.get("x", timeout_s=0.2)
        for _ in range(2):
            with Bus(endpoint, is_server=True).open() as back:
                back.queryable("x", lambda *_: b"back")
                assert robot.get("x", timeout_s=20) == b"back"


def test_silent_connections_do_not_shut_out_robots() -> None:
    """More than zenoh lets wait for their sessions by default."""
    with Bus("tcp/127.0.0.1:0", is_server=True).open() as server, ExitStack() as stack:
        server.queryable("key", lambda *_: b"answer")
        port = int(server.endpoint.rpartition(":")[2])
        for _ in range(150):
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
        with Bus(server.endpoint).open() as robot:
            assert robot.get("key") == b"answer"


def test_the_server_stays_on_its_own_endpoint() -> None:
    with Bus("tcp/127.0.0.1:0", is_server=True).open() as server:
        with pytest.raises(LinkError, match="another server"):
            Bus(server.endpoint, is_server=True).open()
        with Bus("tcp/127.0.0.1:0", is_server=True).open() as other:
            other.queryable("x", lambda *_: b"not yours")
            with Bus(server.endpoint).open() as robot, pytest.raises(UnreachableError):
                # Nothing is found by multicast or gossip: servers on one network don't see each other's robots.
                robot.get("x", timeout_s=0.5)


def test_threads_end_with_the_bus() -> None:
    before = threading.active_count()
    with Bus("tcp/127.0.0.1:0", is_server=True).open() as server:
        server.subscribe("a", lambda *_: None)
        server.queryable("b", lambda *_: b"")
    assert eventually(lambda: threading.active_count() <= before)


@pytest.mark.parametrize(
    "endpoint", ["", "127.0.0.1:7447", "tcp/127.0.0.1", "tcp/:7447", "http/127.0.0.1:80", "tcp/a:99999"]
)
def test_wrong_endpoints_are_usage_errors(endpoint: str) -> None:
    with pytest.raises(UsageError, match="endpoint"):
        check_endpoint(endpoint)


def test_presence_of_more_than_a_channel_usually_holds() -> None:
    with Bus("tcp/127.0.0.1:0", is_server=True).open() as server, Bus(server.endpoint).open() as robots:
        keys = [f"fleetmap/lab/robots/r{n}/alive" for n in range(700)]
        for key in keys:
            robots.declare_alive(key)
        assert eventually(lambda: server.alive("fleetmap/*/robots/*/alive") == sorted(keys), 20)
