"""The guard: pages from elsewhere, other names, and requests without a name; rows 18, 19, 20 and 24 of docs/security.md.

Each attack also runs against the same application without the guard, where it works.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import Mock

import anyio
import pytest
from fastapi.testclient import TestClient
from starlette.responses import Response
from starlette.websockets import WebSocket, WebSocketDisconnect

from fleetmap.errors import StoreError
from mapserver.api import request_limits
from mapserver.api.app import create_app
from mapserver.api.guard import Guard, GuardSettings, set_session
from mapserver.api.parameters import ApiSettings
from mapserver.dashboard.install import install_sign_in
from mapserver.operators.operators import IDLE_S, Operators
from mapserver.store import Actor
from support.fleet.served_api import Server, check_problem, named, raw
from support.storage.map_samples import save_sample_draft

PASSWORD = "a password of the test"
EVIL = "http://evil.example"
ACT = {"actor": "ada", "reason": "monday"}
PUBLISH = "/v1/sites/lab/versions/2/publish"


@contextmanager
def client_of(server: Server, *, is_guarded: bool = True, **settings: object) -> Iterator[TestClient]:
    """A client of an application with these settings of the guard, or without it."""
    guard = GuardSettings(operators=Operators(server.store), **settings)
    app = create_app(server.store, server.fleet, ApiSettings(guard))

    @app.websocket("/socket")
    async def socket(websocket: WebSocket) -> None:
        await websocket.accept()
        await websocket.send_text("in")

    if not is_guarded:
        app.user_middleware = [layer for layer in app.user_middleware if layer.cls is not Guard]
    with TestClient(app, "http://127.0.0.1", raise_server_exceptions=False, follow_redirects=False) as client:
        yield client


ELSEWHERE = (
    {"Origin": EVIL},
    {"Origin": EVIL, "Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site"},
    {"Origin": "null"},
    {"Origin": "http://127.0.0.1:9999"},
    {"Origin": "http://127.0.0.1.evil.example"},
    {"Origin": "http://[::1", "Sec-Fetch-Site": "none"},
)


def test_a_page_from_elsewhere_changes_nothing(server: Server) -> None:
    """Row 18."""
    with client_of(server) as client:
        for headers in ELSEWHERE:
            check_problem(client.post(PUBLISH, json=ACT, headers=headers), 403, "a page of another origin")
            assert server.store.current("lab").version == 1
            assert client.get("/v1/sites", headers=headers).status_code == 200, "its browser keeps it from the page"
        form = client.post(PUBLISH, content=b"actor=ada", headers={"Content-Type": "text/plain"})
        assert form.status_code == 422
    with client_of(server, is_guarded=False) as client:
        for number, headers in enumerate(ELSEWHERE, start=2):
            publish = f"/v1/sites/lab/versions/{number}/publish"
            assert client.post(publish, json=ACT, headers=headers).status_code == 200, headers
            save_sample_draft(server.store, seed=number + 1)


@pytest.mark.parametrize("asked", ["are_there", "session"])
def test_a_store_that_does_not_answer_lets_nobody_in(server: Server, monkeypatch, asked: str) -> None:
    away = Mock(side_effect=StoreError("postgresql://db.example/site_a cannot be read"))
    vic = named(server)["vic"] if asked == "session" else {}
    monkeypatch.setattr(type(server.store.operators), asked, away)
    with client_of(server) as client:
        answer = client.get("/v1/sites", headers=vic)
        check_problem(answer, 503, "the store does not answer")
        assert "db.example" not in answer.text
        assert client.get("/healthz").status_code == 200


@pytest.mark.parametrize("headers", [{}, {"Origin": "http://127.0.0.1", "Sec-Fetch-Site": "same-origin"}])
def test_programs_and_the_pages_themselves_do(server: Server, headers: dict[str, str]) -> None:
    with client_of(server) as client:
        assert client.post(PUBLISH, json=ACT, headers=headers).status_code == 200
        assert server.store.log(site="lab", limit=1)[0].actor == "ada"
        check_problem(client.post("/v1/sites/lab/rollback", json={}, headers=headers), 422, "name the person who acts")


def paths_of(client: TestClient) -> list[tuple[str, str]]:
    """Every method and path of the document, with something in the place of parameters."""
    values = dict.fromkeys(("version", "before", "after", "job", "number", "place"), "1")
    values |= {"site": "lab", "sha256": "5e" * 32, "robot": "r1", "operator": "olga", "token": "00000000"}
    values |= {"asked": "00000000", "box": "held", "name": "monday.mcap"}
    paths = client.app.openapi()["paths"].items()
    return [(method.upper(), path.format(**values)) for path, operations in paths for method in operations]


def test_under_another_name_nothing_answers(server: Server) -> None:
    """Row 19: a page from elsewhere whose name leads here."""
    hosts = ("evil.example", "evil.example:8080", "127.0.0.1.evil.example", "", "[::1", "a b")
    with client_of(server) as client, client_of(server, is_guarded=False) as unguarded:
        for host in hosts:
            for method, path in paths_of(client):
                check_problem(client.request(method, path, headers={"Host": host}), 403, "unknown host name")
            assert unguarded.get("/v1/robots", headers={"Host": host}).status_code == 200


def test_names_that_are_ours(server: Server) -> None:
    with client_of(server, names=frozenset({"maps.example"})) as client:
        ours = ("maps.example", "MAPS.example:8443", "maps.example.")
        for host in (*ours, "localhost", "127.0.0.1", "[::1]:80", "10.0.0.7:8080"):
            assert client.get("/v1/sites", headers={"Host": host}).status_code == 200, host


def test_without_a_name_nothing_answers(server: Server) -> None:
    """Row 24."""
    with client_of(server) as client:
        assert client.get("/v1/robots").status_code == 200, "the control: nobody is named yet"
        sessions = named(server)
        paths = paths_of(client)
        assert len(paths) > 20
    with client_of(server) as client:
        assert client.post("/sign-out", headers={"Origin": EVIL}).status_code == 403
        pages = [("GET", path) for path in ("/openapi.json", "/dashboard/", "/")]
        for method, path in [*paths, *pages, ("POST", "/anything")]:
            if path in ("/healthz", "/readyz"):
                assert client.request(method, path).status_code == 200
                continue
            for headers in ({}, {"Cookie": "fleetmap=guess"}, {"Authorization": "Bearer guess"}):
                answer = client.request(method, path, headers=headers)
                check_problem(answer, 401, "sign in")
                assert answer.headers["www-authenticate"] == "Bearer"
            may = client.request(method, path, headers=sessions["ada"]).status_code not in (401, 403)
            assert may, path
            if method != "GET" and path.startswith("/v1/"):
                assert client.request(method, path, headers=sessions["vic"]).status_code == 403, "who may only look"
        led = client.get("/dashboard/map?site=lab", headers={"Accept": "text/html"})
        assert led.headers["location"] == "/sign-in?next=%2Fdashboard%2Fmap%3Fsite%3Dlab"
    with client_of(server, is_guarded=False) as client:
        assert client.get("/v1/robots").status_code == 200


@pytest.mark.parametrize(
    ("name", "reads", "sees_metrics", "changes"),
    [("vic", 200, 403, 403), ("olga", 200, 200, 200), ("ada", 200, 200, 200)],
)
def test_each_role_may_what_it_may(server: Server, name: str, reads: int, sees_metrics: int, changes: int) -> None:
    headers = named(server)[name]
    with client_of(server) as client:
        assert client.get("/v1/sites", headers=headers).status_code == reads
        assert client.get("/metrics", headers=headers).status_code == sees_metrics
        assert client.post(PUBLISH, json={"reason": "monday"}, headers=headers).status_code == changes
        last = server.store.log()[0]
        expected = ("published", name, name) if changes == 200 else ("refused", name, name)
        assert (last.kind, last.actor, last.operator, last.address) == (*expected, "testclient")
        forged = client.post("/v1/sites/lab/rollback", json={"actor": "bob"}, headers=headers)
        check_problem(forged, 403, "")
        assert [event for event in server.store.events("lab") if event.actor == "bob"] == []


def test_an_open_page_keeps_no_session_from_ending(server: Server, monkeypatch) -> None:
    headers, now_s = named(server)["vic"], time.time()
    monkeypatch.setattr(server.store, "now_ns", lambda: int(now_s * 1e9))
    with client_of(server) as client:
        for by_itself in ({"Fleetmap-Renewal": "1"}, {"Accept": "text/event-stream"}):
            assert client.get("/v1/sites", headers=headers).status_code == 200
            now_s += IDLE_S - 60
            assert client.get("/v1/sites", headers=headers | by_itself).status_code == 200
            now_s += 30
        now_s += 60
        assert client.get("/v1/sites", headers=headers).status_code == 401


def test_a_server_that_must_ask_does_without_anybody_named(server: Server) -> None:
    with client_of(server, must_sign_in=True) as client:
        assert client.get("/v1/sites").status_code == 401


def test_no_socket_opens(server: Server) -> None:
    """Row 20: the pages need none."""
    with client_of(server) as client, pytest.raises(WebSocketDisconnect), client.websocket_connect("/socket"):
        pass
    with client_of(server, is_guarded=False) as client, client.websocket_connect("/socket") as socket:
        assert socket.receive_text() == "in"


def test_every_answer_has_the_headers(server: Server) -> None:
    with client_of(server) as client:
        for path in ("/v1/sites", "/nothing", "/v1/sites/lab/versions/x"):
            headers = client.get(path).headers
            assert headers["x-content-type-options"] == "nosniff"
            assert headers["x-frame-options"] == "DENY"
            assert headers["referrer-policy"] == headers["cross-origin-opener-policy"] == "same-origin"
            policy = headers["content-security-policy"]
            assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self';")
            assert "unsafe" not in policy
            assert "strict-transport-security" not in headers
        assert client.get(f"/v1/tiles/{server.tile}").headers["cache-control"].startswith("public")
    session = named(server)["vic"]
    with client_of(server) as client:
        assert client.get(f"/v1/tiles/{server.tile}", headers=session).headers["cache-control"].startswith("private")


def test_the_cookie_is_for_this_host_and_tls_where_there_is_some() -> None:
    for scheme, words in (
        ("https", "__Host-fleetmap=s3cret; HttpOnly; Max-Age=43200; Path=/; SameSite=strict; Secure"),
        ("http", "fleetmap=s3cret; HttpOnly; Max-Age=43200; Path=/; SameSite=strict"),
    ):
        response = Response()
        set_session(response, {"type": "http", "scheme": scheme}, "s3cret")
        assert response.headers["set-cookie"] == words


def test_a_slow_or_large_sign_in_is_refused_and_one_that_leaves_is_no_error(
    server: Server, monkeypatch, caplog
) -> None:
    monkeypatch.setattr(request_limits, "SIGN_IN_S", 0.1)
    monkeypatch.setattr(request_limits, "LINGER_S", 0.1)
    form, scope = (
        [(b"content-type", b"application/x-www-form-urlencoded")],
        {"method": "POST", "path": "/sign-in", "query_string": b""},
    )
    part = {"type": "http.request", "body": b"x" * 3000, "more_body": True}
    with client_of(server) as client:
        Operators(server.store).add("ada", "admin", PASSWORD, Actor("root"))
        install_sign_in(client.app, GuardSettings(operators=Operators(server.store)))
        for messages, statuses in (
            ([part], [408]),
            ([part, part], [413]),
            ([part, {"type": "http.disconnect"}], []),
            ([part | {"more_body": False}], [401]),
        ):
            assert anyio.run(raw, client.app, scope, form, *messages, 20.0) == statuses
        long = [*form, *((b"cookie", b"a" * 3000) for _ in range(6))]
        assert anyio.run(raw, client.app, scope, long, part | {"more_body": False}) == [431]
    assert not [record for record in caplog.records if record.levelname == "ERROR"]
