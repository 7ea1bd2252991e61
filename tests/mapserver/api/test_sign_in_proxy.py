"""People whom a proxy has signed in: its headers count from its address alone, for every request."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from fastapi.testclient import TestClient
from starlette.types import ASGIApp
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from fleetmap.errors import UsageError
from mapserver.api.app import create_app
from mapserver.api.guard import GuardSettings
from mapserver.api.parameters import ApiSettings
from mapserver.api.sign_in_proxy import PAGE_S, ProxiedPeople, SignInProxy
from mapserver.commands.serve import HttpOptions
from mapserver.operators.operators import Operators
from mapserver.store import Actor, MapStore
from support.fleet.dashboard_scene import fill_store, serving
from support.fleet.served_api import Server, check_problem

PROXY, GROUPS = "10.0.0.5", ("map-people=operator", "map-admins=admin", "everybody=viewer")
ADA = {"X-Forwarded-User": "ada@example.com", "X-Forwarded-Groups": "everybody,map-people"}
PUBLISH = "/v1/sites/lab/versions/2/publish"
ACT = {"reason": "monday"}


@contextmanager
def asking(server: Server, address: str, later_s: float = 0.0) -> Iterator[TestClient]:
    """A client at an address, of a server as `serve` makes it. later_s: passes between the proxy's word and the question."""
    proxy = SignInProxy.of([PROXY], GROUPS)
    late = proxy._replace(clock_s=lambda: time.monotonic() + later_s)
    guard = GuardSettings(operators=Operators(server.store), must_sign_in=True, proxy=late)
    app = create_app(server.store, server.fleet, ApiSettings(guard))
    inner: ASGIApp = ProxyHeadersMiddleware(app, [PROXY])  # type: ignore[arg-type,assignment]
    people = ProxiedPeople(inner, proxy)
    with TestClient(people, "http://127.0.0.1", client=(address, 50000), follow_redirects=False) as client:
        yield client


def test_the_proxy_says_who_asks_and_the_log_has_it(server: Server) -> None:
    with asking(server, PROXY) as client:
        headers = ADA | {"X-Forwarded-For": "192.0.2.7"}
        assert client.get("/v1/sites", headers=headers).status_code == 200
        assert client.post(PUBLISH, json=ACT, headers=headers).status_code == 200
        check_problem(client.get("/v1/sites"), 401, "sign in")
    last = next(line for line in server.store.log() if line.kind == "published")
    assert (last.operator, last.actor, last.address) == ("proxy:ada@example.com", "proxy:ada@example.com", "192.0.2.7")


def test_nobody_else_does(server: Server) -> None:
    for address, tried in {
        "10.0.0.6": [ADA, ADA | {"X-Forwarded-For": PROXY}],
        "127.0.0.1": [ADA],
        "testclient": [ADA],
        PROXY: [
            *(ADA | {"X-Forwarded-User": name} for name in ("ada\tadmin", "<img src=x>", "x" * 129, "")),
            {"X-Forwarded-Groups": "map-admins"},
            [*ADA.items(), ("X-Forwarded-User", "root")],
        ],
    }.items():
        with asking(server, address) as client:
            for headers in tried:
                check_problem(client.get("/v1/sites", headers=headers), 401, "sign in")
                check_problem(client.post(PUBLISH, json=ACT, headers=headers), 401, "sign in")


def test_groups_give_the_role(server: Server) -> None:
    with asking(server, PROXY) as client:
        for groups, reads, changes in (
            ("everybody", 200, 403),
            ("others", 403, 403),
            ("", 403, 403),
            (None, 403, 403),
            ("map-admins, everybody", 200, 200),
        ):
            headers = {"X-Forwarded-User": "bea"} | ({} if groups is None else {"X-Forwarded-Groups": groups})
            answer, changed = client.get("/v1/sites", headers=headers), client.post(PUBLISH, json=ACT, headers=headers)
            assert (answer.status_code, changed.status_code) == (reads, changes), groups
            assert reads == 200 or "none of the groups of proxy:bea has a role" in answer.json()["detail"]


def test_tokens_pass_and_no_local_operator_is_meant(server: Server) -> None:
    Operators(server.store).add("ada", "admin", "a password of the test", Actor("root"))
    token = Operators(server.store).make_token("prometheus", ["read"], 1, Actor("root"))
    with asking(server, PROXY) as client:
        assert client.get("/v1/sites", headers={"Authorization": f"Bearer {token}"}).status_code == 200
        headers = {"X-Forwarded-User": "ada", "X-Forwarded-Groups": "everybody"}
        check_problem(client.post(PUBLISH, json=ACT, headers=headers), 403, "proxy:ada (viewer)")


def test_an_open_page_is_asked_again_after_an_hour(server: Server) -> None:
    with asking(server, PROXY, later_s=PAGE_S + 1) as client:
        assert client.get("/v1/sites", headers=ADA).status_code == 403


@pytest.mark.parametrize(
    ("addresses", "groups", "words"),
    [
        (["proxy.example"], GROUPS, "write the proxy's address like 127.0.0.1"),
        (["10.0.0.0/8"], GROUPS, "10.0.0.0/8"),
        ([PROXY], ["map-people=boss"], "one of viewer, operator, admin"),
        ([PROXY], ["a=viewer", "a=admin"], "'a' twice"),
        ([PROXY], [], "needs --sign-in-group"),
        ([], GROUPS, "belongs to --sign-in-proxy"),
    ],
)
def test_options_that_cannot_be_right(addresses: list[str], groups: list[str], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        HttpOptions(sign_in_proxy=addresses, sign_in_group=list(groups)).load_proxy()


def test_serve_believes_the_named_address_alone(tmp_path: Path) -> None:
    fill_store(tmp_path)
    options = ("--sign-in-proxy", "127.0.0.2", "--sign-in-group", "map-people=operator", "--http-name", "maps.example")
    with serving(tmp_path, *options) as served:
        found = {}
        for address in ("127.0.0.1", "127.0.0.2"):
            with httpx.Client(transport=httpx.HTTPTransport(local_address=address), headers=ADA, timeout=60) as client:
                headers = {"Host": "maps.example", "X-Forwarded-For": "127.0.0.2", "X-Forwarded-Proto": "https"}
                found[address] = client.get(f"{served.http}/v1/sites", headers=headers).status_code
                page = client.get(f"{served.http}/dashboard/", headers=headers | {"Accept": "text/html"})
                assert ("proxy:ada@example.com (operator)" in page.text) == (address == "127.0.0.2")
        assert found == {"127.0.0.1": 401, "127.0.0.2": 200}
    with MapStore.open(tmp_path) as store:
        assert not store.operators.are_there(), "the proxy's people are nobody of the store"
