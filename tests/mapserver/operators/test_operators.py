"""Sign-in, sessions and tokens; guessing of passwords (row 36 of docs/security.md)."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from mapserver.operators import operators as module
from mapserver.operators.operators import IDLE_S, LIFE_S, TRIES, TRY_EVERY_S, Operators
from mapserver.serving.http_connections import binding_fault
from mapserver.store import Actor, MapStore
from support.storage.clock import Clock
from support.waiting import eventually

PASSWORD = "ada has a long password"
ADMIN = Actor("root")
NS = 10**9
DUMMY = module._dummy.__wrapped__  # as it is, without its cache


@pytest.fixture
def clock() -> Clock:
    return Clock(1_800_000_000 * NS)


@pytest.fixture
def operators(metadata_folder: Path, clock: Clock) -> Iterator[Operators]:
    with MapStore.open(metadata_folder, create=True, clock_ns=clock) as store:
        made = Operators(store)
        made.add("ada", "operator", PASSWORD, ADMIN)
        yield made


def lines(operators: Operators) -> list[str]:
    return [f"{line.kind}: {line.detail}" for line in operators._store.log()[::-1]]


def test_a_clock_that_was_ahead_leaves_neither_long_sessions_nor_lost_tokens(
    operators: Operators, clock: Clock
) -> None:
    token = operators.make_token("ci", ["read"], 90, ADMIN)
    clock.now_ns += 365 * 86_400 * NS
    session = operators.sign_in("ada", PASSWORD, "10.0.0.1").session
    assert operators.identify(session, "", "") is not None
    assert operators.identify("", f"Bearer {token}", "") is None
    clock.now_ns -= 365 * 86_400 * NS
    assert operators.identify(session, "", "") is None
    assert operators.identify("", f"Bearer {token}", "") is not None
    assert operators.sign_in("ada", PASSWORD, "10.0.0.1").session, "nor are people kept out"


def test_a_first_operator_is_noticed_though_the_clock_was_set_back(tmp_path: Path, clock: Clock) -> None:
    with MapStore.open(tmp_path / "new", create=True, clock_ns=clock) as store:
        serving = Operators(store)
        assert not serving.is_sign_in_on
        clock.now_ns -= 3600 * NS
        Operators(store).add("ada", "admin", PASSWORD, ADMIN)
        assert serving.is_sign_in_on


def test_a_session_names_its_operator_and_ends(operators: Operators, clock: Clock) -> None:
    session = operators.sign_in("ada", PASSWORD, "10.0.0.1").session
    who = operators.identify(session, "", "10.0.0.1")
    assert (who.name, who.role, sorted(who.scopes)) == ("ada", "operator", ["change", "metrics", "read"])
    assert who.actor("why") == Actor("ada", "why", "ada", "10.0.0.1")
    assert operators.identify("another", "", "") is operators.identify("", "", "") is None
    operators.sign_out(who)
    assert operators.identify(session, "", "") is None

    idle = operators.sign_in("ada", PASSWORD, "").session
    clock.now_ns += (IDLE_S - 1) * NS
    assert operators.identify(idle, "", "", uses=False)
    clock.now_ns += 2 * NS
    assert operators.identify(idle, "", "") is None

    used = operators.sign_in("ada", PASSWORD, "").session
    for _ in range(LIFE_S // 1800):
        assert operators.identify(used, "", "")
        clock.now_ns += 1800 * NS
    clock.now_ns += 1 * NS
    assert operators.identify(used, "", "") is None


def test_a_role_or_session_taken_away_is_gone_at_once(operators: Operators) -> None:
    session = operators.sign_in("ada", PASSWORD, "").session
    token = operators.make_token("ada", ["change", "operators"], 1, ADMIN)
    assert operators.identify("", f"Bearer {token}", "").scopes == {"change"}, "no more than its operator may"
    operators._store.operators.set_role("ada", "viewer", ADMIN)
    assert operators.identify(session, "", "").scopes == {"read"}
    assert operators.identify("", f"Bearer {token}", "").scopes == frozenset()
    operators._store.operators.disable("ada", ADMIN)
    assert operators.identify(session, "", "") is operators.identify("", f"Bearer {token}", "") is None
    assert operators.sign_in("ada", PASSWORD, "").refusal == "Wrong name or password."
    operators.set_password("ada", "another long password", ADMIN)
    assert operators.sign_in("ada", "another long password", "").session


def test_a_token_has_its_scopes_and_an_end(operators: Operators, clock: Clock) -> None:
    token = operators.make_token("prometheus", ["metrics"], 90, ADMIN)
    who = operators.identify("", f"Bearer {token}", "10.0.0.9")
    assert (who.name, who.role, who.scopes) == ("prometheus", "program", {"metrics"})
    assert who.actor().operator == "token of prometheus"
    assert operators.identify("", "Bearer guessed", "") is operators.identify("", token, "") is None
    assert operators.sign_in("prometheus", "", "").refusal, "a program has no password, not even an empty one"
    clock.now_ns += 90 * 86_400 * NS
    assert operators.identify("", f"Bearer {token}", "") is None


def test_guesses_are_few_and_say_nothing(operators: Operators, clock: Clock) -> None:
    answers = [operators.sign_in("ada", f"guess {n}", "10.0.0.66") for n in range(TRIES + 3)]
    assert [answer.retry_s for answer in answers] == [0] * TRIES + [TRY_EVERY_S] * 3
    assert operators.sign_in("ada", PASSWORD, "10.0.0.66").retry_s, "not even the right one"
    assert operators.sign_in("ada", PASSWORD, "10.0.0.1").session, "somebody else is not locked out"
    clock.now_ns += TRY_EVERY_S * NS
    assert operators.sign_in("ada", PASSWORD, "10.0.0.66").session
    refused = {operators.sign_in(name, "guess", "10.0.0.7").refusal for name in ("ada", "nobody")}
    assert refused == {"Wrong name or password."}


def test_without_the_bucket_a_guess_arrives(operators: Operators, monkeypatch) -> None:
    """The control of the test above."""
    monkeypatch.setattr(operators, "_tries", type("Open", (), {"admits": lambda *_: True})())
    guesses = [f"guess {n}" for n in range(TRIES + 3)] + [PASSWORD]
    assert operators.sign_in("ada", guesses[0], "x").refusal
    assert [bool(operators.sign_in("ada", guess, "x").session) for guess in guesses][-1]


def test_an_unknown_name_takes_as_long(operators: Operators, monkeypatch) -> None:
    """A hash of the same cost is verified for it."""
    verified: list[str] = []
    monkeypatch.setattr(module, "_dummy", DUMMY)
    monkeypatch.setattr(module, "_verified", lambda stored, _: bool(verified.append(stored)))
    for name in ("ada", "nobody"):
        assert operators.sign_in(name, "guess", name).refusal == "Wrong name or password."
    known, unknown = (stored.split("$")[1:4] for stored in verified)
    assert known == unknown
    assert known[0] == "argon2id"


def test_many_at_once_do_not_wait_for_ever(operators: Operators) -> None:
    answers: list[module.SignIn] = []
    guess = lambda n: answers.append(operators.sign_in(f"nobody-{n}", "x", ""))  # noqa: E731
    threads = [threading.Thread(target=guess, args=(n,)) for n in range(12)]
    with operators._verifying:  # four wait for their turn
        for thread in threads:
            thread.start()
        assert eventually(lambda: len(answers) >= 8, 30.0)
    for thread in threads:
        thread.join(30)
    assert [bool(answer.retry_s) for answer in answers] == [True] * 8 + [False] * 4


def test_a_flood_of_refusals_does_not_fill_the_log(operators: Operators, clock: Clock) -> None:
    for n in range(500):
        operators.note("refused", f"number {n}", Actor("eve"))
    assert 60 <= len(lines(operators)) <= 65
    clock.now_ns += 61 * NS
    operators.note("refused", "the last", Actor("eve"))
    assert lines(operators)[-1] == "refused: the last (and 440 lines left out)"


def test_sign_in_is_on_from_the_first_name_to_the_end_of_days(tmp_path: Path, clock: Clock) -> None:
    with MapStore.open(tmp_path, create=True, clock_ns=clock) as store:
        operators = Operators(store)
        assert not operators.is_sign_in_on
        operators.make_token("ci", ["read"], 1, ADMIN)
        clock.now_ns += 2 * NS
        assert operators.is_sign_in_on
        store.operators.disable("ci", ADMIN)
        assert Operators(store).is_sign_in_on


def test_a_damaged_hash_lets_nobody_in(operators: Operators) -> None:
    with operators._store._database.write() as connection:
        connection.execute("UPDATE operators SET password = 'nonsense'")
    for name, password in (("ada", PASSWORD), ("ada", "nonsense"), ("\ud800" * 99, "\ud800")):
        assert operators.sign_in(name, password, "").refusal


LOCAL, BEYOND = ("127.0.0.1:8080", "127.0.0.1"), ("0.0.0.0:8080", "0.0.0.0")


@pytest.mark.parametrize(
    ("where", "how", "words"),
    [
        (LOCAL, {}, []),
        (("localhost:1", "localhost"), {}, []),
        (("[::1]:1", "::1"), {}, []),
        ((*LOCAL, ["localhost"]), {}, []),
        ((*LOCAL, ["maps.example"]), {}, ["--http-name maps.example", "operators add"]),
        ((*LOCAL, ["maps.example"]), {"has_operators": True}, []),
        (BEYOND, {}, ["--http 0.0.0.0:8080", "--http-cert", "operators add", "--insecure"]),
        (BEYOND, {"has_operators": True}, ["--http-cert"]),
        (BEYOND, {"has_tls": True}, ["operators add"]),
        (BEYOND, {"has_tls": True, "has_operators": True}, []),
        (("maps.example:1", "maps.example"), {}, ["--http-cert"]),
    ],
)
def test_where_http_may_be_served(where: tuple[str, ...], how: dict[str, bool], words: list[str]) -> None:
    fault = binding_fault(*where, **how)
    assert bool(fault) is bool(words)
    assert all(word in fault for word in words)
