"""The fleet over HTTP: failures, figures, canaries, the re-survey list, metrics."""

import time
from datetime import UTC, datetime, timedelta
from urllib.parse import quote

import pytest
from prometheus_client.parser import text_string_to_metric_families

from fleetmap.messages import FailureReport, RobotAck, RobotHealth, Thumbnail
from mapserver.store import FailureReplay
from support.fleet.reports import blindness
from support.fleet.served_api import Server, check_problem


def failure(number: int, **changes: object) -> FailureReport:
    seen = (Thumbnail(stamp_ns=5, kind="frame", jpeg=b"\xff\xd8picture\xff\xd9"),)
    return blindness(f"f{number}", **{"wall_ns": time.time_ns(), "tile": (0, 0), "thumbnails": seen} | changes)


def test_failures_are_found_by_what_they_are(server: Server) -> None:
    kinds = {}, {"cause": "blur", "tile": (1, 0)}, {"kind": "suspected"}, {"version": None}
    for number, changes in enumerate(kinds, 1):
        assert server.fleet.take_failure("lab", "r1", failure(number, **changes)).refused == ""
    for query, wanted in (
        ("", [4, 3, 2, 1]),
        ("?site=lab&robot=r1&limit=2", [4, 3]),
        ("?limit=2&cursor=3", [2, 1]),
        ("?cause=blur", [2]),
        ("?tile=1,0", [2]),
        ("?version=1&kind=blind", [2, 1]),
        ("?site=other", []),
    ):
        body = server.client.get(f"/v1/failures{query}").json()
        assert [f["number"] for f in body["items"]] == wanted, query
    assert server.client.get("/v1/failures?limit=2").json()["next"] == "3"
    one = server.client.get("/v1/failures/2").json()
    assert (one["failure"]["cause"], one["report"]["id"], one["pictures"][0]["kind"]) == ("blur", "f2", "frame")
    picture = server.client.get("/v1/failures/2/pictures/0")
    assert (picture.content, picture.headers["content-type"]) == (b"\xff\xd8picture\xff\xd9", "image/jpeg")
    assert picture.headers["content-security-policy"] == "default-src 'none'; sandbox"
    assert picture.headers["x-content-type-options"] == "nosniff"
    check_problem(server.client.get("/v1/failures/9"), 404, "failure 9 does not exist")
    check_problem(server.client.get("/v1/failures/2/pictures/7"), 404, "no picture 7")


def test_the_recording_of_a_failure_is_downloaded(server: Server) -> None:
    server.fleet.take_failure("lab", "r1", failure(1))
    check_problem(server.client.get("/v1/failures/1/replay.mcap"), 404, "no recording")
    replay = FailureReplay(b"summary", b"the file", [(5, b"\xff\xd8small\xff\xd9")])
    server.fleet._store.fleet.add_replay(1, replay, 10**9)
    answer = server.client.get("/v1/failures/1/replay.mcap")
    assert (answer.content, answer.headers["content-type"]) == (b"the file", "application/octet-stream")
    assert answer.headers["content-disposition"] == 'attachment; filename="failure-1.mcap"'
    pictures = server.client.get("/v1/failures/1").json()["pictures"]
    assert [picture["kind"] for picture in pictures] == ["frame", "replay"]


def test_figures_by_what_they_are_counted_by(server: Server) -> None:
    for number in range(3):
        server.fleet.take_failure("lab", f"r{number}", failure(number, robot=f"r{number}"))
    body = server.client.get("/v1/fleet/measures?by=robot&limit=2").json()
    told = [(row["site"], row["key"], row["measures"]["failures"]["events"]) for row in body["items"]]
    assert told == [("lab", "r0", 1), ("lab", "r1", 1)]
    rest = server.client.get(f"/v1/fleet/measures?by=robot&cursor={body['next']}").json()
    assert [row["key"] for row in rest["items"]] == ["r2"] and rest["next"] is None
    (hour,) = server.client.get("/v1/sites/lab/hours?by=tile&key=0,0").json()["items"]
    assert hour["measures"]["failures"]["events"] == 3
    assert hour["measures"]["failures"]["per_robot_day"] is None  # nobody drove
    check_problem(server.client.get("/v1/sites/none/hours"), 404, "no site none")
    check_problem(server.client.get("/v1/fleet/measures?by=colour"), 422, "by")


def test_a_canary_begins_and_ends_over_http(server: Server) -> None:
    check_problem(server.client.get("/v1/sites/lab/canary"), 404, "never had a canary")
    server.fleet.take_question("lab", "r1")
    server.fleet.take_ack("lab", "r1", RobotAck(site="lab", robot="r1", stamp_ns=1, version=1))
    canary = "/v1/sites/lab/versions/2/canary"
    begun = server.client.post(canary, json={"actor": "ada", "reason": "new", "share": 0.5})
    assert begun.status_code == 200
    assert (begun.json()["canary"]["version"], begun.json()["canary"]["base_version"]) == (2, 1)
    shown = server.client.get("/v1/sites/lab/canary").json()
    assert shown["finding"]["action"] == "wait" and shown["robots"] == ["r1"]
    (robot,) = server.client.get("/v1/robots").json()["items"]
    assert (robot["wanted_version"], robot["is_canary"], robot["version"]) == (2, True, 1)
    check_problem(server.client.post(canary, json={"actor": "ada"}), 409, "has a canary of version 2")
    check_problem(server.client.post(canary, json={"actor": "ada", "share": 7}), 422, "share")
    assert server.client.post("/v1/sites/lab/rollback", json={"actor": "ada", "reason": "no"}).json()["version"] == 1
    assert server.client.get("/v1/sites/lab/canary").json()["canary"]["state"] == "stopped"


