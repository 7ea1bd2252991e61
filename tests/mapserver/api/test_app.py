"""The HTTP API: answers, validators, ranges, problem documents."""

import hashlib
from datetime import datetime, timedelta
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import psutil
import pytest

from fleetmap.errors import StoreError
from fleetmap.mapformat.manifest import decode_manifest
from fleetmap.mapformat.names import blob_path, sha256_hex
from fleetmap.mapformat.tile import TILE_FORMAT, decode_tile
from fleetmap.messages import RobotAck, RobotHealth, Thumbnail
from mapserver.api import fleet_routes
from mapserver.quality.figures import Evidence, RigEvidence
from mapserver.store import DraftContent
from mapserver.trust import init_here
from mapserver.trust.enrolment import RobotRegister
from support.fleet.reports import blindness
from support.fleet.served_api import Server, check_problem
from support.storage.map_samples import draft_details, random_tile, save_sample_draft


def test_lists(server: Server) -> None:
    sites = server.client.get("/v1/sites").json()["items"]
    assert [(site["site"], site["current_version"], site["versions"]) for site in sites] == [("lab", 1, 2)]
    versions = server.client.get("/v1/sites/lab/versions").json()["items"]
    assert [(v["version"], v["state"], v["parent"]) for v in versions] == [(1, "current", None), (2, "draft", 1)]
    current = server.client.get("/v1/sites/lab/current").json()
    assert current == versions[0]
    assert current["map_bytes"] == server.store.version("lab", 1).map_bytes


def test_manifests_and_blobs_are_the_stored_bytes(server: Server) -> None:
    response = server.client.get("/v1/sites/lab/versions/1")
    assert response.headers["content-type"] == "application/json"
    assert sha256_hex(response.content) == server.store.version("lab", 1).manifest_sha256
    manifest = decode_manifest(response.content)
    for entry in manifest.tiles:
        tile = server.client.get(f"/v1/tiles/{entry.sha256}")
        assert sha256_hex(tile.content) == entry.sha256
        assert "immutable" in tile.headers["cache-control"]
        assert len(decode_tile(tile.content)) == entry.landmarks
    assert server.client.get(f"/v1/vocabularies/{manifest.vocabulary.sha256}").content == b"words" * 50


def test_etag(server: Server) -> None:
    url, etag = f"/v1/tiles/{server.tile}", f'"{server.tile}"'
    assert server.client.get(url).headers["etag"] == etag
    for condition in (etag, f"W/{etag}", f'"other", {etag}', "*"):
        response = server.client.get(url, headers={"If-None-Match": condition})
        assert (response.status_code, response.content, response.headers["etag"]) == (304, b"", etag)
    assert server.client.get(url, headers={"If-None-Match": '"other"'}).status_code == 200
    head = server.client.head(url)
    assert (head.status_code, head.content) == (200, b"")
    assert int(head.headers["content-length"]) == server.store.manifest("lab", 1).tiles[0].bytes


@pytest.mark.parametrize(
    ("header", "start", "end"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=10-19", 10, 20),
        ("bytes=100-", 100, None),
        ("bytes=-7", -7, None),
        ("bytes=5-99999999", 5, None),
        ("bytes=-99999999", 0, None),
    ],
)
def test_ranges(server: Server, header: str, start: int, end: int | None) -> None:
    url = f"/v1/tiles/{server.tile}"
    whole = server.client.get(url).content
    response = server.client.get(url, headers={"Range": header})
    assert response.status_code == 206
    assert response.content == whole[start:end]
    first = start % len(whole) if start < 0 else start
    assert response.headers["content-range"] == f"bytes {first}-{first + len(response.content) - 1}/{len(whole)}"


def test_ranges_that_cannot_be_or_need_not_be_served(server: Server) -> None:
    url = f"/v1/tiles/{server.tile}"
    size = len(server.client.get(url).content)
    for header in (f"bytes={size}-", "bytes=-0"):
        response = server.client.get(url, headers={"Range": header})
        check_problem(response, 416, "outside")
        assert response.headers["content-range"] == f"bytes */{size}"
    for headers in (
        {"Range": "bytes=5-2"},
        {"Range": "bytes=0-1,3-4"},
        {"Range": "lines=0-1"},
        {"Range": "bytes=-"},
        {"Range": "bytes=0-1", "If-Range": '"other"'},
    ):
        response = server.client.get(url, headers=headers)
        assert (response.status_code, len(response.content)) == (200, size)


