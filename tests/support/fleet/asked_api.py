"""Questions that are made up after an OpenAPI document, to a server over a filled store."""

import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from fleetmap.messages import CameraNote, Placement, RobotHealth, Thumbnail
from mapserver import releases
from mapserver.api.app import create_app
from mapserver.api.guard import GuardSettings
from mapserver.api.parameters import ApiSettings
from mapserver.drafting.job_lock import log_path
from mapserver.fleet.building import align, ask_for_survey, keep_areas
from mapserver.fleet.fleet import Fleet
from mapserver.floor_plan.pins import parse_pin
from mapserver.operators.operators import Operators
from mapserver.operators.roles import Scope
from mapserver.serving.night_runs import NightRuns
from mapserver.store import Actor, FailureReplay, MapStore
from mapserver.store.files import make_folder
from mapserver.trust import init_here
from mapserver.trust.enrolment import RobotRegister
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.fleet.reports import blindness
from support.storage.map_samples import publish_samples

EXAMPLES = int(os.environ.get("FLEETMAP_API_EXAMPLES", "8"))  # of each operation
CHECKS = (not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance)

PINS = ["a=200,400:0,0", "b=200,0:20,0"]
AREAS = (
    b'{"type":"FeatureCollection","frame":"map","features":[{"type":"Feature","properties":{"name":"a"},'
    b'"geometry":{"type":"Polygon","coordinates":[[[0,0],[1,0],[1,1],[0,0]]]}}]}'
)
THERE = {"site": "hall", "job": 1, "number": 1, "robot": "r1", "operator": "olga", "place": 0, "box": "held"}
POLYGON = [(1.0, 1.0), (3.0, 1.0), (3.0, 3.0)]
FAILURE = blindness(
    site="hall", tile=(0, 0), innovation=4.0, radius_95_m=0.2,
    map_from_base=Placement(position_m=(0.5, 1.0, 0.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0)),
    thumbnails=(Thumbnail(stamp_ns=5, kind="frame", jpeg=b"\xff\xd8\xff\xd9"),),
)  # fmt: skip
LOOKED = msgspec.structs.replace(
    FAILURE, id="f2", version=3, map_from_base=Placement.of(np.eye(4)),
    camera=CameraNote(size_px=(320, 240), focal_px=300.0, centre_px=(159.5, 119.5), base_from_cam=Placement.of(np.eye(4))),
)  # fmt: skip


def ask_operation(
    operation: schemathesis.APIOperation,
    known: dict[str, str],
    headers: dict[str, str],
    chosen: Callable[[str], dict[str, int]],
) -> list[int]:
    """The statuses of the answers to questions made up after the document, some of them about what is there."""
    statuses: list[int] = []

    @settings(max_examples=EXAMPLES, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck))
    @given(case=operation.as_strategy())
    def ask(case: schemathesis.Case) -> None:
        number, path = len(statuses), case.path_parameters
        if number % 2:
            there = THERE | {"name": f"held-{number}.mcap" if "box" in path else f"{number}.mcap"} | known
            there |= dict.fromkeys(("version", "before", "after"), 1 + number % 3)
            path |= {name: there[name] for name in path.keys() & there.keys()} | chosen(operation.label)
        if number % 2 and isinstance(case.body, dict) and "incident" in case.body:
            case.body["incident"] = "failure/hall/1"
        if number % 2 and operation.label.endswith("/estimate"):
            case.query = {"pin": PINS}
        if number % 4 == 3 and isinstance(case.query, dict):  # made-up moments are hardly ever ones
            case.query = {name: value for name, value in case.query.items() if name not in ("since", "until")}
        if number % 2 and isinstance(case.body, dict):
            where = {name: 1.0 for name in ("x_map_m", "y_map_m") if name in case.body}
            where |= {"corners_map_m": POLYGON} if "corners_map_m" in case.body else {}
            if operation.label.endswith("/publish") and number % 4 == 1:  # the gate refuses the draft otherwise
                where |= {"force": True, "reason": "a test"}
            if operation.label.endswith("/rollback") and number % 4 == 1:  # made-up versions are hardly ever right
                where |= {"to": None, "canary": None}
            case.body = case.body | {"actor": "root"} | where
        if number % 2 and operation.label.startswith(("PUT", "DELETE")):
            case.query, case.headers = {"actor": "root"}, {}
            if operation.label.startswith("PUT"):
                kind = next((kind for kind in ("areas", "alignment") if operation.label.endswith(kind)), "recording")
                case.body = {"areas": AREAS, "alignment": b""}.get(kind, b"recording")
                case.query |= {"pin": PINS} if kind == "alignment" else {}
        response = case.call(base_url="http://127.0.0.1", headers=headers)
        case.validate_response(response, checks=list(CHECKS))
        statuses.append(response.status_code)

    ask()
    return statuses


