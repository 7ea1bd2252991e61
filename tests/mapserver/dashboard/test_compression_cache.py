"""Files of the page library are found and compressed once; everything else is asked for every time."""

import gzip
from collections import Counter

import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.testclient import TestClient

from mapserver.dashboard.compression_cache import CompressionCache

TEXT = "quasar " * 1000
asked: Counter[str] = Counter()


def _answer(request: Request) -> Response:
    asked[request.url.path] += 1
    if request.url.path.endswith("missing.js"):
        return PlainTextResponse("no such file", 404)
    return PlainTextResponse(f"{TEXT}{request.url.query}", headers={"ETag": '"x"'})


@pytest.fixture
def client() -> TestClient:
    asked.clear()
    inner = Starlette(routes=[Route("/{path:path}", _answer)])
    return TestClient(CompressionCache(inner))


def test_a_file_is_asked_for_once_and_is_the_same_for_all(client: TestClient) -> None:
    answers = [client.get("/_nicegui/3/static/quasar.js") for _ in range(3)]
    assert asked["/_nicegui/3/static/quasar.js"] == 1
    assert {answer.text for answer in answers} == {TEXT}
    assert all(answer.headers["content-encoding"] == "gzip" for answer in answers)
    assert all(answer.headers["etag"] == '"x"' for answer in answers)
    plain = client.get("/_nicegui/3/static/quasar.js", headers={"Accept-Encoding": "identity"})
    assert plain.text == TEXT
    assert "content-encoding" not in plain.headers
    assert client.get("/_nicegui/3/static/quasar.js?v=2").text == f"{TEXT}v=2"


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/dashboard/", {}),
        ("/_nicegui/3/dynamic_resources/x.js", {}),
        ("/_nicegui/3/static/missing.js", {}),
        ("/_nicegui/3/static/quasar.js", {"Range": "bytes=0-5"}),
        ("/_nicegui/3/static/quasar.js", {"If-None-Match": '"x"'}),
    ],
)
def test_what_may_change_is_asked_for_every_time(client: TestClient, path: str, headers: dict[str, str]) -> None:
    for _ in range(2):
        client.get(path, headers=headers)
    assert asked[path] == 2


def test_memory_is_bounded(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mapserver.dashboard.compression_cache._MAX_BYTES", len(gzip.compress(TEXT.encode())) // 2)
    for _ in range(2):
        client.get("/_nicegui/3/static/quasar.js")
    assert asked["/_nicegui/3/static/quasar.js"] == 2