def test_a_resurvey_list_and_its_route(server: Server) -> None:
    nothing = {"site": "lab", "version": 1, "tiles": [], "route": [], "requests": [], "courses": []}
    assert server.client.get("/v1/sites/lab/resurvey").json() == nothing
    assert server.client.get("/v1/sites/lab/resurvey/route").json()["type"] == "FeatureCollection"
    check_problem(server.client.get("/v1/sites/none/resurvey"), 404, "no site none")


def test_metrics_are_what_prometheus_reads(server: Server) -> None:
    server.fleet.take_failure("lab", "r1", failure(1))
    server.fleet.take_failure("lab", "r1", failure(2, kind="suspected", cause='x\n"y\\'))
    for step in range(4):
        metrics = {"speed_mps": 1.0, "frames": 10 * step}
        health = RobotHealth(
            site="lab", robot="r1", stamp_ns=step * 10**9, wall_ns=time.time_ns() + (5 + step) * 10**9, version=1,
            status="TRACKING", metrics=metrics,
        )  # fmt: skip
        server.fleet.take_health("lab", "r1", health)
    server.fleet.flush()
    found = {
        (sample.name, *(sample.labels[name] for name in sorted(sample.labels, reverse=True))): sample.value
        for family in text_string_to_metric_families(server.client.get("/metrics").text)
        for sample in family.samples
    }
    assert found["fleetmap_site_failures_total", "lab"] == 1
    assert found["fleetmap_site_silent_failures_estimated_total", "lab"] == 1
    assert found["fleetmap_site_driving_seconds_total", "lab"] == pytest.approx(3, abs=0.5)
    assert found["fleetmap_site_frames_total", "lab"] == 30
    assert found["fleetmap_version_failures_total", "1", "lab"] == 1
    assert found["fleetmap_site_cause_failures_total", "lab", 'x\n"y\\'] == 1
    assert found["fleetmap_site_robots_status", "TRACKING", "lab"] == 1
    assert found["fleetmap_site_clock_skew_max_seconds", "lab"] == pytest.approx(8.0, abs=0.5)


QUOTES = ("' OR 1=1 --", '" OR "" = "', "lab'; DROP TABLE failures; --", "%", "_", "lab\x00", "1 UNION SELECT 1")


@pytest.mark.parametrize("words", QUOTES)
def test_row_29_quotes_in_every_filter(server: Server, words: str) -> None:
    """A filter with SQL in it finds nothing, and nothing is lost."""
    assert server.fleet.take_failure("lab", "r1", failure(1)).refused == ""
    names = ("site", "robot", "version", "tile", "cause", "kind", "cursor", "limit", "by", "key", "hours")
    for path in ("failures", "jobs", "robots", "fleet/measures", "sites/lab/hours", "sites/lab/events"):
        for name in names:
            answer = server.client.get(f"/v1/{path}", params={name: words})
            assert answer.status_code < 500, (path, name)
            if path == "failures" and name in ("site", "robot", "cause", "kind") and answer.status_code == 200:
                assert answer.json()["items"] == [], name
    for path in (f"/v1/sites/{quote(words)}/versions", f"/v1/failures/{quote(words)}", f"/v1/tiles/{quote(words)}"):
        assert server.client.get(path).status_code in (404, 422)
    found = server.client.get("/v1/failures").json()["items"]
    assert [row["robot"] for row in found] == ["r1"]
    # The control: where the words become part of the statement, they find it.
    if "OR 1=1" in words:
        rows = server.store._database.query(f"SELECT robot FROM failures WHERE cause = '{words}'")
        assert rows == [{"robot": "r1"}]


def test_a_range_of_time_is_kept_to_and_nothing_is_ignored(server: Server) -> None:
    server.fleet.take_failure("lab", "r1", failure(1))
    hour = timedelta(hours=1)
    now = datetime.now(UTC)
    before, after = ((now + step).isoformat() for step in (-hour, hour))
    (shown,) = server.client.get("/v1/failures", params={"since": before, "until": after}).json()["items"]
    assert isinstance(shown["happened_ns"], str), "a number above 2^53 is another one to many programs"
    assert abs(int(shown["happened_ns"]) - time.time_ns()) < 60 * 10**9
    assert server.client.get("/v1/failures", params={"since": after}).json()["items"] == []
    for address in ("/v1/fleet/measures", "/v1/sites/lab/hours"):
        assert len(server.client.get(address, params={"since": before, "until": after}).json()["items"]) == 1
        old = {"since": (now - 50 * hour).isoformat(), "until": (now - 48 * hour).isoformat()}
        assert server.client.get(address, params=old).json()["items"] == []
    assert server.client.get("/v1/sites/lab/events", params={"until": before}).json()["items"] == []
    events = server.client.get("/v1/sites/lab/events", params={"since": before}).json()["items"]
    assert events
    assert all(isinstance(event["stamp_ns"], str) for event in events)
    check_problem(server.client.get("/v1/failures?since=soon"), 422, "since 'soon' is an invalid time")
    check_problem(server.client.get("/v1/failures?since=2026-01-02&until=2026-01-01T00:00"), 422, "exchange them")
    check_problem(server.client.get("/v1/failures?sinc=2026-01-01"), 422, "unknown query parameter 'sinc'; this")
    check_problem(server.client.get("/v1/sites?site=lab"), 422, "knows cursor, limit")
    check_problem(server.client.get("/healthz?x=1"), 422, "this address has none")
    kind = server.client.get("/openapi.json").json()["components"]["schemas"]["FailureRow"]["properties"]["happened_ns"]
    assert (kind["type"], kind["pattern"]) == ("string", "^-?[0-9]+$")
