"""Sign-in at an OpenID Connect provider: the good case, and what a liar, a thief or a mistake brings instead."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
from fastapi.testclient import TestClient
from joserfc import jwt
from joserfc.jwk import ECKey, OctKey
from typer.testing import CliRunner

from fleetmap.errors import UsageError
from mapserver import cli
from mapserver.api.app import create_app
from mapserver.api.guard import PROVIDER, PROVIDER_BACK, GuardSettings
from mapserver.api.metrics import Metrics
from mapserver.api.version_routes import ApiSettings
from mapserver.commands.oidc_options import OidcOptions
from mapserver.dashboard.pages import sign_in_page
from mapserver.operators import openid
from mapserver.operators.openid import Provider, ProviderSettings
from mapserver.operators.operators import Operators
from mapserver.operators.roles import Role
from mapserver.store import Actor
from support.fleet.identity_provider import CLIENT, SECRET, IdentityProvider, identity_provider
from support.fleet.served_api import Server, served_api

ROLES = {"map-people": Role.OPERATOR, "map-admins": Role.ADMIN, "everybody": Role.VIEWER}


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with served_api(tmp_path) as made:
        yield made


@pytest.fixture
def provider() -> Iterator[IdentityProvider]:
    with identity_provider() as made:
        yield made


class Clock:
    def __init__(self) -> None:
        self.s = 1000.0

    def __call__(self) -> float:
        return self.s


@contextmanager
def browser(server: Server, provider: IdentityProvider | None, **changed: object) -> Iterator[TestClient]:
    """A browser of a server that knows the provider."""
    clock = changed.pop("clock", time.monotonic)
    settings = {"client_id": CLIENT, "client_secret": SECRET, "roles": ROLES} | changed
    known = None if provider is None else Provider(ProviderSettings(issuer=provider.issuer, **settings), clock)
    guard = GuardSettings(operators=Operators(server.store), must_sign_in=True, provider=known)
    app = create_app(server.store, server.fleet, Metrics(server.store, server.fleet), None, None, ApiSettings(guard))
    sign_in_page.install(app, guard)
    with TestClient(app, "http://127.0.0.1", follow_redirects=False) as client:
        yield client


def at_provider(client: TestClient, then: str = "/dashboard/") -> str:
    """The way back that the provider gives the browser."""
    begun = client.get(PROVIDER, params={"next": then})
    assert begun.status_code == 303, begun.text
    way_back = httpx.get(begun.headers["location"]).headers["location"]
    assert way_back.startswith(f"http://127.0.0.1{PROVIDER_BACK}?")
    return way_back


def lines(server: Server) -> list[tuple[str, str, str]]:
    return [(line.kind, line.actor, line.detail) for line in server.store.audit_lines()]


def is_refused(server: Server, client: TestClient, answer: httpx.Response, status: int, words: str) -> None:
    assert answer.status_code == status, answer.text
    assert words in answer.text
    assert "Sign in at" in answer.text, "the page lets them try again"
    assert "fleetmap" not in client.cookies
    assert client.get("/v1/sites").status_code == 401
    kind, _, detail = lines(server)[-1]
    assert (kind, words in detail) == ("sign-in refused", True)


def test_who_the_provider_knows_gets_an_ordinary_session(server: Server, provider: IdentityProvider) -> None:
    with browser(server, provider) as client:
        page = client.get("/sign-in", params={"next": "/dashboard/map?site=lab"}).text
        assert f"{PROVIDER}?next=%2Fdashboard%2Fmap%3Fsite%3Dlab" in page
        begun = client.get(PROVIDER, params={"next": "/dashboard/map?site=lab&x=1"})
        mark = begun.headers["set-cookie"]
        assert mark.startswith("fleetmap-waiting=")
        assert all(word in mark for word in ("HttpOnly", "SameSite=lax", "Max-Age=600", "Path=/"))
        asked = parse_qs(urlsplit(begun.headers["location"]).query)
        assert len({asked["state"][0], asked["nonce"][0], asked["code_challenge"][0]}) == 3
        secret = client.cookies["fleetmap-waiting"]
        assert secret not in begun.headers["location"]
        way_back = httpx.get(begun.headers["location"]).headers["location"]
        answer = client.get(way_back)
        assert (answer.status_code, answer.headers["cache-control"]) == (200, "no-store")
        assert 'content="0;url=/dashboard/map?site=lab&amp;x=1"' in answer.text
        session = next(c for c in answer.headers.get_list("set-cookie") if c.startswith("fleetmap="))
        assert all(word in session for word in ("HttpOnly", "SameSite=strict"))
        assert "fleetmap-waiting" not in client.cookies
        assert client.get("/v1/sites").status_code == 200
        assert client.post("/v1/sites/lab/versions/2/publish", json={"reason": "monday"}).status_code == 200
        assert server.store.last_events("lab", 1)[0].actor == "oidc:42"
        assert lines(server)[-3][:2] == ("operator added", "oidc:42")
        signed_in = [line for line in server.store.audit_lines() if line.kind == "signed in"][-1]
        assert signed_in.reason == f"subject '42' of {provider.issuer}"
        (row,) = server.store.operators.all(0)
        assert (row.name, row.role, row.password, row.sessions) == ("oidc:42", "operator", None, 1)
        assert client.post("/sign-out").status_code == 303
        assert client.get("/v1/sites").status_code == 401
        # The provider's groups decide anew at each sign-in.
        provider.person["groups"] = ["everybody", "map-admins", "others"]
        client.get(at_provider(client))
        assert server.store.operators.find("oidc:42").role == "admin"
        assert client.get(PROVIDER, params={"next": "/v1/sites"}).headers["location"] == "/v1/sites", "already in"


def forged(claims: dict[str, object]) -> str:
    return jwt.encode({"alg": "ES256", "kid": "k1"}, claims, ECKey.generate_key("P-256"))


def by_secret(claims: dict[str, object]) -> str:
    return jwt.encode({"alg": "HS256"}, claims, OctKey.import_key(SECRET), algorithms=["HS256"])


def unsigned(claims: dict[str, object]) -> str:
    return jwt.encode({"alg": "none"}, claims, OctKey.import_key(SECRET), algorithms=["none"])


LIES: list[dict[str, object]] = [
    {"sign": forged},
    {"sign": by_secret},
    {"sign": unsigned},
    {"sign": lambda claims: None},
    {"sign": lambda claims: "no token"},
    {"sign": lambda claims: 17},
    {"spoiled": {"aud": "somebody-else"}},
    {"spoiled": {"aud": "somebody-else", "azp": CLIENT}},
    {"spoiled": {"aud": None}},
    {"spoiled": {"iss": "http://127.0.0.1:1"}},
    {"spoiled": {"iss": None}},
    {"spoiled": {"nonce": "another"}},
    {"spoiled": {"nonce": None}},
    {"spoiled": {"exp": int(time.time()) - 3600, "iat": int(time.time()) - 3700}},
    {"spoiled": {"exp": None}},
    {"spoiled": {"sub": None}},
    {"documents": {"/keys": {"keys": []}}},
    {"documents": {"/keys": "<html>down</html>"}},
]


def test_a_token_that_is_not_right_lets_nobody_in(server: Server, provider: IdentityProvider) -> None:
    with browser(server, provider) as client:
        for redeemed, lie in enumerate(LIES, 1):
            way_back = at_provider(client)
            vars(provider).update(lie)
            is_refused(server, client, client.get(way_back), 502, "is refused")
            assert provider.redeemed == redeemed
            assert not server.store.operators.are_there(), lie
            vars(provider).update(sign=None, spoiled={}, documents={})
        assert client.get(at_provider(client)).status_code == 200, "and honest again"


def test_the_way_back_of_another_browser_is_refused(server: Server, provider: IdentityProvider) -> None:
    """Login CSRF: the attacker's own way back, opened by a victim, would make the victim act as the attacker."""
    with browser(server, provider) as attacker:
        way_back = at_provider(attacker)
        stolen, attacker.cookies = dict(attacker.cookies), {}
        is_refused(server, attacker, attacker.get(way_back), 400, "not begun in this browser")
        own = at_provider(attacker)
        is_refused(server, attacker, attacker.get(way_back), 400, "not begun in this browser")
        assert provider.redeemed == 0
        assert attacker.get(own).status_code == 200, "a link from elsewhere does not end what this browser has begun"
        attacker.post("/sign-out")
        own = at_provider(attacker)
        attacker.cookies = {}
        answer = attacker.get(own.replace("state=", "state=%C3%A4"), headers={"Cookie": b"fleetmap-waiting=\xe4"})
        assert answer.status_code == 400
        attacker.cookies = stolen
        assert attacker.get(way_back).status_code == 200, "the browser that began it"


