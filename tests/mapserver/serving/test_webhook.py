"""Alerts at a webhook: told once and once more when they are over, and no answer of a hostile or dead one harms anything."""

import json
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import msgspec
import pytest
import yaml
from fastapi.testclient import TestClient

from fleetmap.errors import UsageError
from fleetmap.messages import RobotHealth
from mapserver import releases
from mapserver.api.app import create_app
from mapserver.api.metrics import Metrics
from mapserver.api.version_routes import ApiSettings
from mapserver.fleet.alerts import Alert, AlertSettings, active_alerts
from mapserver.fleet.fleet import Fleet
from mapserver.serving import webhook
from mapserver.serving.webhook import AlertWatch, Webhook, check_address
from mapserver.store import DiskSpace, MapStore
from support.fleet.contracts_documents import REPOSITORY
from support.fleet.nav2_client import eventually
from support.fleet.reports import blindness
from support.fleet.webhook_receiver import receiver
from support.storage.clock import Clock
from support.storage.map_samples import publish_samples

HOUR_NS = 3_600_000_000_000
RULES = REPOSITORY / "deploy" / "prometheus-alerts.yml"


@pytest.fixture
def clock() -> Clock:
    return Clock(1_900_000_000_000_000_000)


@pytest.fixture
def store(tmp_path: Path, clock: Clock) -> Iterator[MapStore]:
    with MapStore.open(tmp_path / "store", create=True, clock_ns=clock) as opened:
        publish_samples(opened, 2)
        yield opened


def health(status: str, number: int = 1) -> RobotHealth:
    return RobotHealth(
        site="lab", robot="r1", stamp_ns=number * 10**9, version=1, status=status, metrics={"speed_mps": 1.0}
    )


def test_what_holds_is_named_and_nothing_else(store: MapStore, clock: Clock) -> None:
    fleet, settings = Fleet(store, clock_ns=clock), AlertSettings()

    def names() -> list[tuple[str, str]]:
        return [(alert.name, alert.about) for alert in active_alerts(store, fleet, settings, clock())]

    for number in range(3600):  # an hour of driving, well localised
        clock.now_ns += 10**9
        fleet.take_health("lab", "r1", health("TRACKING", number))
    fleet.flush()
    assert names() == []
    for number in range(10):
        fleet.take_health("lab", "r1", health("LOST" if number % 2 else "AMBIGUOUS", 4000 + 30 * number))
        clock.now_ns += 30 * 10**9
        assert (names() == []) == (number < 9)
    assert names() == [("FleetmapRobotLost", "r1")]
    clock.now_ns += 61 * 10**9
    assert names() == [], "a robot that is off is not lost"
    store.update_job(store.begin_job("lab", "nightly"), "failed", "the disk is full", {})
    assert names() == [("FleetmapNightFailed", "job 1")]
    store.begin_job("lab", "nightly")
    assert names() == [("FleetmapNightFailed", "job 1")], "until another has ended"
    store.update_job(2, "done", "nothing to do", {})
    assert names() == []
    releases.start_canary(store, "lab", 1, 0.5)
    releases.roll_back(store, "lab")
    assert names() == [], "who did it by hand knows it"
    canary = releases.start_canary(store, "lab", 1, 0.5)
    releases.end_canary(store, canary, promote=False, outcome="it fails more often")
    assert names() == [("FleetmapCanaryRolledBack", "version 1")]
    clock.now_ns += 25 * HOUR_NS
    assert names() == []


def test_a_rate_is_too_high_only_when_chance_does_not_explain_it(store: MapStore, clock: Clock) -> None:
    fleet, number = Fleet(store, clock_ns=clock), 0
    for minutes, failures, wanted in ((5, 2, 0), (120, 7, 0), (600, 7, 0), (600, 8, 1)):
        while number < 15 * minutes:
            number, clock.now_ns = number + 1, clock.now_ns + 4 * 10**9
            fleet.take_health("lab", "r1", health("TRACKING", 4 * number))
        for failure in range(failures):
            assert not fleet.take_failure("lab", "r1", blindness(f"f{failure}", wall_ns=clock())).refused
        fleet.flush()
        found = active_alerts(store, fleet, AlertSettings(), clock())
        assert len(found) == wanted, f"after {failures} failures in {minutes} minutes"
    assert found[0].name == "FleetmapFailureRate"
    assert "failed 8 times in 24 h: 13 (5.5 to 25) per robot-day" in found[0].words


