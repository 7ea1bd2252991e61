"""Numbers that no sender means, in every field of every message, both ways: refused where they are decoded; every page goes on."""

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec import inspect as types
from starlette.routing import Mount, Route
from typer.testing import CliRunner

from fleetmap import failure_summary, messages
from fleetmap.messages import FailureReport, Placement, PoseMessage, RobotAck, RobotHealth, robot_key
from mapserver.api.parameters import ApiSettings
from mapserver.cli import app
from mapserver.dashboard.install import install_dashboard
from mapserver.fleet.rate_limit import RateLimit
from mapserver.serving.bus_service import BusService
from support.fleet.hostile_messages import EXTREMES, check_refusals, extremes, spoiled, structs_of, whole
from support.fleet.memory_bus import MemoryBus
from support.fleet.reports import blindness
from support.fleet.served_api import Server, served_api

HEARD = {"ack": RobotAck, "health": RobotHealth, "pose": PoseMessage}
PATH = {"site": "lab", "robot": "r1", "version": "1", "number": "1", "failure": "1", "place": "0", "x": "0", "y": "0"}


@pytest.mark.parametrize("kind", structs_of(messages, failure_summary), ids=lambda kind: kind.__name__)
def test_a_number_that_none_can_mean_is_refused_where_it_is_decoded(kind: type[msgspec.Struct]) -> None:
    check_refusals(kind)


@pytest.fixture
def server(tmp_path: Path, monkeypatch) -> Iterator[Server]:
    monkeypatch.setattr(RateLimit, "admits", lambda *_: True)
    with served_api(tmp_path / "store", tmp_path / "inbox") as made:
        install_dashboard(made.client.app, made.store, made.fleet, ApiSettings())
        yield made


def check_pages(server: Server) -> None:
    """No page or answer is an error of the server."""
    found = {}
    for base, routes in [
        ("", server.client.app.routes),
        *((m.path, m.routes) for m in server.client.app.routes if isinstance(m, Mount)),
    ]:
        for route in routes:
            asked = isinstance(route, Route) and "GET" in (route.methods or ()) and route.name != "followed"
            if asked and not set(route.param_convertors) - PATH.keys():
                path = base + route.path_format.format_map(PATH)
                found[path] = server.client.get(path, params={"site": "lab"} if base else {}).status_code
    assert {path: status for path, status in found.items() if status >= 500} == {}
    pages = ("", "robots", "robots/r1", "trends", "map", "failures", "failures/1")
    assert {found[f"/dashboard/{page}"] for page in pages} == {200}


def test_no_number_of_a_robot_takes_a_page(server: Server) -> None:
    service, taken = BusService(server.store, server.fleet, server.bus, lambda *_: None), 0
    with MemoryBus(server.bus._hub) as robot:
        for what, kind in HEARD.items():
            for changed in extremes(kind):
                robot.publish(robot_key("lab", "r1", what), changed)
    for n, changed in enumerate(spoiled(whole(types.type_info(FailureReport)), *EXTREMES)):
        payload = msgspec.msgpack.encode({**changed, "id": f"f{n}"})
        taken += not server.fleet.take_failure_bytes("lab", "r1", payload).refused
    server.fleet.flush()
    assert taken > 50
    check_pages(server)
    service.close()


def test_a_report_that_cannot_be_read_hides_no_other_and_a_command_removes_it(server: Server) -> None:
    place, wall_ns = Placement.of(np.eye(4)), server.store.now_ns()
    for number in ("f1", "f2"):
        server.fleet.take_failure("lab", "r1", blindness(number, map_from_base=place, tile=(0, 0), wall_ns=wall_ns))
    with server.store._database.write() as change:
        change.execute("UPDATE failures SET report = substr(report, 1, 40) WHERE number = 1")
    check_pages(server)
    listed = server.client.get("/v1/failures").json()["items"]
    assert [(row["number"], row["x_map_m"]) for row in listed] == [(2, 0.0), (1, 0.0)]
    store, out = str(server.folder), server.folder.parent
    for command in (["export", str(out / "a.jsonl")], ["report", str(out / "a.html"), "--site", "lab"]):
        assert CliRunner().invoke(app, ["fleet", *command, "--store", store]).exit_code == 0
    assert "mapserver fleet remove 1" in server.client.get("/dashboard/failures/1").text
    assert CliRunner().invoke(app, ["fleet", "remove", "1", "--store", store]).exit_code == 0
    assert [row["number"] for row in server.client.get("/v1/failures").json()["items"]] == [2]
    assert server.client.get("/dashboard/failures/1").status_code == 404