def test_problems(server: Server) -> None:
    get = server.client.get
    check_problem(get("/v1/sites/nowhere/versions"), 404, "no site nowhere")
    check_problem(get("/v1/sites/..%2Fetc/current"), 404, "")
    check_problem(get("/v1/sites/Lab/current"), 422, "site")
    check_problem(get("/v1/sites/lab/versions/9"), 404, "no version 9")
    check_problem(get("/v1/sites/lab/versions/x"), 422, "version")
    check_problem(get("/v1/tiles/zz"), 422, "sha256")
    check_problem(get("/v1/tiles/" + "0" * 64), 404, "no published tile")
    check_problem(get("/nowhere"), 404, "")
    check_problem(server.client.post("/v1/sites"), 405, "")
    save_sample_draft(server.store, site="new")
    check_problem(get("/v1/sites/new/current"), 404, "no published version")


def test_archives_drafts_and_other_kinds_are_not_served(server: Server) -> None:
    info = server.store.version("lab", 1)
    draft = server.store.manifest("lab", 2).tiles[0].sha256
    for sha256 in (info.archive_sha256, info.manifest_sha256, info.vocabulary_sha256, draft):
        check_problem(server.client.get(f"/v1/tiles/{sha256}"), 404, "no published tile")


def test_damaged_and_missing_bytes_are_server_errors(server: Server) -> None:
    path = server.folder / blob_path(server.tile)
    path.write_bytes(path.read_bytes() + b"x")
    check_problem(server.client.get(f"/v1/tiles/{server.tile}"), 500, "damaged")
    path.unlink()
    check_problem(server.client.get(f"/v1/tiles/{server.tile}"), 503, "cannot be read")


def test_an_unexpected_fault_is_a_problem_too(server: Server, monkeypatch) -> None:
    monkeypatch.setattr(server.store, "sites", Mock(side_effect=ZeroDivisionError("secret")))
    response = server.client.get("/v1/sites")
    check_problem(response, 500, "internal error")
    assert "secret" not in response.text


def test_robots(server: Server) -> None:
    assert server.client.get("/v1/robots").json() == {"items": [], "next": None}
    server.fleet.take_ack("lab", "r1", RobotAck(site="lab", robot="r1", stamp_ns=1, version=1))
    server.fleet.take_health("lab", "r1", RobotHealth(site="lab", robot="r1", stamp_ns=2, version=1, status="TRACKING"))
    (robot,) = server.client.get("/v1/robots").json()["items"]
    assert (robot["robot"], robot["site"], robot["version"], robot["wanted_version"]) == ("r1", "lab", 1, 1)
    assert robot["last_health"]["status"] == "TRACKING"
    assert 0 <= robot["seconds_since"] < 60
    assert server.client.get("/v1/robots?site=other").json() == {"items": [], "next": None}


def test_service_endpoints(server: Server) -> None:
    assert server.client.get("/healthz").json() == {"status": "ok"}
    assert server.client.get("/readyz").json() == {"status": "ok"}
    assert server.client.get("/version").json()["tile_format"] == TILE_FORMAT
    server.bus.close()
    check_problem(server.client.get("/readyz"), 503, "bus")


