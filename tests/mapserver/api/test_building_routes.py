"""Areas and alignment over HTTP, with the commands as the other side."""

import json

import anyio
import cv2
import httpx
import numpy as np
import pytest
from typer.testing import CliRunner

from mapserver.cli import app
from support.drawn_areas import geojson
from support.fleet.served_api import Server, check_problem, raw_put

AREAS, ALIGNMENT = "/v1/sites/lab/areas", "/v1/sites/lab/alignment"
END = {"type": "http.request", "body": b"x"}
ADA = {"actor": "ada", "reason": "racks were moved"}
# The map's x axis points up in the picture, 0.05 m a pixel, its origin at 10, -20 m.
PINS = ["a=200,400:0,0", "b=200,0:20,0", "c=0,400:0,10"]


def drawn(*names: str, frame: str = "map", **properties: object) -> bytes:
    return geojson(*({"name": name, "box": (0, 0, 4, 3)} | properties for name in names), frame=frame)


def put(server: Server, content: bytes, **headers: str) -> httpx.Response:
    return server.client.put(AREAS, params=ADA, content=content, headers=headers)


def listed(server: Server) -> str:
    found = CliRunner().invoke(app, ["areas", "list", "--site", "lab", "--store", str(server.folder)])
    return found.output


def test_areas_are_replaced_and_removed_as_by_the_command(server: Server) -> None:
    kept = put(server, drawn("aisle 5", "gate", mask="speed", percent=30))
    assert kept.json() == server.client.get(AREAS).json()
    assert listed(server) == "aisle 5: 12.0 m2, speed 30 %\ngate: 12.0 m2, speed 30 %\n2 areas\n"
    assert put(server, json.dumps(kept.json()).encode()).json() == kept.json(), "an answer is a file"
    put(server, drawn("aisle 6", "gate"))
    assert server.client.request("DELETE", AREAS, params=ADA).json() == {"status": "ok"}
    assert listed(server) == "0 areas\n"
    told = [(event.detail, event.actor, event.reason) for event in server.store.events("lab") if event.kind == "areas"]
    done = ("added aisle 5, gate", "changed", "added aisle 6; removed aisle 5", "no areas")
    assert told == [(words, "ada", "racks were moved") for words in done]


def test_a_change_of_what_somebody_else_changed_is_refused(server: Server) -> None:
    looked_at = server.client.get(AREAS).headers["etag"]
    changed = put(server, drawn("aisle 5"), **{"If-Match": looked_at})
    assert changed.headers["etag"] == server.client.get(AREAS).headers["etag"] != looked_at
    check_problem(put(server, drawn("gate"), **{"If-Match": looked_at}), 412, "load them anew")
    gone = server.client.request("DELETE", AREAS, params=ADA, headers={"If-Match": looked_at})
    check_problem(gone, 412, "changed meanwhile")
    assert listed(server) == "aisle 5: 12.0 m2\n1 areas\n"
    assert put(server, drawn("gate"), **{"If-Match": "*"}).status_code == 200
    check_problem(put(server, drawn("gate"), **{"If-Match": "new"}), 422, "if-match")
    check_problem(server.client.put(f"{AREAS}?if-match=*", content=drawn("gate")), 422, "knows actor, reason")


def test_a_correction_keeps_its_moment_and_reason_until_it_is_another(server: Server) -> None:
    def kept() -> list[tuple[str, str, int]]:
        found = [(area.name, area.correction) for area in server.store.areas("lab").corrections]
        return [(name, one.reason, one.since_ns or 0) for name, one in found if one is not None]

    put(server, drawn("glass", correction={"kind": "never-use"}))
    ((_, reason, since_ns),) = kept()
    assert reason == ADA["reason"]
    assert since_ns > 10**18
    answer = server.client.get(AREAS).json()
    answer["features"][0]["properties"] |= {"name": "front", "correction": {"kind": "never-use", "since_ns": 5}}
    put(server, json.dumps(answer).encode())
    assert kept() == [("front", reason, since_ns)], "another name is the same correction; its moment is the server's"
    put(server, drawn("front", correction={"kind": "forget", "reason": "new racks"}))
    ((_, reason, later_ns),) = kept()
    assert (reason, later_ns > since_ns) == ("new racks", True)
    assert server.client.post(f"{AREAS}/undo", json=ADA).status_code == 200
    assert kept() == [("front", ADA["reason"], since_ns)]
    assert listed(server) == "front: 12.0 m2, never-use: racks were moved\n1 areas\n"
    server.client.post(f"{AREAS}/undo", json=ADA)
    assert kept() == [("front", "new racks", later_ns)]
    put(server, drawn("a"))
    site = ["--site", "lab", "--store", str(server.folder), "--reason", "why"]
    for words, said in (
        (["correct", "a", "freeze"], "a: 12.0 m2, freeze: why\n"),
        (["correct", "a", "nothing"], "a: 12.0 m2\n"),
    ):
        assert CliRunner().invoke(app, ["areas", *words, *site]).output == said
    several = [*site[:-1], "two\nlines" + " of many words" * 40]
    assert CliRunner().invoke(app, ["areas", "correct", "a", "freeze", *several]).exit_code == 0
    assert kept()[0][1].startswith("two lines of many") and len(kept()[0][1]) >= 499
    assert server.client.post(f"{AREAS}/correct", json=ADA | {"name": "a", "kind": "nothing"}).status_code == 200
    assert "1 areas, as before" in CliRunner().invoke(app, ["areas", "undo", *site]).output
    assert [name for name, *_ in kept()] == ["a"]


