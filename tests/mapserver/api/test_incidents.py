"""Incidents: what somebody must look after is acknowledged, handed over, commented, closed and reopened by route, command and webhook."""

import json
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from fleetmap.errors import InvalidValueError
from fleetmap.messages import RobotHealth
from mapserver.cli import app
from mapserver.fleet.alerts import AlertSettings
from mapserver.plugins.alert_messages import Webhook
from mapserver.serving.background_tasks import alert_tasks
from mapserver.store import DraftContent
from support.fleet.reports import blindness
from support.fleet.served_api import Server, check_problem, served_api
from support.fleet.webhook_receiver import receiver
from support.room_site import invoke, run
from support.storage.map_samples import draft_details, random_tile
from support.waiting import eventually

ALERT, DRAFT, RECORDING, FAILURE = (
    "FleetmapNightFailed/lab/job 1",
    "draft/lab/3",
    f"recording/lab/held/0a-{'monday' * 30}.mcap",
    "failure/lab/1",
)


SLOW, HELD = ("overloaded",), "resolved FleetmapRobotOverloaded/lab/r1"
# What a robot reports, what is done, whether the server starts anew before that, and what the receiver is told.
STEPS = (
    (SLOW, "", True, "firing r1 of lab is too slow"),
    (SLOW, "acknowledge", False, f"{HELD} acknowledged by dan: on it"),
    (SLOW, "", True),
    (SLOW, "reopen", False, "firing r1 of lab is too slow", f"{HELD} reopened by dan: on it"),
    (SLOW, "close", False, f"{HELD} closed by dan: on it"),
    ((), "", False, "resolved r1 of lab is too slow"),
    (SLOW, "", False, "firing r1 of lab is too slow"),
)


def act(server: Server, name: str, incident: str, **more: str) -> None:
    answer = server.client.post(f"/v1/incidents/{name}", json={"incident": incident, "actor": "dan"} | more)
    assert answer.json() == {"status": "ok"}


def states(server: Server) -> dict[str, tuple[str, str]]:
    asked, found, page = {"site": "lab", "limit": "1"}, [], {"next": ""}
    while page["next"] is not None:
        page = server.client.get(
            "/v1/incidents", params=asked | ({"cursor": page["next"]} if page["next"] else {})
        ).json()
        found += page["items"]
    return {one["id"]: (one["state"], one["assignee"]) for one in found if one["site"]}


def hold(inbox: Path) -> None:
    (inbox / "held").mkdir(parents=True, exist_ok=True)
    held = inbox / "held" / Path(RECORDING).name
    held.touch()
    Path(f"{held}.reason.txt").write_text("it saw another hall")