def test_it_is_told_once_and_once_more_when_it_is_over(clock: Clock, tmp_path: Path) -> None:
    held = [Alert("FleetmapRobotLost", "lab", "r1", clock(), "r1 of lab has had no known position for 5 min")]
    (tmp_path / "token").write_text("secret\n")
    with receiver() as (address, got):
        sender = Webhook(AlertSettings(webhook=address, token_file=str(tmp_path / "token")))
        watch = AlertWatch(lambda: held, sender.put, clock)
        for _ in range(3):
            watch.look()
        held = []
        for _ in range(3):
            watch.look()
        assert eventually(lambda: len(got) == 2)
        sender.close()
    assert {headers["Authorization"] for headers, _ in got} == {"Bearer secret"}
    begun, ended = (json.loads(body) for _, body in got)
    assert [begun["version"], begun["status"], ended["status"]] == ["4", "firing", "resolved"]
    (alert,) = begun["alerts"]
    assert alert["labels"] == {"alertname": "FleetmapRobotLost", "site": "lab", "about": "r1"}
    assert (alert["startsAt"], ended["alerts"][0]["endsAt"]) == ("2030-03-17T17:46:40Z",) * 2
    assert alert["annotations"]["summary"].startswith("r1 of lab")


@pytest.mark.parametrize("status", [301, 307, 308, 404, 500])
def test_no_redirect_is_followed_and_attempts_end(
    status: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(webhook, "_PAUSES_S", (0.01, 0.01, 0.01))
    with receiver() as (elsewhere, led), receiver(status, elsewhere) as (address, got):
        sender = Webhook(AlertSettings(webhook=address))
        sender.put({"alerts": []})
        assert eventually(lambda: "is dropped" in caplog.text)
        sender.close()
    assert (len(got), led) == (4, [])


@pytest.mark.parametrize(
    ("says", "is_taken"),
    [
        (b"", False),
        (b"HTTP/1.1 2", False),
        (b"HTTP/1.1 200 OK\r\nX: ", True),  # what was said is all that is read
        (b"\x00\xff" * 50, False),
        (b"HTTP/1.1 200 OK\r\n" + b"A: b\r\n" * 500, False),
    ],
)
def test_a_hostile_receiver_is_left_after_its_time(
    says: bytes, is_taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that says nothing, those that send a byte now and then for ever, nonsense, and too many headers."""
    monkeypatch.setattr(webhook, "_ATTEMPT_S", 0.4)
    ended = threading.Event()

    def drip(listener: socket.socket) -> None:
        client, _ = listener.accept()
        with client, suppress(OSError):
            client.sendall(says)
            while not ended.wait(0.05):
                client.sendall(b"a" if says else b"")

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=drip, args=(listener,))
        thread.start()
        sender = Webhook(AlertSettings(webhook=f"http://127.0.0.1:{listener.getsockname()[1]}/"))
        begun_s = time.monotonic()
        assert sender._attempt(b"{}")[0] == is_taken
        assert time.monotonic() - begun_s < 3.0
        sender.close()
        ended.set()
        thread.join()


def test_a_dead_receiver_costs_a_bounded_queue(caplog: pytest.LogCaptureFixture) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    sender = Webhook(AlertSettings(webhook=f"http://127.0.0.1:{port}/"))
    begun_s = time.monotonic()
    for _ in range(500):
        sender.put({"alerts": []})
    assert time.monotonic() - begun_s < 1.0
    assert "the queue of the webhook is full (50)" in caplog.text
    sender.close()
    assert not sender._thread.is_alive()


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("ftp://elsewhere.example/", "write it like"),
        ("https://", "write it like"),
        ("http://elsewhere.example/x", "use https://"),
        ("https://ada:secret@elsewhere.example/", "token_file"),
        ("https://elsewhere.example/\r\nX: y", "write it like"),
        ("https://elsewhere.example:99999/", "webhook"),
    ],
)
def test_addresses_that_must_not_be_told(address: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        check_address(address)


def test_a_token_that_cannot_be_read_is_told_at_once(tmp_path: Path) -> None:
    settings = AlertSettings(webhook="http://127.0.0.1:9/", token_file=str(tmp_path / "none"))
    with pytest.raises(UsageError, match="cannot be read"):
        Webhook(settings)


def test_the_rules_of_prometheus_are_those_of_the_webhook() -> None:
    (group,) = yaml.safe_load(RULES.read_text("utf-8"))["groups"]
    told = {rule["alert"] for rule in group["rules"]}
    expected = "FailureRate RobotLost RobotCopied RobotOverloaded NightFailed CanaryRolledBack DiskFills TrustFault"
    # A server cannot tell that it is down; days left are in the sentence of FleetmapTrustFault.
    assert told == {f"Fleetmap{name}" for name in [*expected.split(), "ServerDown", "CertificateEnds", "ListEnds"]}


def lost(clock: Clock, fleet: Fleet, names: list[str], minutes: int) -> None:
    """Robots that report every half minute that they are lost."""
    for number in range(2 * minutes + 1):
        for name in names:
            fleet.take_health("lab", name, msgspec.structs.replace(health("LOST", number), robot=name))
        clock.now_ns += 30 * 10**9 if number < 2 * minutes else 0


def test_metrics_name_the_robots_that_are_lost_for_longest(store: MapStore, clock: Clock) -> None:
    fleet = Fleet(store, clock_ns=clock)

    def named() -> dict[str, float]:
        text = Metrics(store, fleet).text().decode()
        return {
            name: float(s) for name, s in re.findall(r'fleetmap_site_robot_lost_seconds{.*robot="(.*?)".*} (.*)', text)
        }

    lost(clock, fleet, ["r1"], 4)
    assert named() == {}, "for less than five minutes"
    lost(clock, fleet, ["r1"], 4)
    assert named() == {"r1": 480.0}
    others = [f"r{number}" for number in range(2, 60)]
    lost(clock, fleet, ["r1", *others], 6)
    assert len(named()) == 20, "robots cannot make any number of series"
    assert max(named().items(), key=lambda item: item[1])[0] == "r1"
    assert 'fleetmap_site_robots_lost{site="lab"} 59.0' in Metrics(store, fleet).text().decode()
    fleet.take_health("lab", "r1", health("TRACKING", 99))
    assert "r1" not in named()


def test_a_disk_that_fills_is_told(store: MapStore, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    for total_gb, free_gb, is_told in ((500, 60, False), (500, 49, True), (20_000, 60, False), (20_000, 49, True)):
        space = DiskSpace(total_gb * 10**9, free_gb * 10**9)
        monkeypatch.setattr(store, "disk_space", lambda space=space: space)
        found = active_alerts(store, Fleet(store), AlertSettings(), clock())
        assert [alert.name for alert in found] == ["FleetmapDiskFills"] * is_told, (total_gb, free_gb)


def ask(store: MapStore, sender: Webhook | None) -> httpx.Response:
    """The answer to a request for a test alert."""
    fleet = Fleet(store)
    app = create_app(store, fleet, Metrics(store, fleet), None, None, ApiSettings(webhook=sender))
    with TestClient(app, "http://127.0.0.1") as client:
        return client.post("/v1/alerts/test", json={"actor": "ada", "reason": "new address"})


def test_a_test_alert_says_what_the_receiver_answered(store: MapStore) -> None:
    for status, answered in ((204, 200), (403, 502)):
        with receiver(status) as (address, got):
            sender = Webhook(AlertSettings(webhook=address))
            answer = ask(store, sender)
            sender.close()
        assert (answer.status_code, len(got)) == (answered, 1), "tried once"
        assert f"status {status}" in answer.json()["detail"]
        (alert,) = json.loads(got[0][1])["alerts"]
        assert alert["labels"]["alertname"] == "FleetmapTest"
        line = store.audit_lines()[-1]
        assert (line.kind, line.actor, line.reason) == ("alert_test", "ada", "new address")
    refused = ask(store, None)
    assert refused.status_code == 409
    assert "`webhook` in [alerts]" in refused.json()["detail"]
