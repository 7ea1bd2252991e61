"""Surveys that people ask for: kept with the site, first on the list, and gone when they are done."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fleetmap.errors import StateError, UsageError
from fleetmap.sensors.samples import Trajectory
from mapserver import releases
from mapserver.cli import app
from mapserver.drafting.draft import covered_requests
from mapserver.fleet import building as requests
from mapserver.fleet.building import ask_for_survey, end_request
from mapserver.fleet.resurvey_list import resurvey_list
from mapserver.fleet_statistics.resurvey_decision import ResurveySettings
from mapserver.floor_plan.survey_requests import SurveyRequest
from mapserver.store import Actor, DraftContent, MapStore
from mapserver.survey.merge.multi_session import MergedMap
from support.fleet.dashboard_scene import SITE, fill_store, hall_tiles
from support.fleet.served_api import check_problem, served_api
from support.storage.map_samples import draft_details, random_survey, save_sample_draft

ADA = Actor("ada", "racks were moved")
AISLE = [(14.0, 2.0), (20.0, 2.0), (20.0, 10.0), (14.0, 10.0)]


@pytest.fixture
def store(tmp_path: Path) -> Iterator[MapStore]:
    fill_store(tmp_path / "store")
    with MapStore.open(tmp_path / "store") as opened:
        yield opened


@pytest.mark.parametrize(
    ("corners", "tiles"),
    [
        (AISLE, [(0, 0), (1, 0)]),
        ([(1.0, 1.0), (1.5, 1.0), (1.2, 1.4)], [(0, 0)]),
        ([(-1.0, -1.0), (17.0, -1.0), (-1.0, 17.0)], [(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 0), (1, -1)]),
    ],
)
def test_tiles_of_a_polygon(corners: list[tuple[float, float]], tiles: list[tuple[int, int]]) -> None:
    assert SurveyRequest("0", 0, "", "", [list(corner) for corner in corners]).tiles(16.0) == tiles


def test_a_request_is_read_once(store: MapStore, monkeypatch) -> None:
    """Every robot asks for all of them again and again, and they may be in an object store."""
    made = [ask_for_survey(store, SITE, AISLE, ADA) for _ in range(2)]
    assert store.survey_requests(SITE) == made
    monkeypatch.setattr(store._blobs, "get", lambda _: pytest.fail("read again"))
    assert store.survey_requests(SITE) == made
    end_request(store, SITE, made[0].id, ADA)
    assert store.survey_requests(SITE) == made[1:]
    assert [store.survey_requests(name) for name in ("nowhere", "elsewhere")] == [[], []]


def test_what_is_asked_for_leads_the_list_until_it_is_done(store: MapStore, tmp_path: Path) -> None:
    def listed() -> list[tuple[str, str]]:
        found = resurvey_list(store, SITE, ResurveySettings(), store.now_ns())
        assert {point.tile for point in found.route} == {concern.tile for concern in found.tiles}
        return [(concern.tile, "; ".join(concern.reasons)) for concern in found.tiles]

    assert listed() == []
    made = ask_for_survey(store, SITE, AISLE, ADA)
    assert [tile for tile, _ in listed()] == ["0,0", "1,0"]
    assert all("ada asked for it on " in why and "racks were moved" in why for _, why in listed())
    shown = CliRunner().invoke(app, ["fleet", "resurvey", "--site", SITE, "--store", str(tmp_path / "store")])
    assert f"request {made.id} of ada: 4 corners, racks were moved" in shown.output
    with MapStore.open(tmp_path / "store") as again:
        assert again.survey_requests(SITE) == [made], "another process sees it"
    sha256 = store.site_file_sha256(SITE, requests.KIND + made.id)
    assert store.served_kind(sha256) is None, "no robot fetches it"
    assert store.collect_garbage().files == 0 or store.survey_requests(SITE) == [made]
    assert store.survey_requests(SITE) == [made]
    end_request(store, SITE, made.id, ADA)
    assert (listed(), store.survey_requests(SITE)) == ([], [])
    told = [(event.kind, event.actor) for event in store.events(SITE)[-2:]]
    assert told == [(f"survey request {made.id}", "ada")] * 2
    with pytest.raises(UsageError, match="may be closed already"):
        end_request(store, SITE, made.id, ADA)


def test_a_published_survey_of_it_ends_it(store: MapStore) -> None:
    """Expected: a version whose recordings covered nine tenths ends the request when it is published, not when it is built."""
    half, whole = (ask_for_survey(store, SITE, [(x, 2.0), (x + 6, 2.0), (x, 9.0)], ADA).id for x in (10.0, 30.0))
    said = {half: 0.6, whole: 0.95, "ffffffff": 1.0, "x": "1"}
    details = draft_details(path_m=213.0, surveyed_requests=said)
    content = DraftContent(tiles=hall_tiles(), vocabulary=b"words" * 50, details=details)
    version = store.save(SITE, content).version
    assert {request.id for request in store.survey_requests(SITE)} == {half, whole}
    releases.publish(store, SITE, version)
    assert [request.id for request in store.survey_requests(SITE)] == [half]
    (event,) = (event for event in store.events(SITE)[-3:] if event.kind == f"survey request {whole}")
    assert event.detail == f"done: version {version} surveyed 95% of its places"
    releases.roll_back(store, SITE)
    assert [request.id for request in store.survey_requests(SITE)] == [half]


def test_what_a_build_covers_is_where_its_new_recordings_drove(store: MapStore) -> None:
    survey = random_survey(np.random.default_rng(2), keyframes=46)  # along x from -20 m to 25 m
    boxes = ([(x, -9.0), (x + 10, -9.0), (x + 10, 9.0), (x, 9.0)] for x in (-15.0, 10.0))
    asked = [ask_for_survey(store, SITE, box, ADA) for box in boxes]
    way = survey.trajectory

    def covered(*spans: tuple[int, int, int]) -> dict[str, float]:
        parts = [Trajectory(way.stamps_ns[a:b] + since_ns, way.frame_from_body[a:b]) for a, b, since_ns in spans]
        names = ("stamps_ns", "frame_from_body")
        whole = Trajectory(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
        joined = MergedMap(replace(survey, trajectory=whole), (), tuple(parts), ())
        return covered_requests(store, SITE, joined)

    first, second = (request.id for request in asked)
    assert covered((0, 46, 0)) == {first: 1.0, second: 1.0}
    assert covered((0, 20, 0)) == {first: 1.0}
    assert covered((30, 36, 0))[second] == pytest.approx(0.6, abs=0.21)
    before_ns, after_ns = asked[0].asked_ns - 3600 * 10**9, asked[0].asked_ns + 3600 * 10**9
    # What was recorded before it counts for nothing.
    assert covered((0, 20, before_ns), (30, 46, after_ns)) == {second: 1.0}


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        ([(0.0, 0.0), (1.0, 1.0)], "corners"),
        ([(0.0, 0.0), (4.0, 4.0), (4.0, 0.0), (0.0, 4.0)], "cross"),
        ([(0.0, 0.0), (900.0, 0.0), (0.0, 9.0)], "draw several"),
        ([(float(n), float(n * n)) for n in range(300)], "3 to 200"),
    ],
)
def test_what_is_no_polygon_is_refused(store: MapStore, corners: list[tuple[float, float]], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        ask_for_survey(store, SITE, corners, ADA)
    assert store.survey_requests(SITE) == []


def test_limits(store: MapStore, monkeypatch) -> None:
    monkeypatch.setattr(requests, "MOST_REQUESTS", 1)
    ask_for_survey(store, SITE, AISLE, ADA)
    with pytest.raises(StateError, match="open requests"):
        ask_for_survey(store, SITE, AISLE, ADA)
    save_sample_draft(store, site="yard")
    with pytest.raises(StateError, match="no published map"):
        ask_for_survey(store, "yard", AISLE, ADA)
    with pytest.raises(UsageError, match="no site nowhere"):
        ask_for_survey(store, "nowhere", AISLE, ADA)
    releases.publish(store, "yard")
    assert store.survey_requests("yard") == []


def test_over_http(tmp_path: Path) -> None:
    path = "/v1/sites/lab/resurvey"
    with served_api(tmp_path) as server:
        asked = {"actor": "ada", "reason": "seen", "corners_map_m": [[1, 1], [3, 1], [3, 3]]}
        made = server.client.post(f"{path}/requests", json=asked).json()
        assert made["corners_map_m"] == asked["corners_map_m"]
        found = server.client.get(path).json()
        assert [request["id"] for request in found["requests"]] == [made["id"]]
        assert found["tiles"][0]["tile"] == "0,0"
        wrong = asked | {"corners_map_m": [[1, 1]]}
        check_problem(server.client.post(f"{path}/requests", json=wrong), 422, "corners_map_m")
        check_problem(server.client.post(f"{path}/requests/00000000/end", json={"actor": "ada"}), 404, "may be closed")
        assert server.client.post(f"{path}/requests/{made['id']}/end", json={"actor": "ada"}).json() == {"status": "ok"}
        assert server.client.get(path).json()["requests"] == []
