"""The HTTP API over a small store, with a client that asks it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import anyio
import httpx
from fastapi.testclient import TestClient
from starlette.types import ASGIApp, Message

from mapserver.api.app import create_app
from mapserver.api.parameters import ApiSettings
from mapserver.fleet.fleet import Fleet
from mapserver.operators.operators import Operators
from mapserver.serving.night_runs import NightRuns
from mapserver.store import Actor, MapStore
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.storage.map_samples import publish_samples, save_sample_draft


@dataclass
class Server:
    client: TestClient
    store: MapStore
    fleet: Fleet
    bus: MemoryBus
    folder: Path

    @property
    def tile(self) -> str:
        return self.store.manifest("lab", 1).tiles[0].sha256


@contextmanager
def served_api(folder: Path, inbox: Path | None = None) -> Iterator[Server]:
    with MapStore.open(folder, create=True) as store, MemoryBus(MemoryHub()) as bus:
        publish_samples(store, 1)
        save_sample_draft(store, seed=2)
        fleet = Fleet(store)
        settings = ApiSettings(nights=None if inbox is None else NightRuns(store, inbox))
        app = create_app(store, fleet, settings, bus=bus)
        with TestClient(app, "http://127.0.0.1", raise_server_exceptions=False, client=("127.0.0.1", 9)) as client:
            yield Server(client, store, fleet, bus, folder)


def named(server: Server) -> dict[str, dict[str, str]]:
    """A session of each role, as headers."""
    operators, roles = Operators(server.store), {"vic": "viewer", "olga": "operator", "ada": "admin"}
    secrets = {name: operators.add(name, role, None, Actor("root")) for name, role in roles.items()}
    return {name: {"Cookie": f"fleetmap={operators.sign_in(name, secrets[name], name).session}"} for name in roles}


def check_problem(response: httpx.Response, status: int, words: str) -> None:
    assert response.status_code == status
    assert response.headers["content-type"] == "application/problem+json"
    body = response.json()
    assert body["status"] == status
    assert body["type"] == "about:blank"
    assert body["title"]
    assert words in body["detail"]
    assert body["instance"] == response.request.url.path


async def raw_put(
    server: Server, path: str, *messages: Message | anyio.Event | float, stated: int, query: bytes = b""
) -> list[int]:
    """As `raw`: an upload that is said to have so many bytes."""
    scope = {"method": "PUT", "path": path, "query_string": b"actor=ada" + query}
    return await raw(server.client.app, scope, [(b"content-length", b"%d" % stated)], *messages)


async def raw(
    app: ASGIApp,
    changes: dict[str, object],
    headers: list[tuple[bytes, bytes]],
    *messages: Message | anyio.Event | float,
) -> list[int]:
    """The status of a request whose client sends these and waits for events and seconds; empty if it is gone before the answer."""
    scope = {"type": "http", "raw_path": b"", "scheme": "http", "root_path": "", "client": ("127.0.0.1", 1), **changes}
    scope["headers"] = [(b"host", b"127.0.0.1"), *headers]
    left, answered = list(messages), list[int]()

    async def receive() -> Message:
        message = left.pop(0) if left else {"type": "http.disconnect"}
        if isinstance(message, anyio.Event):
            await message.wait()
            return await receive()
        if isinstance(message, float):
            await anyio.sleep(message)
            return await receive()
        return message

    async def send(message: Message) -> None:
        answered.extend([message["status"]] if message["type"] == "http.response.start" else [])

    await app(scope, receive, send)
    return answered
