"""Operators, tokens and enrolled robots over HTTP: who may, what only one answer has, and what would lock everybody out."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from fleetmap.messages import RobotHealth
from fleetmap.trust import enrolment
from mapserver.operators.operators import Operators
from mapserver.store import Actor
from mapserver.trust import init_here
from mapserver.trust.enrolment import RobotRegister
from support.fleet.served_api import Server, check_problem, served_api
from support.fleet.served_api import named as sessions

WHY = {"reason": "monday"}
ACTS = (
    ("/v1/operators", {"name": "bob", "role": "viewer"}, "operators"),
    ("/v1/operators/olga/password", {}, "operators"),
    ("/v1/operators/olga/role", {"role": "viewer"}, "operators"),
    ("/v1/tokens", {"name": "ci", "scopes": ["read"], "days": 1}, "operators"),
    ("/v1/operators/olga/disable", {}, "operators"),
    ("/v1/sites/lab/enrolled", {"robot": "r1"}, "robots"),
    ("/v1/sites/lab/enrolled/r1/revoke", {}, "robots"),
    ("/v1/sites/lab/robots/r1/remove", {}, "robots"),
)
LISTS = (("/v1/operators", "operators"), ("/v1/log", "operators"), ("/v1/sites/lab/enrolled", "robots"))


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    """A server of enrolled robots, which has heard r1."""
    with served_api(tmp_path) as made:
        init_here(made.store)
        RobotRegister(made.store).authorities.init(["127.0.0.1", "maps.example"], None, None)
        made.fleet.take_health("lab", "r1", RobotHealth(site="lab", robot="r1", stamp_ns=1, version=1, status="LOST"))
        made.fleet.flush()
        yield made


named = pytest.fixture(sessions)


def token(server: Server, *scopes: str, name: str = "program") -> dict[str, str]:
    return {"Authorization": f"Bearer {Operators(server.store).make_token(name, scopes, 1, Actor('root'))}"}


def test_each_address_asks_for_its_right(server: Server, named: dict[str, dict[str, str]]) -> None:
    client = server.client
    for path, right in LISTS:
        for headers in (named["vic"], named["olga"], token(server, "read", "change", "metrics")):
            check_problem(client.get(path, headers=headers), 403, f"the right to {right!r}")
        assert client.get(path, headers=named["ada"]).status_code == 200
        assert client.get(path, headers=token(server, right)).status_code == 200
    for path, body, right in ACTS:
        for headers in (named["vic"], named["olga"], token(server, "read", "change")):
            check_problem(client.post(path, json=body | WHY, headers=headers), 403, f"the right to {right!r}")
    for path, body, _ in ACTS:
        assert client.post(path, json=body | WHY, headers=named["ada"]).status_code == 200, path
        last = server.store.log()[0]
        assert (last.actor, last.operator, last.reason) == ("ada", "ada", "monday"), path
    assert {row["name"]: row["is_disabled"] for row in client.get("/v1/operators", headers=named["ada"]).json()["items"]} == {
        "ada": False, "bob": False, "ci": False, "olga": True, "program": False, "vic": False,
    }  # fmt: skip
    asked, ada = "/v1/log?person=ada&site=lab&kind=robot&limit=2", named["ada"]
    whole, log = client.get("/v1/log?limit=1000", headers=ada).json()["items"], client.get(asked, headers=ada).json()
    assert [line["detail"] for line in log["items"]] == ["r1", "r1"]
    assert [line["kind"] for line in log["items"]] == ["robot removed", "robot revoked"]
    (last,) = client.get(f"{asked}&cursor={log['next']}", headers=ada).json()["items"]
    assert (last["kind"], last["reason"], last in whole) == ("robot enrolled", "monday", True)
    assert {line["actor"] for line in whole} >= {"root", "ada"}
    enrolled = client.get("/v1/sites/lab/enrolled", headers=named["ada"]).json()["items"]
    assert enrolled == server.store.robots("lab") == []


def test_no_other_form_of_an_address_needs_less(server: Server, named: dict[str, dict[str, str]]) -> None:
    robots = ("sites/lab/enrolled", "sites/lab/enrolled/r1/revoke", "sites/lab/robots/r1/remove")
    forms = "/v1/{}/ /v1//{} //v1/{} /v1/./{} /V1/{} /v1/{}%0A /v1/{}%2F /v1/{}?x=1 http://127.0.0.1/v1/{}"
    for path in ("operators", "tokens", *robots):
        for form in forms.split():
            for method in ("GET", "POST", "HEAD"):
                answer = server.client.request(method, form.format(path), headers=named["olga"], follow_redirects=True)
                assert answer.status_code in (403, 404, 405), (method, form, path)


def test_the_first_operator_is_an_admin(server: Server) -> None:
    client, act = server.client, {"actor": "carl"}
    first = {"name": "bob", "role": "operator"}
    check_problem(client.post("/v1/operators", json=first | act), 409, "begin with an admin")
    check_problem(client.post("/v1/tokens", json={"name": "ci", "scopes": ["operators"]} | act), 409, "an admin before")
    assert client.get("/v1/operators").json() == {"items": [], "next": None}
    answer = client.post("/v1/operators", json=first | {"role": "admin"} | act)
    assert (answer.status_code, answer.headers["cache-control"]) == (200, "no-store")
    assert client.get("/v1/operators").status_code == 401, "at once"
    session = Operators(server.store).sign_in("bob", answer.json()["secret"], "").session
    assert client.get("/v1/operators", headers={"Cookie": f"fleetmap={session}"}).status_code == 200


def test_the_last_admin_stays(server: Server, named: dict[str, dict[str, str]]) -> None:
    client, ada = server.client, named["ada"]
    check_problem(client.post("/v1/operators/ada/disable", json={}, headers=ada), 409, "ada is the last admin")
    lower = client.post("/v1/operators/ada/role", json={"role": "viewer"}, headers=ada)
    check_problem(lower, 409, "add another one first")
    assert client.get("/v1/operators", headers=ada).status_code == 200
    assert client.post("/v1/operators/vic/role", json={"role": "admin"}, headers=ada).status_code == 200
    assert client.post("/v1/operators/ada/disable", json={}, headers=ada).status_code == 200
    assert client.get("/v1/operators", headers=ada).status_code == 401
    assert client.get("/v1/operators", headers=named["vic"]).status_code == 200


def test_nobody_gives_more_than_they_have(server: Server, named: dict[str, dict[str, str]]) -> None:
    client, limited = server.client, token(server, "operators", "read")
    for path, body in (
        ("/v1/tokens", {"name": "ci", "scopes": ["read", "change"]}),
        ("/v1/operators", {"name": "eve", "role": "admin"}),
        ("/v1/operators/vic/role", {"role": "admin"}),
        ("/v1/operators/ada/password", {}),
    ):
        check_problem(client.post(path, json=body, headers=limited), 403, "cannot give the right to")
    assert client.post("/v1/tokens", json={"name": "ci", "scopes": ["read"]}, headers=limited).status_code == 200
    assert client.post("/v1/operators/vic/password", json={}, headers=limited).status_code == 200
    assert client.get("/v1/operators", headers=named["ada"]).status_code == 200, "the session of the admin goes on"


def test_what_makes_no_sense_is_refused(server: Server, named: dict[str, dict[str, str]]) -> None:
    made = token(server, "read", name="ci")
    for path, body, status, words in (
        ("/v1/operators", {"name": "olga", "role": "viewer"}, 409, "operator olga exists"),
        ("/v1/operators", {"name": "Olga", "role": "viewer"}, 422, "body.name"),
        ("/v1/operators", {"name": "bob", "role": "program"}, 422, "body.role"),
        ("/v1/operators/ci/password", {}, 409, "ci is a program"),
        ("/v1/operators/ci/role", {"role": "admin"}, 409, "ci is a program"),
        ("/v1/operators/bob/password", {}, 404, "unknown operator bob"),
        ("/v1/operators/bob/disable", {}, 404, "unknown operator bob"),
        ("/v1/tokens", {"name": "ci", "scopes": []}, 422, "body.scopes"),
        ("/v1/tokens", {"name": "ci", "scopes": ["all"]}, 422, "body.scopes"),
        ("/v1/tokens", {"name": "ci", "scopes": ["read"], "days": 401}, 422, "body.days"),
        ("/v1/sites/lab/enrolled", {"robot": "R 1"}, 422, "body.robot"),
        ("/v1/sites/lab/enrolled", {"robot": "r1", "endpoint": "tcp/127.0.0.1:1"}, 422, "body.endpoint"),
        ("/v1/sites/lab/enrolled", {"robot": "r1", "endpoint": "tls/127.0.0.1:99999"}, 422, "99999 is above 65535"),
        ("/v1/sites/lab/enrolled", {"robot": "r1", "endpoint": "tls/10.0.0.1:1"}, 409, "names 127.0.0.1, maps.example"),
        ("/v1/sites/lab/enrolled/r9/revoke", {}, 404, "has not enrolled r9"),
        ("/v1/sites/lab/robots/r9/remove", {}, 404, "knows no robot r9"),
        ("/v1/sites/nowhere/robots/r1/remove", {}, 404, "nowhere"),
    ):
        check_problem(server.client.post(path, json=body, headers=named["ada"]), status, words)
    assert server.client.post("/v1/operators/ci/disable", json={}, headers=named["ada"]).status_code == 200
    assert server.client.get("/v1/sites", headers=made).status_code == 401
    again = server.client.post("/v1/tokens", json={"name": "ci", "scopes": ["read"]}, headers=named["ada"])
    check_problem(again, 409, "ci is disabled")


def test_one_of_two_tokens_is_revoked(server: Server, named: dict[str, dict[str, str]]) -> None:
    client, (first, second) = server.client, (token(server, "read", name="ci") for _ in range(2))

    def tokens() -> list[str]:
        rows = client.get("/v1/operators", headers=named["ada"]).json()["items"]
        return [one["number"] for row in rows if row["name"] == "ci" for one in row["tokens"]]

    for number in tokens():
        if client.get("/v1/sites", headers=first).status_code == 200:
            address = f"/v1/tokens/{number}/revoke"
            assert client.post(address, json=WHY, headers=named["ada"]).status_code == 200
            check_problem(client.post(address, json=WHY, headers=named["ada"]), 404, f"number {number}")
            break
    left = [client.get("/v1/sites", headers=headers).status_code for headers in (first, second)]
    assert (sorted(left), len(tokens())) == ([200, 401], 1)
    assert [(line.kind, line.detail) for line in server.store.log()[::-1]][-1] == ("token revoked", "ci: read")


def test_secrets_are_in_one_answer_alone(
    server: Server, named: dict[str, dict[str, str]], tmp_path: Path, caplog
) -> None:
    client, ada = server.client, named["ada"]
    caplog.set_level("DEBUG")
    password = client.post("/v1/operators/olga/password", json=WHY, headers=ada)
    made = client.post("/v1/tokens", json={"name": "olga", "scopes": ["read"], "days": 30} | WHY, headers=ada)
    asked = {"robot": "r2", "endpoint": "tls/maps.example:7447"} | WHY
    bundle = client.post("/v1/sites/lab/enrolled", json=asked, headers=ada)
    assert {answer.headers["cache-control"] for answer in (password, made, bundle)} == {"no-store"}
    assert client.get("/v1/sites", headers={"Authorization": f"Bearer {made.json()['secret']}"}).status_code == 200
    assert Operators(server.store).sign_in("olga", password.json()["secret"], "").session
    assert bundle.headers["content-disposition"] == 'attachment; filename="r2.fleetmap"'
    robot = enrolment.decode_bundle(bundle.content)
    assert (robot.site, robot.robot, robot.endpoint) == ("lab", "r2", "tls/maps.example:7447")
    secrets = [password.json()["secret"], made.json()["secret"], robot.own, ada["Cookie"].partition("=")[2]]
    paths = ("/v1/operators", "/v1/sites/lab/enrolled", "/v1/sites/lab/events")
    told = [client.get(path, headers=ada).text for path in paths]
    kept = [path.read_bytes().decode("latin-1") for path in tmp_path.rglob("*") if path.is_file()]
    for secret in secrets:
        assert not [text for text in (*told, *kept, caplog.text, str(server.store.log()[::-1])) if secret in text]
    (shown,) = [row for row in client.get("/v1/operators", headers=ada).json()["items"] if row["name"] == "olga"]
    assert (shown["role"], shown["sessions"], [row["scopes"] for row in shown["tokens"]]) == ("operator", 1, [["read"]])


def test_a_bundle_names_the_endpoint_of_the_server(server: Server, named: dict[str, dict[str, str]]) -> None:
    answer = server.client.post("/v1/sites/lab/enrolled", json={"robot": "r2"}, headers=named["ada"])
    bundle = enrolment.decode_bundle(answer.content)
    assert bundle.endpoint == "tls/127.0.0.1:7447"
    RobotRegister(server.store).renew("lab", "r2", enrolment.renewal_request(bundle.own.encode(), enrolment.new_key()))
    (row,) = server.client.get("/v1/sites/lab/enrolled", headers=named["ada"]).json()["items"]
    assert (row["robot"], row["is_used"], row["state"]) == ("r2", True, "certificate for 365 days")
    again = server.client.post("/v1/sites/lab/enrolled", json={"robot": "r2"}, headers=named["ada"])
    check_problem(again, 409, "robots revoke r2")


def test_without_certificates_the_next_step_is_told(tmp_path: Path) -> None:
    with served_api(tmp_path) as server:
        answer = server.client.post("/v1/sites/lab/enrolled", json={"robot": "r1", "actor": "ada"})
        check_problem(answer, 409, "mapserver trust init --here --host NAME")


def test_without_operators_other_machines_manage_nobody(server: Server) -> None:
    """As with `--insecure`: whoever can connect may change maps, but not lock the others out."""
    with TestClient(server.client.app, "http://127.0.0.1", client=("10.0.0.9", 9)) as stranger:
        assert stranger.get("/v1/sites").status_code == 200
        for path, _ in LISTS:
            check_problem(stranger.get(path), 403, "only the server's own machine")
        for path, body, _ in ACTS:
            check_problem(stranger.post(path, json=body | {"actor": "eve", "role": "admin"}), 403, "operators add NAME")
    headers = {"X-Forwarded-For": "10.0.0.9"}
    proxied = server.client.post("/v1/operators", json=ACTS[0][1] | {"actor": "eve"}, headers=headers)
    check_problem(proxied, 403, "only the server's own machine")
    assert server.client.get("/v1/operators").json()["items"] == []


def test_under_a_prefix_the_same_rights_are_needed(server: Server, named: dict[str, dict[str, str]]) -> None:
    with TestClient(server.client.app, "http://127.0.0.1", root_path="/maps") as client:
        for path, _ in LISTS:
            assert client.get(f"/maps{path}", headers=named["ada"]).status_code == 200
            assert client.get(f"/maps{path}", headers=named["olga"]).status_code == 403
