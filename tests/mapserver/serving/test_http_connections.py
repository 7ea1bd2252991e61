"""Strangers at the door of HTTP, by sockets that state what no client library would; a robot is served meanwhile."""

import asyncio
import resource
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from websockets.sync.client import connect

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.messages import RobotHealth, encode_message, robot_key
from mapserver.operators.operators import Operators
from mapserver.serving import http_connections as module
from mapserver.serving.http_connections import BoundedListener
from mapserver.store import Actor, MapStore
from mapserver.trust.authorities import Authorities
from support.fleet.dashboard_scene import serving
from support.storage.map_samples import save_sample_draft
from support.waiting import eventually

GET = b"GET /%s HTTP/1.1\r\nHost: localhost\r\n%s\r\n"
POST = b"POST /sign-in HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n%s"
LARGE = 30_000_000


async def application(scope: dict[str, Any], receive: Callable[[], Any], send: Callable[[Any], Any]) -> None:
    if scope["type"] == "lifespan":
        return
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.accept"})
        await asyncio.sleep(2 * module.HEAD_S)
        await send({"type": "websocket.send", "text": "still there"})
        return
    if scope["path"] == "/slow":
        await asyncio.sleep(2 * module.HEAD_S)
    body = b"x" * (LARGE if scope["path"] == "/large" else 1)
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"%d" % len(body))]})
    await send({"type": "http.response.body", "body": body})


class Door:
    """An HTTP server behind a bounded listener, on a thread."""

    def __init__(self, listener: BoundedListener, **tls: Any) -> None:
        self.listener, self.port = listener, listener.getsockname()[1]
        quiet = {"log_config": None, "log_level": "error", "lifespan": "off"}
        self.server = uvicorn.Server(uvicorn.Config(application, http="h11", loop="asyncio", **quiet, **tls))
        self.thread = threading.Thread(target=lambda: asyncio.run(self._run()))
        self.thread.start()

    async def _run(self) -> None:
        watch = asyncio.create_task(self.listener.watch(self.server.server_state.connections))
        await self.server.serve(sockets=[self.listener])
        watch.cancel()

    def connect(self, data: bytes = b"", source: str = "127.0.0.1") -> socket.socket:
        return joined(self.port, data, source)


def joined(port: int, data: bytes = b"", source: str = "127.0.0.1") -> socket.socket:
    made = socket.create_connection(("127.0.0.1", port), 10, source_address=(source, 0))
    made.sendall(data)
    return made


def is_ended(connection: socket.socket) -> bool:
    """Whether the server ends a connection, after whatever it answers."""
    try:
        while connection.recv(1 << 16):
            pass
    except TimeoutError:
        return False
    except ConnectionError:
        pass
    return True


def answers(one: socket.socket) -> bool:
    try:
        one.sendall(GET % (b"", b""))
        return one.recv(1) == b"H"
    except ConnectionError:
        return False


def is_answered(door: Door, source: str) -> bool:
    with door.connect(source=source) as one:
        return answers(one)


@contextmanager
def a_door(*, is_behind_proxy: bool = False, **tls: Any) -> Iterator[Door]:
    listener = BoundedListener(socket.AF_INET, frozenset({"127.0.0.1"}) if is_behind_proxy else frozenset())
    listener.bind(("127.0.0.1", 0))
    listener.listen(module.BACKLOG)
    door = Door(listener, **tls)
    try:
        yield door
    finally:
        door.server.should_exit = door.server.force_exit = True
        door.thread.join(20)


@pytest.fixture
def quick(monkeypatch) -> None:
    for name, value in (("HEAD_S", 0.4), ("_TAKEN_S", 0.4), ("_LOOK_EVERY_S", 0.05)):
        monkeypatch.setattr(module, name, value)


@pytest.mark.usefixtures("quick")
def test_who_makes_no_progress_is_ended_and_who_does_is_not(tmp_path: Path) -> None:
    authorities = Authorities(tmp_path, datetime.now(UTC))
    authorities.init(["127.0.0.1"], None, None)
    with a_door() as door, a_door(ssl_certfile=authorities.tls.own) as secure, ExitStack() as open_ones:
        strangers = {
            "nothing comes": door.connect(),
            "a head that goes on": door.connect(b"GET / HTTP/1.1\r\n"),
            "a body that nobody reads": door.connect(GET % (b"", b"Content-Length: 9\r\n")),
            "kept alive": door.connect(GET % (b"", b"")),
            "nothing of the answer is taken": door.connect(GET % (b"large", b"")),
            "no handshake": secure.connect(),
            "half a handshake": secure.connect(b"\x16\x03\x01\x02\x00\x01"),
        }
        for one in strangers.values():
            open_ones.enter_context(one)
        slow = open_ones.enter_context(door.connect(GET % (b"slow", b"")))
        page = open_ones.enter_context(connect(f"ws://127.0.0.1:{door.port}/"))
        began_s = time.monotonic()
        drip = strangers["a head that goes on"]
        with pytest.raises(ConnectionError):
            while time.monotonic() < began_s + 10:
                drip.sendall(b"X: y\r\n")
                time.sleep(0.05)
        kept = {name for name, one in strangers.items() if one is not drip and not is_ended(one)}
        assert kept == set()
        assert slow.recv(12) == b"HTTP/1.1 200"
        assert page.recv(timeout=10) == "still there"
        context = ssl.create_default_context(cadata=authorities.servers)
        with context.wrap_socket(secure.connect(b""), server_hostname="127.0.0.1") as one:
            one.sendall(GET % (b"", b""))
            assert one.recv(12) == b"HTTP/1.1 200"