def test_what_was_never_changed_cannot_be_undone(server: Server) -> None:
    check_problem(server.client.post(f"{AREAS}/undo", json=ADA), 409, "nothing to undo")
    put(server, drawn("a"))
    assert server.client.post(f"{AREAS}/undo", json=ADA).json()["features"] == []
    put(server, drawn("a"))
    for _ in range(2):  # removed, and none removed once more
        assert server.client.delete(AREAS, params={"actor": "ada"}).status_code == 200
    assert len(server.client.post(f"{AREAS}/undo", json=ADA).json()["features"]) == 1


def test_every_part_of_an_area_to_forget_is_requested(server: Server) -> None:
    """Not its hole."""
    area = json.loads(drawn("racks", correction={"kind": "forget", "reason": "new"}))
    (outer,) = area["features"][0]["geometry"]["coordinates"]
    hole = [[1.0, 1.0], [2.0, 1.0], [2.0, 2.0], [1.0, 2.0], [1.0, 1.0]]
    beside = [[x + 10.0, y] for x, y in outer]
    area["features"][0]["geometry"] = {"type": "MultiPolygon", "coordinates": [[outer, hole], [beside]]}
    assert put(server, json.dumps(area).encode()).status_code == 200
    corners = [request.corners_map_m[0] for request in server.store.survey_requests("lab")]
    assert sorted(corners) == [[0.0, 0.0], [10.0, 0.0]]


@pytest.mark.parametrize(
    ("content", "status", "words"),
    [
        (b"[" * 100_000, 422, "give a GeoJSON FeatureCollection"),
        (drawn(), 422, "0 features"),
        (drawn("a", "a"), 422, "occurs twice"),
        (drawn("a", frame="wgs84"), 422, "frame"),
        (drawn("a", frame="building"), 409, "need the map's pose"),
        (drawn("a", mask="speed"), 422, "percent"),
        (drawn("a", mask="speed", percent=100), 422, "percent"),
        (drawn("a", mask="keep-out", percent=30), 422, "percent 30"),
        (drawn("a", mask="slow"), 422, "keep-out"),
        (drawn("a", correction={"kind": "burn", "reason": "x"}), 422, "burn"),
        (drawn("a", correction={"kind": "freeze", "reason": "\x1b[2J"}), 422, "cannot be shown"),
        (drawn("a", correction={"kind": "freeze", "reason": "x" * 501}), 422, "length <= 500"),
        (drawn("a").replace(b"[4, 3]", b"[0, 3.5]").replace(b"[0, 3]", b"[4, 4]"), 422, "crosses itself"),
        (drawn("a", mask="keep-out").replace(b"4", b"904").replace(b"[0", b"[900"), 422, "outside of version 1"),
        (b" " * (8 << 20) + b"x", 413, "more than 8388608 bytes"),
    ],
)
def test_what_is_no_area_changes_nothing(server: Server, content: bytes, status: int, words: str) -> None:
    put(server, drawn("aisle 5"))
    check_problem(put(server, content), status, words)
    assert listed(server) == "aisle 5: 12.0 m2\n1 areas\n"


