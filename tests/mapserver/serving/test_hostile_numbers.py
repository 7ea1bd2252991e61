"""Numbers that no sender means, in every field of every message, both ways: refused where they are decoded; every page goes on."""

import inspect
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec import inspect as types
from starlette.routing import Mount, Route
from typer.testing import CliRunner

from fleetmap import failure_summary, live_survey, messages
from fleetmap.encoding import MOST
from fleetmap.errors import FleetmapError
from fleetmap.live_survey import LiveSurveyState
from fleetmap.messages import FailureReport, Placement, PoseMessage, RobotAck, RobotHealth, decode_message, robot_key
from mapserver.api.version_routes import ApiSettings
from mapserver.cli import app
from mapserver.dashboard.install import install_dashboard
from mapserver.fleet.rate_limit import RateLimit
from mapserver.serving.bus_service import BusService
from mapserver.serving.live_surveys import LiveSurveys
from support.fleet.memory_bus import MemoryBus
from support.fleet.reports import blindness
from support.fleet.served_api import Server, served_api

MESSAGES = [
    kind
    for module in (messages, failure_summary, live_survey)
    for _, kind in inspect.getmembers(module, inspect.isclass)
    if issubclass(kind, msgspec.Struct) and kind.__module__ == module.__name__
]
FLOATS = (math.inf, -math.inf, math.nan, 1e308, -1e308)
INTEGERS = (1 << 63, (1 << 64) - 1)
EXTREMES = (MOST, -MOST), ((1 << 63) - 1, -(1 << 63), 0)
HEARD = {
    robot_key("lab", "r1", what): kind
    for what, kind in (("ack", RobotAck), ("health", RobotHealth), ("pose", PoseMessage))
}
HEARD[live_survey.live_key("lab")] = LiveSurveyState
NAMES = {"site": "lab", "robot": "r1", "quat_wxyz": [1.0, 0.0, 0.0, 0.0], "version": 1}
PATH = {"site": "lab", "robot": "r1", "version": "1", "number": "1", "failure": "1", "place": "0", "x": "0", "y": "0"}


def whole(kind: types.Type, name: str = "") -> Any:
    """A plain value of a type with all of its fields."""
    match kind:
        case _ if name in NAMES:
            return NAMES[name]
        case types.StructType():
            values = [whole(field.type, field.name) for field in kind.fields]
            return values if kind.array_like else dict(zip((f.name for f in kind.fields), values, strict=True))
        case types.UnionType():
            return whole(kind.types[0], name)
        case types.TupleType():
            return [whole(item) for item in kind.item_types]
        case types.ListType() | types.VarTupleType():
            return [whole(kind.item_type)] * (kind.min_length or 1)
        case types.DictType():
            return {"k": whole(kind.value_type)}
    usual = {types.IntType: 1, types.StrType: "x", types.BytesType: b"\xff\xd8\xff\xd9", types.BoolType: True}
    return usual.get(type(kind), 0.5)


def spoiled(value: Any, floats: tuple[float, ...] = FLOATS, integers: tuple[int, ...] = INTEGERS) -> Iterator[Any]:
    """The value with each of its numbers replaced by each hostile one."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else list(enumerate(value)):
            for other in spoiled(item, floats, integers):
                changed = value.copy()
                changed[key] = other
                yield changed
    elif isinstance(value, float | int) and not isinstance(value, bool):
        yield from floats if isinstance(value, float) else (*floats, *integers)


@pytest.mark.parametrize("kind", MESSAGES, ids=lambda kind: kind.__name__)
def test_a_number_that_none_can_mean_is_refused_where_it_is_decoded(kind: type[msgspec.Struct]) -> None:
    plain = whole(types.type_info(kind))
    decode_message(msgspec.msgpack.encode(plain), kind)
    for changed in spoiled(plain):
        with pytest.raises(FleetmapError):
            decode_message(msgspec.msgpack.encode(changed), kind)
            pytest.fail(f"{changed} was taken")


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(RateLimit, "admits", lambda *_: True)
    with served_api(tmp_path / "store", tmp_path / "inbox") as made:
        install_dashboard(made.client.app, made.store, made.fleet, ApiSettings(), LiveSurveys())
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
    asked = {
        path.removeprefix("/dashboard/") for path, status in found.items() if status == 200 and "dashboard" in path
    }
    assert asked >= {"", "robots", "robots/r1", "trends", "map", "failures", "failures/1", "live"}


def test_no_number_of_a_robot_takes_a_page(server: Server) -> None:
    service, taken = BusService(server.store, server.fleet, server.bus, lambda *_: None), 0
    with MemoryBus(server.bus._hub) as robot:
        for key, kind in HEARD.items():
            for changed in spoiled(whole(types.type_info(kind)), *EXTREMES):
                robot.publish(key, msgspec.msgpack.encode(changed))
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
    listed = server.client.get("/v1/failures").json()["failures"]
    assert [(row["number"], row["x_map_m"]) for row in listed] == [(2, 0.0), (1, 0.0)]
    store, out = str(server.folder), server.folder.parent
    for command in (
        ["export", str(out / "a.jsonl")],
        ["export", str(out / "a.mcap")],
        ["report", str(out / "a.html"), "--site", "lab"],
    ):
        assert CliRunner().invoke(app, ["fleet", *command, "--store", store]).exit_code == 0
    assert "mapserver fleet remove 1" in server.client.get("/dashboard/failures/1").text
    assert CliRunner().invoke(app, ["fleet", "remove", "1", "--store", store]).exit_code == 0
    assert [row["number"] for row in server.client.get("/v1/failures").json()["failures"]] == [2]
    assert server.client.get("/dashboard/failures/1").status_code == 404