def test_a_large_answer_may_take_longer_than_a_head(monkeypatch) -> None:
    monkeypatch.setattr(module, "_LOOK_EVERY_S", 0.05)
    monkeypatch.setattr(module, "HEAD_S", 0.2)
    with a_door() as door, door.connect(GET % (b"large", b"")) as robot:
        taken = 0
        while taken < LARGE and (data := robot.recv(1 << 20)):
            taken += len(data)
            time.sleep(0.02)
        assert taken > LARGE


@pytest.mark.parametrize("is_behind_proxy", [False, True])
def test_connections_are_shared_among_addresses(monkeypatch, is_behind_proxy: bool) -> None:
    monkeypatch.setattr(module, "MAX_OF_ADDRESS", 4)
    monkeypatch.setattr(module, "MAX_CONNECTIONS", 8)
    with a_door(is_behind_proxy=is_behind_proxy) as door, ExitStack() as stack:

        def take(source: str, count: int) -> list[bool]:
            """Which of some new connections are answered; they stay open."""
            made = [stack.enter_context(door.connect(source=source)) for _ in range(count)]
            return [answers(one) for one in made]

        many = take("127.0.0.1", 6)
        if is_behind_proxy:
            assert many == [True] * 6, "all of them are the proxy's, and whoever is behind it has no limit of its own"
            return
        assert sum(many) == 4
        assert take("127.0.0.2", 4) == [True] * 4
        # All are taken: another address gets a place of who has most, but not more than these.
        assert take("127.0.0.3", 3) == [True, True, False]
        stack.close()
        # Closed ones do not count, as soon as the server notices.
        assert eventually(lambda: all(take("127.0.0.4", 4)) or stack.close())


def test_files_are_kept_for_the_store_and_the_bus(monkeypatch) -> None:
    monkeypatch.setattr(module, "MAX_OF_ADDRESS", 10_000)
    with a_door() as door:
        assert is_answered(door, "127.0.0.1")
        top = max(int(file.name) for file in Path("/proc/self/fd").iterdir()) + 8  # lower numbers may be free, too
        monkeypatch.setattr(resource, "getrlimit", lambda _: (top * 4 // 3, top * 4 // 3))
        with ExitStack() as stack:
            for _ in range(top // 2 + 1):  # two files each
                last = stack.enter_context(door.connect(source="127.0.0.2"))
            assert is_ended(last)
        assert eventually(lambda: is_answered(door, "127.0.0.3")), "it goes on, as soon as the server notices"


def test_a_robot_is_served_while_strangers_do_their_worst(tmp_path: Path) -> None:
    with MapStore.open(tmp_path, create=True) as store:
        save_sample_draft(store)
        Operators(store).add("ada", "admin", "ada has a long password", Actor("root"))
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (1024, hard))
    try:
        with serving(tmp_path) as served, Bus(served.zenoh).open() as robot, ExitStack() as stack:
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
            port, number = int(served.http.rpartition(":")[2]), 0

            def look() -> None:
                nonlocal number
                number += 1
                robot.get(robot_key("lab", "r1", "wanted"), timeout_s=2)
                health = RobotHealth(site="lab", robot="r1", stamp_ns=number, version=1, status="TRACKING")
                robot.publish(robot_key("lab", "r1", "health"), encode_message(health))
                with joined(port, GET % (b"readyz", b""), "127.0.0.99") as probe:
                    assert probe.recv(12) == b"HTTP/1.1 200"

            look()
            for count in range(1100):
                stack.enter_context(joined(port, source=f"127.0.0.{1 + count % 20}"))
            look()
            with joined(port, b"GET / HTTP/1.1\r\nHost: localhost\r\n") as endless, pytest.raises(ConnectionError):
                for _ in range(2000):
                    endless.sendall(b"X: " + b"a" * 10_000 + b"\r\n")
            look()
            large = [stack.enter_context(joined(port, source="127.0.1.1")) for _ in range(18)]
            for one in large:
                one.sendall(POST % (1 << 20, b"name=ada&password="))
            assert {one.recv(12) for one in large} == {b"HTTP/1.1 413"}
            for _ in range(100):
                joined(port, POST % (1000, b"name=ada"), "127.0.1.2").close()
            with joined(port, b"GET /" + b"a" * 20_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n", "127.0.1.3") as long:
                assert long.recv(12) in {b"HTTP/1.1 431", b"HTTP/1.1 400"}
            with joined(port, GET.replace(b" /", b" http://localhost/") % (b"healthz", b""), "127.0.1.3") as absolute:
                assert absolute.recv(12) == b"HTTP/1.1 200"
            look()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert len(served.log) <= 10, served.log
    with MapStore.open(tmp_path) as store:
        assert [info.last_report["health"]["stamp_ns"] for info in store.robots()] == [number]
