"""Alerts at a webhook: told once and once more when they are over, and no answer of a hostile or dead one harms anything."""

import json
import socket
import threading
import time
from contextlib import suppress
from pathlib import Path

import httpx
import pytest
from fastapi.testclient import TestClient

from fleetmap.errors import UsageError
from mapserver.api.app import create_app
from mapserver.api.parameters import ApiSettings
from mapserver.fleet.alerts import AlertSettings
from mapserver.fleet.fleet import Fleet
from mapserver.plugins import alert_messages
from mapserver.plugins.alert_messages import Webhook, check_address
from mapserver.store import MapStore
from support.fleet.webhook_receiver import receiver
from support.waiting import eventually


@pytest.mark.parametrize("status", [301, 307, 308, 404, 500])
def test_no_redirect_is_followed_and_attempts_end(status: int, monkeypatch, caplog) -> None:
    monkeypatch.setattr(alert_messages, "_PAUSES_S", (0.01, 0.01, 0.01))
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
def test_a_hostile_receiver_is_left_after_its_time(says: bytes, is_taken: bool, monkeypatch) -> None:
    """One that says nothing, those that send a byte now and then for ever, nonsense, and too many headers."""
    monkeypatch.setattr(alert_messages, "_ATTEMPT_S", 0.4)
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


def test_a_dead_receiver_costs_a_bounded_queue(caplog) -> None:
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


def ask(store: MapStore, sender: Webhook | None) -> httpx.Response:
    """The answer to a request for a test alert."""
    app = create_app(store, Fleet(store), ApiSettings(webhook=sender))
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
        line = store.log()[0]
        assert (line.kind, line.actor, line.reason) == ("alert_test", "ada", "new address")
    refused = ask(store, None)
    assert refused.status_code == 409
    assert "`webhook` in [alerts]" in refused.json()["detail"]