def test_the_server_says_how_it_is(server: Server, monkeypatch) -> None:
    init_here(server.store)
    RobotRegister(server.store).authorities.init(["localhost"], None, None)
    jpeg = b"\xff\xd8" + bytes(3000) + b"\xff\xd9"
    failure = blindness(thumbnails=(Thumbnail(stamp_ns=5, kind="frame", jpeg=jpeg),))
    assert not server.fleet.take_failure("lab", "r1", failure).refused
    found = server.client.get("/v1/server").json()
    used = found["store"]
    blobs = (path for path in (server.folder / "blobs").rglob("*") if path.is_file())
    assert used["maps_bytes"] == sum(path.stat().st_size for path in blobs)
    assert (used["pictures_bytes"], used["recordings_bytes"]) == (len(jpeg), 0)
    database = sum(path.stat().st_size for path in server.folder.glob("store.sqlite3*"))
    assert used["database_bytes"] == database - len(jpeg)
    assert 0 < found["disk"]["free_bytes"] < found["disk"]["total_bytes"]
    assert abs(found["memory_bytes"] / psutil.Process().memory_info().rss - 1) < 0.2
    days = {each["name"]: round(each["days_left"]) for each in found["endings"]}
    assert days == {
        "servers-ca.crt": 3650, "robots-ca.crt": 1825, "server.pem": 397, "root": 730, "targets": 365, "snapshot": 7,
        "timestamp": 1, "site-lab": 14,
    }  # fmt: skip
    assert found["retention"]["failure_days"] == 400.0
    server.fleet.storage_fault = "no space left on device"
    monkeypatch.setattr(server.store._blobs, "total_bytes", lambda: 1 / 0)
    again = server.client.get("/v1/server").json()
    assert again["storage_fault"] == "no space left on device"
    assert again["store"] == used, "files are counted now and then"


def test_readyz_says_when_reports_cannot_be_stored(server: Server, monkeypatch) -> None:
    refuse = Mock(side_effect=StoreError("no space left on device"))
    server.fleet.take_health("lab", "r1", RobotHealth(site="lab", robot="r1", stamp_ns=1, version=1, status="LOST"))
    with monkeypatch.context() as full:
        full.setattr(server.store.fleet, "add", refuse)
        with pytest.raises(StoreError):
            server.fleet.flush()
        check_problem(server.client.get("/readyz"), 503, "no space left on device")
    server.fleet.flush()
    assert server.client.get("/readyz").status_code == 200
    with monkeypatch.context() as full:
        full.setattr(server.store, "record_robot_report", refuse)
        server.fleet.flush()  # nothing to write says nothing
        with pytest.raises(StoreError):
            server.fleet.take_ack("lab", "r1", RobotAck(site="lab", robot="r1", stamp_ns=1, version=1))
        server.fleet.flush()
        check_problem(server.client.get("/readyz"), 503, "cannot be stored")


def test_a_page_of_robots_has_a_bounded_size(server: Server, monkeypatch) -> None:
    metrics = {f"m{n}": "x" * 2000 for n in range(25)}
    for number in range(120):
        name = f"r{number:03d}"
        report = RobotHealth(site="lab", robot=name, stamp_ns=1, version=1, status="LOST", metrics=metrics)
        server.fleet.take_health("lab", name, report)
    names, cursor, pages = [], "", 0
    while cursor is not None:
        answer = server.client.get("/v1/robots?limit=1000" + (f"&cursor={cursor}" if cursor else ""))
        assert len(answer.content) < 4_500_000
        names += [robot["robot"] for robot in answer.json()["items"]]
        cursor, pages = answer.json()["next"], pages + 1
    assert names == [f"r{number:03d}" for number in range(120)]
    assert pages == 2
    monkeypatch.setattr(fleet_routes, "_MAX_PAGE_BYTES", 1 << 40)
    assert len(server.client.get("/v1/robots?limit=1000").content) > 6_000_000, "the control"


def test_metrics(server: Server) -> None:
    for path in ("/v1/sites/lab/current", "/v1/sites/nowhere/current", "/made/up/1", "/made/up/2"):
        server.client.get(path)
    server.client.request("BREW", "/v1/sites")
    text = server.client.get("/metrics").text
    assert 'fleetmap_http_requests_total{method="GET",route="/v1/sites/{site}/current",status="404"} 1.0' in text
    assert 'fleetmap_http_requests_total{method="GET",route="other",status="404"} 2.0' in text
    assert 'method="other"' in text
    assert "made" not in text
    assert 'fleetmap_site_current_version{site="lab"} 1.0' in text


