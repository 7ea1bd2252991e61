"""Who may be told where he stands, and what is refused, over HTTP."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from fleetmap.errors import StateError
from fleetmap.messages import InitialPoseMessage, RobotHealth, decode_message, robot_key
from mapserver.serving.bus_service import place_robot
from mapserver.store import Actor
from support.fleet.served_api import Server, check_problem, served_api

PATH = "/v1/sites/lab/robots/r1/initial_pose"
WORD = {"actor": "ada", "reason": "seen", "x_map_m": 1.5, "y_map_m": 2.0, "heading_rad": 0.5}


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with served_api(tmp_path) as made:
        made.fleet.take_health("lab", "r1", RobotHealth(site="lab", robot="r1", stamp_ns=1, version=1, status="LOST"))
        yield made


def test_a_robot_hears_the_word_and_the_history_who_gave_it(server: Server) -> None:
    heard: list[bytes] = []
    server.bus.subscribe(robot_key("lab", "*", "initial_pose"), lambda key, payload: heard.append((key, payload)))
    assert server.client.post(PATH, json=WORD).json() == {"status": "ok"}
    ((key, payload),) = heard
    assert key == robot_key("lab", "r1", "initial_pose")
    told = decode_message(payload, InitialPoseMessage)
    assert (told.x_map_m, told.y_map_m, told.heading_rad, told.sigma_m) == (1.5, 2.0, 0.5, 0.5)
    event = server.store.events("lab")[-1]
    assert (event.kind, event.actor, event.reason) == ("robot placed", "ada", "seen")
    assert "r1 is at 1.50, 2.00 m, heading 29 degrees" in event.detail


@pytest.mark.parametrize(
    ("path", "changes", "status", "words"),
    [
        (PATH.replace("lab", "yard"), {}, 404, "no site yard"),
        (PATH.replace("r1", "r9"), {}, 404, "has no robot 'r9'"),
        (PATH, {"x_map_m": 5000.0}, 404, "outside of version 1: it has no tile"),
        (PATH, {"sigma_m": 0}, 422, "sigma_m"),
        (PATH, {"y_map_m": "nan"}, 422, "y_map_m"),
        (PATH, {"x_map_m": None}, 422, "x_map_m"),
        (PATH, {"actor": None}, 422, "name the person who acts"),
    ],
)
def test_what_cannot_be_is_refused_and_nobody_hears_it(
    server: Server, path: str, changes: dict[str, object], status: int, words: str
) -> None:
    heard: list[str] = []
    server.bus.subscribe("**", lambda key, _: heard.append(key))
    check_problem(server.client.post(path, json=WORD | changes), status, words)
    assert heard == []
    assert "robot placed" not in {event.kind for event in server.store.events("lab")}


def test_a_robot_that_is_away_is_not_told(server: Server, monkeypatch) -> None:
    def answered(seconds_since: float, present: list[tuple[str, str]]) -> int:
        server.fleet.take_presence(present)
        heard_ns = server.fleet._robots["lab", "r1"].seen_ns
        monkeypatch.setattr(server.fleet, "_clock_ns", lambda: heard_ns + int(seconds_since * 1e9))
        return server.client.post(PATH, json=WORD).status_code

    here = [("lab", "r1")]
    assert (answered(9.0, here), answered(11.0, here), answered(2.0, []), answered(4.0, [])) == (200, 409, 200, 409)
    check_problem(server.client.post(PATH, json=WORD), 409, "last seen 4 s ago and is not connected")
    assert answered(1.0, here) == 200
    word = InitialPoseMessage(site="lab", robot="r1", x_map_m=1.5, y_map_m=2.0)
    with pytest.raises(StateError, match="no bus"):
        place_robot(server.store, server.fleet, None, word, Actor("ada"))