def test_a_way_back_goes_once(server: Server, provider: IdentityProvider) -> None:
    clock = Clock()
    with browser(server, provider, clock=clock) as client:
        way_back = at_provider(client)
        mark = dict(client.cookies)
        assert client.get(way_back).status_code == 200
        client.cookies = mark
        is_refused(server, client, client.get(way_back), 400, "not begun in this browser")
        # The used code under a state of this browser: the provider refuses it.
        old = parse_qs(urlsplit(way_back).query)["code"][0]
        new = parse_qs(urlsplit(at_provider(client)).query)["state"][0]
        is_refused(server, client, client.get(PROVIDER_BACK, params={"code": old, "state": new}), 502, "invalid_grant")
        # A code of somebody else's sign-in, injected: it does not fit this one's verifier.
        other = parse_qs(urlsplit(at_provider(client)).query)["code"][0]
        new = parse_qs(urlsplit(at_provider(client)).query)["state"][0]
        is_refused(
            server, client, client.get(PROVIDER_BACK, params={"code": other, "state": new}), 502, "invalid_grant"
        )
        way_back = at_provider(client)
        clock.s += openid.WAIT_S + 1
        is_refused(server, client, client.get(way_back), 400, "took too long")


def test_without_a_group_nobody_gets_in(server: Server, provider: IdentityProvider) -> None:
    with browser(server, provider) as client:
        for groups in (None, [], ["others"], "others", {"map-people": 1}, [["map-people"], 7], 3):
            provider.person["groups"] = groups
            is_refused(server, client, client.get(at_provider(client)), 403, "None of your groups")
            assert lines(server)[-1][1] == "oidc:42"
        provider.person["groups"] = "map-people"
        assert client.get(at_provider(client)).status_code == 200