def test_no_page_names_an_address_outside(server: Server) -> None:
    assert server.client.get("/docs").status_code == 404
    assert server.client.get("/redoc").status_code == 404
    document = server.client.get("/openapi.json")
    assert "http" not in document.text.replace('"type":"http"', "")
    assert "/v1/tiles/{sha256}" in document.json()["paths"]


ADA = {"actor": "ada", "reason": "aisle 3"}


def test_an_operator_publishes_promotes_and_rolls_back(server: Server) -> None:
    post = server.client.post
    assert post("/v1/sites/lab/versions/2/publish", json=ADA).json()["state"] == "current"
    assert post("/v1/sites/lab/versions/1/promote", json=ADA).json()["state"] == "current"
    assert server.store.current("lab").version == 1
    assert post("/v1/sites/lab/rollback", json=ADA).json()["version"] == 2
    events = server.client.get("/v1/sites/lab/events").json()["items"]
    told = [(event["kind"], event["version"]) for event in events[-3:]]
    assert told == [("published", 2), ("promoted", 1), ("rolled_back", 2)]
    assert {(event["actor"], event["reason"]) for event in events[-3:]} == {("ada", "aisle 3")}
    check_problem(post("/v1/sites/lab/versions/1/publish", json=ADA), 409, "only a draft")
    check_problem(post("/v1/sites/lab/versions/9/promote", json=ADA), 404, "no version 9")
    check_problem(post("/v1/sites/lab/rollback", json={}), 422, "actor")
    check_problem(post("/v1/sites/lab/rollback", json=ADA | {"to": 2}), 409, "no longer leads to version 2")
    check_problem(post("/v1/sites/lab/rollback", json=ADA | {"also": 1}), 422, "also")


def test_a_refused_draft_stays_with_its_reasons_and_can_be_forced(server: Server) -> None:
    thin = random_tile(np.random.default_rng(5), landmarks=10, cell=(0, 0))
    server.store.save("lab", DraftContent(tiles=[thin], vocabulary=b"words" * 50, details=draft_details(path_m=9.0)))
    url = "/v1/sites/lab/versions/3"
    check_problem(server.client.post(f"{url}/publish", json=ADA), 409, "number of landmarks")
    quality = server.client.get(f"{url}/quality").json()
    assert (quality["state"], quality["report"]) == ("draft", {"path_m": 9.0})
    (verdict,) = quality["verdicts"]
    assert not verdict["accepted"] and len(verdict["reasons"]) == 2
    assert "held_out_frames" in verdict["report"]["not_judged"]
    check_problem(server.client.post(f"{url}/publish", json={"actor": "ada", "force": True}), 422, "reason")
    assert server.client.post(f"{url}/publish", json=ADA | {"force": True}).json()["state"] == "current"
    assert server.client.get(f"{url}/quality").json()["verdicts"][-1]["forced"]


def test_an_operator_trusts_a_calibration_over_http(server: Server) -> None:
    evidence = Evidence(calibrations=[RigEvidence("a1", not_judged={"metric scale": "drive curves"})])
    tile = random_tile(np.random.default_rng(5), cell=(0, 0))
    server.store.save("yard", DraftContent(tiles=[tile], vocabulary=b"w", details=draft_details(), evidence=evidence))
    url = "/v1/sites/yard/versions/1"
    check_problem(server.client.post(f"{url}/publish", json=ADA), 409, "--trust-calibration")
    check_problem(server.client.post(f"{url}/publish", json={"actor": "ada", "trust_calibration": True}), 422, "reason")
    published = server.client.post(f"{url}/publish", json=ADA | {"trust_calibration": True}).json()
    choice = {"rig": "a1", "subjects": ["metric scale"], "actor": "ada", "reason": "aisle 3"}
    assert (published["state"], published["trusted_calibrations"]) == ("current", [choice])
    assert server.client.get(f"{url}/quality").json()["trusted_calibrations"] == [choice]
    (listed,) = server.client.get("/v1/sites/yard/versions").json()["items"]
    assert listed["trusted_calibrations"] == server.client.get(url).json()["configuration"]["trusted_calibrations"]


