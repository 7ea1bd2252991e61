"""A robot's report travels over the bus to the page of its failure, its verdict to the page of trends and into a file."""

import json
from collections.abc import Iterator

import httpx
import msgspec
import pytest
from playwright.sync_api import Page, expect
from typer.testing import CliRunner

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.encoding import to_json
from fleetmap.messages import Cause, FailureAck, FailureEvidence, encode_message, robot_key
from mapserver.cli import app
from mapserver.fleet.building import keep_areas
from mapserver.store import Actor, MapStore
from support.fleet.dashboard_scene import SITE, Served, failure, fill_store, marks, opened, serving
from support.pages.browser import Chromium

CELLS = (3, 2, 40, 0), (4, 2, 38, 1), (5, 2, 22, 0), (3, -2, 20, 9)
CHANGED = FailureEvidence(96, 33, CELLS, flags=("wheels_refused",))
ALIKE = FailureEvidence(98, 34, (), ((2000, 600, 3, 34), (2000, 1400, 2, 33), (2010, 2200, 2, 30)))
NAME = "Kühlhaus <冷>"
GIVEN = {"tug-1": (Cause.NO_MATCH, 9, None, CHANGED), "tug-2": (Cause.ALIASED, 136, 8.0, ALIKE)}
GIVEN |= {"tug-3": (Cause.DARK, 0, None, FailureEvidence(0, 33, flags=("imu_silent",)))}


@pytest.fixture(scope="module")
def served(browser: Chromium, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("store")
    fill_store(folder)
    ring = [[16, 0], [32, 0], [16, 16], [16, 0]]
    drawn = {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [ring]}, "properties": {"name": NAME}}
    with MapStore.open(folder) as store:
        areas = {"type": "FeatureCollection", "frame": "map", "features": [drawn]}
        keep_areas(store, SITE, to_json(areas), None, Actor("ada"))
    with serving(folder) as server:
        with Bus(server.zenoh).open() as bus:
            for robot, (cause, seen, wrong_m, evidence) in GIVEN.items():
                told = msgspec.structs.replace(failure(robot, "f", cause=cause), evidence=evidence, wrong_by_m=wrong_m)
                report = encode_message(msgspec.structs.replace(told, landmarks_expected=400, landmarks_seen=seen))
                assert bus.get(robot_key(SITE, robot, "failures"), report) == encode_message(FailureAck(id="f"))
        yield server


def test_a_file_has_them(served: Served) -> None:
    file, ask = served.folder / "failures.jsonl", ("fleet", "export", "--format", "verdicts", "--store")
    assert CliRunner().invoke(app, [*ask, str(served.folder), str(file)]).stdout == "5 failures\n"
    said = [json.loads(line)["verdict"]["says"] for line in file.read_text("utf-8").splitlines()]
    assert said == ["unknown", "unknown", "building", "lookalike", "robot"]


def test_missing_landmarks_are_drawn_look_alikes_marked_and_verdicts_collected(page: Page, served: Served) -> None:
    opened(page, served, "failures/1")
    expect(page.locator("#verdict")).to_contain_text("Verdict: not known: the robot reports no evidence.")
    opened(page, served, "failures/3")
    expect(page.locator("#verdict")).to_contain_text("the building is different (92 %)")
    expect(page.locator(".site-map path.cell.removed")).to_have_count(3)
    assert httpx.get(f"{served.http}/v1/failures/3/verdict").json()["says"] == "building"
    opened(page, served, "failures/4")
    places = [(mark["x"], mark["y"]) for mark in marks(page) if mark["shape"] == "triangle"]
    assert places == [(20.0, 14.0), (20.1, 22.0)], "where it believed to be is not another place"
    opened(page, served, "failures/5")
    expect(page.locator("#verdict")).to_contain_text("the robot is wrong (")
    expect(page.locator("#verdict")).to_contain_text("%): imu silent")
    assert httpx.get(f"{served.http}/v1/failures/5/verdict").json()["words"].endswith("%): imu silent")
    asked = httpx.get(f"{served.http}/v1/sites/{SITE}/verdicts").json()
    assert asked == {"1,0": {"building": 1, "lookalike": 1, "robot": 1, "unknown": 2}}
    opened(page, served, "trends")
    expect(page.get_by_role("table", name="Verdicts on failures")).to_contain_text(f"{NAME}1112")