NAMES = ("", "a b", "a\nb", "[red]x", "<b>", "ä", "x" * 129, "x" * 20_000, 42, None, ["42"], True)


def test_a_name_that_cannot_stand_in_the_log_is_refused(server: Server, provider: IdentityProvider) -> None:
    with browser(server, provider, name_claim="preferred_username") as client:
        for name in NAMES:
            provider.person |= {"preferred_username": name, "bulk": ["y" * 1000] * 50}
            is_refused(server, client, client.get(at_provider(client)), 403, "no name that can stand in the log")
        provider.person["bulk"] = "y" * 3_000_000
        is_refused(server, client, client.get(at_provider(client)), 502, "exceeded_size")
        assert max(len(detail) for _, _, detail in lines(server)) < 300


def test_names_of_the_provider_are_nobodys_here(server: Server, provider: IdentityProvider) -> None:
    operators, root = Operators(server.store), Actor("root")
    operators.add("ada", "admin", "a password of the test", root)
    provider.person |= {"email": "ada", "sub": "\r\nSet-Cookie: x=1"}
    with browser(server, provider, name_claim="email") as client:
        is_refused(server, client, client.get(at_provider(client)), 403, "has not verified")
        provider.person["email_verified"] = True
        client.get(at_provider(client))
        assert client.get("/v1/sites").status_code == 200
        found = {row.name: row.role for row in server.store.operators.all(0)}
        assert found == {"ada": "admin", "oidc:ada": "operator"}
        client.post("/sign-out")
        answer = client.post("/sign-in", data={"name": "oidc:ada", "password": ""})
        assert answer.status_code == 401, "there is no password"
        for words in (
            ("password", "oidc:ada"),
            ("role", "oidc:ada", "admin"),
            ("enable", "ada"),
            ("enable", "oidc:bob"),
        ):
            run = CliRunner().invoke(cli.app, ["operators", *words, "--store", str(server.folder)], obj=None)
            assert isinstance(run.exception, UsageError), (words, run.output)
        for act in (
            lambda: operators.add("oidc:ada", "admin", "a password of the test", root),
            lambda: operators.make_token("oidc:ada", ["read"], 1, root),
        ):
            with pytest.raises(UsageError, match="no operator's name"):
                act()


def test_who_is_disabled_here_stays_out(server: Server, provider: IdentityProvider) -> None:
    with browser(server, provider) as client:
        client.get(at_provider(client))
        assert client.get("/v1/sites").status_code == 200
        server.store.operators.disable("oidc:42", Actor("root"))
        assert client.get("/v1/sites").status_code == 401
        client.cookies = {}
        is_refused(server, client, client.get(at_provider(client)), 403, "oidc:42 is disabled here")
        server.store.operators.enable("oidc:42", Actor("root"))
        client.get(at_provider(client))
        session = dict(client.cookies)
    with browser(server, None) as client:
        client.cookies = session
        assert client.get("/v1/sites").status_code == 401, "without the provider nobody vouches for them"
        assert client.get(PROVIDER).status_code == 404


def test_a_provider_that_is_down_or_another(server: Server, provider: IdentityProvider) -> None:
    clock = Clock()
    right = provider.configuration()
    wrong = (
        (right | {"issuer": "https://evil.example"}, "names itself otherwise"),
        (right | {"token_endpoint": "http://evil.example/token"}, "token_endpoint is no https"),
        (right | {"jwks_uri": "file:///etc/passwd"}, "jwks_uri is no https"),
        ({"issuer": provider.issuer}, "gives no proper answer"),
        ([], "gives no proper answer"),
        ("<html>sign in to the wifi</html>", "gives no proper answer"),
    )
    with browser(server, provider, clock=clock) as client:
        for document, words in wrong:
            provider.documents["/.well-known/openid-configuration"] = document
            is_refused(server, client, client.get(PROVIDER), 502, words)
            clock.s += 6
        del provider.documents["/.well-known/openid-configuration"]
        assert client.get(at_provider(client)).status_code == 200
    with identity_provider() as gone:
        pass
    with browser(server, gone) as client:
        is_refused(server, client, client.get(PROVIDER), 502, "gives no proper answer now: ConnectError")
        assert "Name<input" in client.get("/sign-in").text, "a password still lets them in"


