"""Alerts at a webhook: told once and once more when they are over, and no answer of a hostile or dead one harms anything."""

import json
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
import yaml

from fleetmap.errors import UsageError
from fleetmap.messages import FailureReport, RobotHealth
from mapserver import releases
from mapserver.fleet.alerts import Alert, AlertSettings, active_alerts
from mapserver.fleet.fleet import Fleet
from mapserver.serving import webhook
from mapserver.serving.webhook import AlertWatch, Webhook, check_address
from mapserver.store import MapStore
from support.fleet.contracts_documents import REPOSITORY
from support.storage.clock import Clock
from support.storage.map_samples import save_sample_draft

HOUR_NS = 3_600_000_000_000
RULES = REPOSITORY / "deploy" / "prometheus-alerts.yml"


@contextmanager
def receiver(status: int = 200, location: str = "") -> Iterator[tuple[str, list[tuple[dict[str, str], bytes]]]]:
    got: list[tuple[dict[str, str], bytes]] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            got.append((dict(self.headers), self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(status)
            if location:
                self.send_header("Location", location)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/told?by=fleet", got
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def wait_for(what: object, seconds: float = 15.0) -> None:
    deadline_s = time.monotonic() + seconds
    while not what():  # type: ignore[operator]
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


@pytest.fixture
def clock() -> Clock:
    return Clock(1_900_000_000_000_000_000)


@pytest.fixture
def store(tmp_path: Path, clock: Clock) -> Iterator[MapStore]:
    with MapStore.open(tmp_path / "store", create=True, clock_ns=clock) as opened:
        for seed in range(2):
            save_sample_draft(opened, seed=seed)
            releases.publish(opened, "lab")
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
    canary = releases.start_canary(store, "lab", 1, 0.5)
    releases.end_canary(store, canary, promote=False, outcome="it fails more often")
    assert names() == [("FleetmapCanaryRolledBack", "version 1")]
    clock.now_ns += 25 * HOUR_NS
    assert names() == []


def test_a_rate_is_too_high_only_when_chance_does_not_explain_it(store: MapStore, clock: Clock) -> None:
    fleet = Fleet(store, clock_ns=clock)
    for number in range(7200):
        clock.now_ns += 10**9
        fleet.take_health("lab", "r1", health("TRACKING", number))
    for number, wanted in enumerate([0, 0, 0, 1]):
        report = FailureReport(
            site="lab", robot="r1", id=f"f{number}", stamp_ns=5, wall_ns=clock(), duration_s=2.5, kind="blind",
            status="LOST", cause="dark", version=1,
        )  # fmt: skip
        assert not fleet.take_failure("lab", "r1", report).refused
        fleet.flush()
        found = active_alerts(store, fleet, AlertSettings(), clock())
        assert len(found) == wanted, f"after {number + 1} failures in two hours"
    assert found[0].name == "FleetmapFailureRate"
    assert "failed 4 times in 24 h" in found[0].words


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
        wait_for(lambda: len(got) == 2)
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
        wait_for(lambda: "is dropped" in caplog.text)
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
        assert (sender._attempt(b"{}") == "") == is_taken
        assert time.monotonic() - begun_s < 3.0
        sender.close()
        ended.set()
        thread.join()


def test_a_dead_receiver_costs_a_bounded_queue(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
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
    if (promtool := shutil.which("promtool")) is not None:
        checked = subprocess.run([promtool, "check", "rules", RULES], capture_output=True, text=True, check=False)
        assert checked.returncode == 0, checked.stdout + checked.stderr
    (group,) = yaml.safe_load(RULES.read_text("utf-8"))["groups"]
    told = {rule["alert"] for rule in group["rules"]}
    expected = {"FailureRate", "RobotLost", "RobotCopied", "NightFailed", "CanaryRolledBack", "TrustFault"}
    assert told == {f"Fleetmap{name}" for name in expected}