def test_each_kind_by_route_and_command(tmp_path: Path) -> None:
    hold(tmp_path / "inbox" / "lab")
    folder = tmp_path / "store"
    with served_api(folder, tmp_path / "inbox") as server:
        server.store.update_job(server.store.begin_job("lab", "nightly"), "failed", "the disk is full", {})
        assert not server.fleet.take_failure("lab", "r1", blindness("f1")).refused
        thin = random_tile(np.random.default_rng(5), landmarks=10, cell=(0, 0))
        server.store.save("lab", DraftContent(tiles=[thin], vocabulary=b"words" * 50, details=draft_details()))
        assert server.client.post("/v1/sites/lab/versions/3/publish", json={"actor": "dan"}).status_code == 409
        assert states(server) == dict.fromkeys((ALERT, DRAFT, RECORDING), ("open", "")), "failures once somebody acts"
        command = ("--store", folder, "--actor", "carl", "--inbox", tmp_path / "inbox")
        for incident in (ALERT, DRAFT, RECORDING, FAILURE):
            act(server, "acknowledge", incident)
            assert states(server)[incident] == ("acknowledged", "dan")
            run(app, "incidents", "assign", incident, "--to", "Bob B", *command, "--reason", "your shift")
            act(server, "comment", incident, reason="seen it")
            assert states(server)[incident] == ("acknowledged", "Bob B")
            listed = run(app, "incidents", "list", "--json", "--store", folder, "--inbox", tmp_path / "inbox")
            (found,) = (one for one in json.loads(listed) if one["id"] == incident)
            told = [(one["actor"], one["reason"]) for one in found["acts"]]
            assert told == [("dan", ""), ("carl", "your shift"), ("dan", "seen it")]
            run(app, "incidents", "close", incident, *command)
            assert incident not in states(server)
            act(server, "reopen", incident)
            assert states(server).get(incident, ("open", "")) == ("open", "")
        act(server, "close", RECORDING)
        assert RECORDING not in states(server)
        hold(tmp_path / "inbox" / "lab")
        assert states(server)[RECORDING] == ("open", ""), "another of its name is held"
        asked = {"incident": RECORDING, "actor": "d\x1b[31mn"}
        with ThreadPoolExecutor(4) as pool:
            answers = [pool.submit(server.client.post, "/v1/incidents/acknowledge", json=asked) for _ in range(4)]
        assert sorted(each.result().status_code for each in answers) == [200, 409, 409, 409], "one of them has it"
        assert "\x1b" not in run(app, "incidents", "list", "--store", folder, "--inbox", tmp_path / "inbox")
        done = [line.detail.removesuffix(f": {FAILURE}") for line in server.store.log()[::-1]][-7:-2]
        assert done == ["acknowledged", "handed to Bob B", "commented", "closed", "reopened"]
        act(server, "acknowledge", FAILURE)
        server.store.fleet.remove_failure(1)
        old = blindness("f2", wall_ns=time.time_ns() - 3_600_000_000_000)  # kept by its robot for an hour
        assert not server.fleet.take_failure("lab", "r1", old).refused
        assert server.store.fleet.failure(1).report.id == "f2", "its number is given again"
        assert FAILURE not in states(server)
        act(server, "acknowledge", FAILURE)
        assert states(server)[FAILURE] == ("acknowledged", "dan"), "what was done about the other one is over"
        for name, told, status in (
            ("comment", {"incident": DRAFT}, 422),
            ("close", {"incident": "failure/lab/9"}, 404),
            ("close", {"incident": "failure/hall/1"}, 404),
            ("reopen", {"incident": DRAFT}, 409),
            ("close", {"incident": "draft/lab/1"}, 404),
            ("assign", {"incident": DRAFT, "to": "a: b"}, 422),
        ):
            check_problem(server.client.post(f"/v1/incidents/{name}", json=told | {"actor": "dan"}), status, "")
        for name in ("a: b", "bob\n", "b" * 65):
            refused = invoke(app, "incidents", "assign", DRAFT, "--to", name, *command)
            assert isinstance(refused.exception, InvalidValueError)


def test_an_acknowledged_alert_is_silent_until_it_begins_anew(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("mapserver.serving.background_tasks.HEARD_WITHIN_S", 0.0)
    (tmp_path / "token").write_text("secret\n")
    expected: list[str] = []
    with served_api(tmp_path / "store") as server, receiver() as (address, got):

        def told() -> list[str]:
            messages = [json.loads(body) for _, body in got]
            alerts = [one for message in messages for one in message["alerts"] if one["labels"]["site"] == "lab"]
            return [f"{one['status']} {one['annotations']['summary']}".partition(": many")[0] for one in alerts]

        for step, (flag, done, restarts, *words) in enumerate(STEPS):
            if restarts:
                sender = Webhook(AlertSettings(webhook=address, token_file=str(tmp_path / "token")))
                (task,) = alert_tasks(server.store, server.fleet, AlertSettings(), sender)
            report = RobotHealth(site="lab", robot="r1", stamp_ns=step, version=1, status="TRACKING", flags=flag)
            server.fleet.take_health("lab", "r1", report)
            if done:
                act(server, done, "FleetmapRobotOverloaded/lab/r1", reason="on it")
            task.act()
            task.act()  # nothing is told twice
            expected += words
            assert eventually(lambda wanted=expected: told() == wanted), told()
        sender.close()
    assert {headers["Authorization"] for headers, _ in got} == {"Bearer secret"}
    message = json.loads(got[-1][1])
    (alert,) = (one for one in message["alerts"] if one["labels"]["site"])
    assert (message["version"], alert["labels"]["alertname"]) == ("4", "FleetmapRobotOverloaded")
    assert (alert["labels"]["about"], alert["endsAt"]) == ("r1", "0001-01-01T00:00:00Z")
    assert datetime.fromisoformat(alert["startsAt"]).tzinfo == UTC