def answers(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    fill: Callable[[MapStore], None],
    chosen: Callable[[str], dict[str, int]] = lambda _: {},
    paths: str = "",
) -> dict[str, list[int]]:
    """The statuses of answers by operation. fill: adds versions from 3 on to site `hall`; chosen: parts of the path that every other
    question to an operation has; paths: a regular expression of those that are asked, all without one.
    """
    now_ns = time.time_ns()
    with MapStore.open(tmp_path, create=True) as store, MemoryBus(MemoryHub()) as bus:
        publish_samples(store, 2, site="hall")
        fill(store)
        store.update_job(store.begin_job("hall", "nightly"), "done", "version 2 is published", {})
        fleet = Fleet(store, clock_ns=lambda: now_ns)  # a robot that was heard stays so
        for failure in (LOOKED, FAILURE):
            assert not fleet.take_failure("hall", "r1", failure).refused
        store.fleet.add_replay(1, FailureReplay(b"summary", b"recording", []), keep_bytes=100)
        releases.start_canary(store, "hall", 1, 0.05)
        releases.roll_back(store, "hall")
        align(store, "hall", [parse_pin(pin) for pin in PINS], None, None, Actor("ada"))
        keep_areas(store, "hall", AREAS, None, Actor("ada"))
        fleet.take_health("hall", "r1", RobotHealth(site="hall", robot="r1", stamp_ns=5, version=1, status="LOST"))
        fleet.flush()
        init_here(store)
        robots = RobotRegister(store)
        robots.authorities.init(["127.0.0.1"], None, None)
        robots.enrol("hall", ["r1"], "tls/127.0.0.1:7447")
        operators = Operators(store)
        operators.add("olga", "viewer", None, Actor("ada"))
        headers = {"Authorization": f"Bearer {operators.make_token('root', Scope, 1, Actor('ada'))}"}
        operators.make_token("ci", ["read"], 1, Actor("ada"))
        known = {
            "asked": ask_for_survey(store, "hall", POLYGON, Actor("ada")).id,
            "token": store.operators.tokens(now_ns)[0].sha256[:12],
        }
        receiver = Mock(**{"test.return_value": (True, "alerts.example accepted it")})
        for number in range(1, 2 * EXAMPLES, 2):
            make_folder(tmp_path / "inbox/hall/held")
            (tmp_path / f"inbox/hall/held/held-{number}.mcap").touch()
        log_path(tmp_path, 1).write_text("reading monday\n")
        nights = NightRuns(store, tmp_path / "inbox")
        monkeypatch.setattr(nights, "start", lambda site, log: store.job(1))
        settings = ApiSettings(GuardSettings(names=frozenset({"testserver"})), webhook=receiver, nights=nights)
        app = create_app(store, fleet, settings, bus=bus)
        schema = schemathesis.openapi.from_asgi("/openapi.json", app, headers=headers)
        found = {
            operation.ok().label: ask_operation(operation.ok(), known, headers, chosen)
            for operation in schema.get_all_operations()
            if re.search(paths, operation.ok().path)
        }
        assert store.verify().faults == []
    return found