def test_areas_of_the_building_stay_there(server: Server) -> None:
    """They move with the map when it is aligned anew, also after they were changed in `map`."""

    def align(pins: list[str]) -> None:
        assert server.client.put(ALIGNMENT, params=ADA | {"pin": pins}).status_code == 200

    align(PINS)
    put(server, drawn("hall", frame="building"))
    found = server.client.get(AREAS).json()
    found["features"][0]["properties"]["name"] = "north hall"
    assert put(server, json.dumps(found).encode()).json() == found
    before = np.array(found["features"][0]["geometry"]["coordinates"][0])
    align(["a=200,400:50,0", "b=200,0:70,0", "c=0,400:50,10"])  # 50 m along x of the map
    after = server.client.get(AREAS).json()["features"][0]
    assert after["properties"] == {"name": "north hall"}
    np.testing.assert_allclose(np.array(after["geometry"]["coordinates"][0]) - before, [[50.0, 0.0]] * 5, atol=1e-3)
    check_problem(server.client.request("DELETE", ALIGNMENT, params=ADA), 409, "need the map's pose")


def test_alignments_are_few_at_once(server: Server) -> None:
    answers: list[int] = []

    async def ask() -> None:
        others, begun = anyio.Event(), []

        async def one() -> None:
            begun.append(1)
            answers.extend(await raw_put(server, ALIGNMENT, others, END, stated=1, query=b"&pin=a=0,0:0,0"))

        async with anyio.create_task_group() as tasks:
            for _ in range(2):
                tasks.start_soon(one)
            while len(begun) < 2:
                await anyio.sleep(0.01)
            await anyio.sleep(0.1)  # until their bodies are read
            answers.extend(await raw_put(server, ALIGNMENT, END, stated=1, query=b"&pin=a=0,0:0,0"))
            others.set()
        answers.extend(await raw_put(server, ALIGNMENT, END, stated=1, query=b"&pin=a=0,0:0,0"))

    anyio.run(ask)
    assert answers == [429, 422, 422, 422]


def test_a_map_is_aligned_with_a_plan_as_by_the_command(server: Server) -> None:
    picture = cv2.imencode(".png", np.full((500, 600), 255, np.uint8))[1].tobytes()
    check_problem(server.client.get(ALIGNMENT), 404, "is not aligned")
    asked = ADA | {"pin": PINS, "plan": "plan.png"}
    estimated = server.client.get(f"{ALIGNMENT}/estimate", params={"pin": PINS}).json()
    check_problem(server.client.get(ALIGNMENT), 404, "is not aligned")
    check_problem(server.client.get(f"{ALIGNMENT}/estimate", params={"pin": PINS[:1]}), 422, "give 2 to 100")
    kept = server.client.put(ALIGNMENT, params=asked, content=picture)
    assert estimated["off_m"] == kept.json()["off_m"]
    assert (estimated["metres_per_unit"], estimated["is_checked"]) == (pytest.approx(0.05), True)
    assert kept.json() == server.client.get(ALIGNMENT).json()
    shown = CliRunner().invoke(app, ["align", "--show", "--json", "--site", "lab", "--store", str(server.folder)])
    assert json.loads(shown.output) == kept.json()
    assert kept.json()["metres_per_unit"] == pytest.approx(0.05)
    assert server.store.site_file("lab", "plan") == picture
    for change, content, status, words in (
        ({}, b"no picture", 422, "is not a PNG"),
        ({}, b"", 422, "send a picture as the body"),
        ({"pin": ["a=200,400:0,0"]}, picture, 422, "1 pins: give 2 to 100"),
        ({"pin": ["a"]}, picture, 422, "write NAME=px,py:mx,my"),
        ({"pin": [*PINS, "d=700,0:9,9"]}, picture, 422, "is not in plan.png, which has 600x500"),
        ({"plan": "plan.dxf"}, picture, 422, "DXF"),
    ):
        check_problem(server.client.put(ALIGNMENT, params=asked | change, content=content), status, words)
    assert server.client.get(ALIGNMENT).json() == kept.json()
    assert server.client.request("DELETE", ALIGNMENT, params=ADA).json() == {"status": "ok"}
    assert server.store.site_file("lab", "plan") is None
    for path, query in ((AREAS, ADA), (ALIGNMENT, ADA | {"pin": PINS})):
        check_problem(server.client.request("DELETE", path), 422, "name the person who acts")
        elsewhere = server.client.put(path.replace("lab", "yard"), params=query, content=b"x")
        check_problem(elsewhere, 404, "no site yard")