def test_what_the_provider_says_no_to(server: Server, provider: IdentityProvider) -> None:
    with browser(server, provider) as client:
        for error, shown in (("access_denied", "access_denied"), ("<script>\r\nX: y", "an error")):
            state = parse_qs(urlsplit(at_provider(client)).query)["state"][0]
            asked = {"error": error, "error_description": "<script>", "state": state}
            answer = client.get(PROVIDER_BACK, params=asked)
            is_refused(server, client, answer, 403, f"let nobody in: {shown}.")
            assert "<script>" not in answer.text
        answer = client.get(at_provider(client) + "&iss=https://evil.example")
        is_refused(server, client, answer, 400, "names another provider")


def test_it_leads_nowhere_else(server: Server, provider: IdentityProvider) -> None:
    with browser(server, provider) as client:
        for then in ("https://evil.example/", "//evil.example", "/\\evil.example", "/sign-out", "/\nx"):
            assert 'content="0;url=/"' in client.get(at_provider(client, then)).text
            assert client.get(PROVIDER, params={"next": then}).headers["location"] == "/"
            client.cookies = {}


def test_floods_are_bounded(server: Server, provider: IdentityProvider, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(openid, "_MOST_WAITING", 5)
    clock = Clock()
    with browser(server, provider, clock=clock) as client:
        ways = []
        for _ in range(6):
            ways.append((at_provider(client), dict(client.cookies)))
            client.cookies = {}
        for (way_back, mark), status in zip(ways, (400, *[200] * 5), strict=True):
            client.cookies = mark
            assert client.get(way_back).status_code == status
            client.cookies = {}
        statuses = [client.get(PROVIDER).status_code for _ in range(20)]
        assert statuses.count(303) == 14
        answer = client.get(PROVIDER)
        assert (answer.status_code, "Too many tries" in answer.text) == (429, True)
        clock.s += 1.5
        assert client.get(PROVIDER).status_code == 303


def given(tmp_path: Path, **changed: object) -> OidcOptions:
    (tmp_path / "secret").write_text(f"{SECRET}\n")
    options = {
        "oidc_issuer": "https://login.example",
        "oidc_client": CLIENT,
        "oidc_secret": tmp_path / "secret",
        "oidc_group": ["a=b=viewer", "c=admin"],
    }
    return OidcOptions(**(options | changed))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"oidc_issuer": "http://login.example"}, "https address"),
        ({"oidc_issuer": "login.example"}, "https address"),
        ({"oidc_issuer": "https://login.example?x"}, "https address"),
        ({"oidc_issuer": "http://127.0.0.1.evil.example"}, "https address"),
        ({"oidc_issuer": None}, "belong to --oidc-issuer"),
        ({"oidc_client": None}, "needs --oidc-client"),
        ({"oidc_secret": None}, "fleetmap-oidc"),
        ({"oidc_secret": Path("/nowhere/secret")}, "cannot be read"),
        ({"oidc_group": None}, "needs --oidc-group"),
        ({"oidc_group": ["people"]}, "write it like"),
        ({"oidc_group": ["people=root"]}, "write it like"),
        ({"oidc_group": ["people=program"]}, "write it like"),
        ({"oidc_group": ["=admin"]}, "write it like"),
        ({"oidc_group": ["a=viewer", "a=admin"]}, "twice"),
        ({"oidc_scope": "profile"}, "begin with openid"),
    ],
)
def test_options_that_cannot_be_right(tmp_path: Path, changed: dict[str, object], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        given(tmp_path, **changed).load_provider()


def test_options(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert OidcOptions().load_provider() is None
    assert given(tmp_path).load_provider().host == "login.example"
    assert given(tmp_path)._roles() == {"a=b": "viewer", "c": "admin"}
    (tmp_path / "fleetmap-oidc").write_text("sealed\n")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path))
    assert given(tmp_path, oidc_secret=None)._secret() == "sealed"
    assert SECRET not in repr(ProviderSettings(issuer="https://x", client_id="", client_secret=SECRET, roles={}))
    for name in [name for name in sys.modules if name.split(".")[0] == "authlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "authlib", None)
    with pytest.raises(UsageError, match=r"needs authlib.*pip install '\.\[server,oidc\]'"):
        given(tmp_path).load_provider()