def test_lists_come_in_pages(server: Server) -> None:
    for seed in range(3, 6):
        save_sample_draft(server.store, seed=seed)
    for site in ("hall", "yard"):
        save_sample_draft(server.store, site=site)
        server.store.update_job(server.store.begin_job(site, "nightly"), "failed", "the disk is full", {})
    for number in range(3):
        server.store.update_job(server.store.begin_job("lab", "nightly"), "done", f"night {number}", {})
    for path in ("/v1/sites", "/v1/sites/lab/versions", "/v1/jobs", "/v1/alerts"):
        whole = server.client.get(path).json()
        assert whole["next"] is None
        got, cursor = [], None
        while cursor is not None or not got:
            question = {"limit": 1} | ({} if cursor is None else {"cursor": cursor})
            answer = server.client.get(path, params=question).json()
            assert len(answer["items"]) == 1
            got += answer["items"]
            cursor = answer["next"]
        assert len(got) > 1
        assert [one | {"since_ns": 0} for one in got] == [one | {"since_ns": 0} for one in whole["items"]]
    assert {"hall", "yard"} <= {alert["site"] for alert in got if alert["words"].startswith("the night of")}
    jobs = server.client.get("/v1/jobs?site=lab").json()["items"]
    assert [job["message"] for job in jobs] == ["night 2", "night 1", "night 0"]
    assert server.client.get(f"/v1/jobs/{jobs[0]['id']}").json() == jobs[0]
    check_problem(server.client.get("/v1/jobs/99"), 404, "job 99 does not exist")
    begun = jobs[0]["started"]
    assert server.client.get("/v1/jobs", params={"site": "lab", "since": begun}).json()["items"][0] == jobs[0]
    assert server.client.get("/v1/jobs", params={"site": "lab", "until": jobs[-1]["started"]}).json()["items"] == []
    later = f"{datetime.fromisoformat(begun) + timedelta(seconds=1):%Y-%m-%dT%H:%M:%SZ}"
    assert server.client.get("/v1/jobs", params={"site": "lab", "since": later}).json()["items"] == []
    assert server.client.get("/v1/jobs", params={"site": "lab", "until": later}).json()["items"][0] == jobs[0]
    check_problem(server.client.get("/v1/jobs?since=soon"), 422, "is an invalid time")
    check_problem(server.client.get("/v1/sites?limit=0"), 422, "limit")


def test_a_difference_names_bytes_and_quality(server: Server) -> None:
    found = server.client.get("/v1/sites/lab/versions/1/diff/2").json()
    assert (found["tiles_changed"], found["tiles_kept"]) == (2, 0)
    assert found["fetch_bytes"] + 250 == found["full_bytes"]  # all but the vocabulary
    assert found["quality"] == {"path_m": {"before": 12.5, "after": 12.5}}


def test_the_document_has_problems_and_examples_of_paths(server: Server) -> None:
    paths = server.client.get("/openapi.json").json()["paths"]
    for path, operations in paths.items():
        for operation in operations.values():
            assert "4XX" in operation["responses"] and "422" not in operation["responses"]
            for parameter in operation.get("parameters", []):
                shown = parameter.get("example") or parameter["schema"].get("examples")
                assert parameter["in"] != "path" or shown, f"{path}: {parameter['name']} has no example"


def test_a_version_is_one_file_under_an_address_that_stays(server: Server, tmp_path: Path) -> None:
    answer = server.client.get("/v1/sites/lab/versions/1/file")
    assert answer.headers["etag"] == f'"{hashlib.sha256(answer.content).hexdigest()}"'
    server.store.export_version("lab", 1, tmp_path / "file", archive=False)
    assert answer.content == (tmp_path / "file").read_bytes()
    head = server.client.head("/v1/sites/lab/versions/1/file")
    assert head.headers["content-length"] == str(len(answer.content))
    again = server.client.get("/v1/sites/lab/versions/1/file", headers={"If-None-Match": f"W/{answer.headers['etag']}"})
    assert again.status_code == 304
    check_problem(server.client.get("/v1/sites/lab/versions/2/file"), 409, "is a draft")
    check_problem(server.client.get("/v1/sites/lab/versions/9/file"), 404, "no version 9")
