"""What people change from the dashboard, in a real browser: versions, where a robot stands, what is surveyed again."""

import re
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from playwright.sync_api import Page, expect
from typer.testing import CliRunner

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.encoding import to_json
from fleetmap.messages import InitialPoseMessage, RobotHealth, decode_message, robot_key
from locclient.identity import RobotIdentity
from mapserver import releases
from mapserver.cli import app
from mapserver.fleet.building import ask_for_survey, end_request, keep_areas
from mapserver.fleet.fleet import Fleet
from mapserver.fleet_statistics.kpis import Counters, hour_of
from mapserver.store import Actor, DraftContent, FleetBatch, MapStore
from mapserver.trust import init_here
from mapserver.trust.enrolment import RobotRegister
from support.fleet.dashboard_scene import SITE, Served, change, fill_store, hall_tiles, marks, opened, serving, talking
from support.pages.browser import agree, box_of, fill
from support.pages.whole_page import assert_whole
from support.storage.map_samples import draft_details
from support.waiting import eventually


def test_a_robot_is_told_where_it_stands(page: Page, served: Served) -> None:
    heard: list[InitialPoseMessage] = []
    with talking(served.zenoh, 8), Bus(served.zenoh).open() as bus:
        key = robot_key(SITE, "tug-5", "initial_pose")
        bus.subscribe(key, lambda _, data: heard.append(decode_message(data, InitialPoseMessage)))
        opened(page, served, "robots/tug-5")
        page.get_by_role("button", name="tug-5 is here").click()
        expect(page.get_by_role("dialog")).to_contain_text("Click into the map")
        page.get_by_role("button", name="No, change nothing").click()
        page.locator(".site-map").click(position={"x": 150, "y": 150})
        expect(page.get_by_label("x (m)")).not_to_have_value("")
        assert "chosen place" in [mark["words"] for mark in marks(page)]
        page.get_by_label("Heading (°)").fill("90")
        x, y = (float(page.get_by_label(f"{axis} (m)").input_value()) for axis in "xy")
        change(page, "tug-5 is here")
        assert eventually(lambda: heard, 20.0)
    assert (heard[0].x_map_m, heard[0].y_map_m, heard[0].heading_rad) == pytest.approx((x, y, 1.5708), abs=1e-3)


def test_a_survey_is_asked_for_by_drawing_it_and_ended(page: Page, served: Served) -> None:
    opened(page, served, "map")
    page.get_by_text("Draw an area or a survey on the map").click()
    page.get_by_role("button", name="Request a survey here").click()
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text("Draw at least three corners first")
    dialog.get_by_role("button", name="No, change nothing").click()
    drawing = page.locator(".site-map")
    for place in ((250, 200), (300, 200), (300, 260), (100, 100)):
        drawing.click(position=dict(zip("xy", place, strict=True)))
    assert len(marks(page, 4)) == 4
    page.get_by_role("button", name="Take back the last corner").click()
    assert len(marks(page, 3)) == 3
    asked = page.get_by_text(re.compile("asked by .* at "))
    with MapStore.open(served.folder) as store:  # somebody else asks: it comes by itself, and what is drawn stays
        other = ask_for_survey(store, SITE, [(1.0, 1.0), (3.0, 1.0), (3.0, 3.0)], Actor("bob"))
        expect(asked).to_contain_text("asked by bob")
        expect(page.locator(".site-map path.area")).to_have_count(1)
        assert len(marks(page, 3)) == 3
        end_request(store, SITE, other.id, Actor("bob"))
        expect(asked).to_have_count(0)
    change(page, "Request a survey here")
    expect(asked).to_contain_text(re.compile("asked by ada at .*robots lose themselves in aisle 3"))
    expect(page.locator(".site-map path.area")).to_have_count(1)
    opened(page, served, "trends")
    again = page.get_by_role("table", name="Tiles to survey again")
    expect(again).to_contain_text("ada asked for it", timeout=15_000)
    tiles = again.get_by_label(re.compile(r"^Choose \d")).count()
    page.get_by_label("Choose all").check()
    change(page, "Request a survey of the chosen tiles")
    expect(page.get_by_role("dialog")).to_have_count(0)
    with MapStore.open(served.folder) as store:
        _, *more = store.survey_requests(SITE)
        assert len(more) == tiles > 0
        for request in more:
            end_request(store, SITE, request.id, Actor("ada"))
    opened(page, served, "map")
    change(page, page.get_by_role("button", name=re.compile("^Survey .* is done")).inner_text())
    expect(asked).to_have_count(0)


def test_a_map_is_aligned_with_its_plan_by_clicks_in_both(page: Page, tmp_path: Path) -> None:
    fill_store(tmp_path)
    plan = tmp_path / "hall plan.png"
    plan.write_bytes(cv2.imencode(".png", np.full((300, 600), 200, np.uint8))[1].tobytes())
    with serving(tmp_path) as served, MapStore.open(tmp_path) as store:
        opened(page, served, "map")
        page.get_by_text("Align the map with a floor plan").click()
        keep, dialog = page.get_by_role("button", name="Keep this alignment"), page.get_by_role("dialog")
        keep.click()
        expect(dialog).to_contain_text("Give at least two points first")
        dialog.get_by_role("button", name="No, change nothing").click()
        page.get_by_label("Picture of the plan").set_input_files(plan)
        paper, written = page.locator(".paper .site-map"), page.get_by_label("Points: pixels")
        told = page.locator("#aligning output")
        for n, share in enumerate(((0.1, 0.2), (0.9, 0.2))):
            paper.scroll_into_view_if_needed()
            page.wait_for_timeout(300)  # the map fits itself into its frame
            sheet, drawn = box_of(paper), box_of(paper.locator("img"))
            x, y = drawn["x"] + share[0] * drawn["width"], drawn["y"] + share[1] * drawn["height"]
            paper.click(position={"x": x - sheet["x"], "y": y - sheet["y"]})
            expect(told).to_contain_text("Now the same point in the map.")
            page.locator("#map").click(position={"x": 150 + 300 * n, "y": 200})
        points = [[float(v) for v in re.split("[,:]", point)] for point in written.input_value().split(";")]
        np.testing.assert_allclose([point[:2] for point in points], [(60, 60), (540, 60)], atol=3)
        expect(told).to_contain_text("a third would show a mistake")
        scale = (points[1][2] - points[0][2]) / (points[1][0] - points[0][0])
        third = [points[0][0], points[0][1] + 100, points[0][2], points[0][3] - 100 * scale + 0.2]
        written.fill("; ".join(f"{px}, {py}: {x}, {y}" for px, py, x, y in [*points, third]))
        left = r"m for each pixel\. Left at the points: 1: 0\.\d\d m, 2: 0\.\d\d m, 3: 0\.\d\d m\. $"
        expect(told).to_have_text(re.compile(left))
        assert_whole(page)
        keep.click()
        agree(page, {"Your name": "ada"})
        expect(page.locator("#aligning")).to_contain_text("aligned with hall plan.png by 3 points, at most 0.")
        found = store.alignment(SITE)
        assert (found.plan, found.metres_per_unit) == ("hall plan.png", pytest.approx(scale, rel=0.1))
        assert store.log(site=SITE, limit=1)[0].actor == "ada"
        page.get_by_text("Align the map with a floor plan").click()
        change(page, "Forget the alignment")
        expect(page.locator("#aligning")).to_contain_text("The map is not aligned yet.")
        assert store.alignment(SITE) is None


def test_an_area_is_drawn_named_changed_and_removed(page: Page, tmp_path: Path) -> None:
    fill_store(tmp_path)
    listing = ["areas", "list", "--site", SITE, "--store", str(tmp_path)]

    def listed() -> str:
        return CliRunner().invoke(app, listing).output

    with serving(tmp_path) as served, MapStore.open(tmp_path) as store:
        seen = opened(page, served, "map")
        drawing, corners = page.locator(".site-map"), page.get_by_label("Corners, x and y in metres")
        page.get_by_text("Draw an area or a survey on the map").click()
        expect(page.get_by_label("Draw: each click")).to_be_checked()  # as its panel opened
        for place in ((250, 200), (300, 200), (300, 260), (250, 200)):
            drawing.click(position=dict(zip("xy", place, strict=True)))
        expect(page.get_by_label("Draw: each click")).not_to_be_checked()  # the first corner closed it
        written = corners.input_value()
        releases.publish(store, SITE)  # the page shows another version, and what was drawn stays
        expect(page.get_by_role("status")).to_have_text("Robots should use version 3.")
        expect(page.locator("#gate h2")).to_have_text("Version 3: the gate")
        expect(corners).to_have_value(written)
        assert len(marks(page, 3)) == 3

        corners.fill("8, 8; 24, 8; 24 16; 8")
        page.get_by_role("button", name="Name an area").click()
        dialog = page.get_by_role("dialog")
        expect(dialog).to_contain_text('"8" is not a corner')
        dialog.get_by_role("button", name="No, change nothing").click()
        corners.fill("8, 8; 24, 8; 24 16; 8, 16")
        page.get_by_role("button", name="Name an area").click()
        slower = {"For planners": "drive slower", "Percent": "30"}
        agree(page, {"Name of the area": "aisle <5>", "Your name": "ada"} | slower)
        areas = page.get_by_role("list", name="Areas")
        expect(areas).to_contain_text("aisle <5>: 128 m², at most 30 % of the speed")
        expect(corners).to_have_value("")
        assert listed() == "aisle <5>: 128.0 m2, speed 30 %\n1 areas\n"
        opened(page, served, "")
        expect(page.locator(".area-name")).to_have_text("aisle <5>")

        # Somebody else changes the areas while the dialog is open: nothing of it is lost.
        opened(page, served, "map")
        with page.expect_response("**/areas"):
            page.get_by_role("button", name="Change aisle <5>").click()
        expect(dialog.get_by_label("Name of the area")).to_have_value("aisle <5>")
        renamed = {"Name of the area": "aisle 5", "For planners": "no effect"}
        fill(page, {"For planners": "drive slower", "Percent": "0"})  # what is hidden then is not checked
        fill(page, renamed | {"Your name": "ada"})
        found = store.areas(SITE).geojson(SITE)
        shape = {"type": "Polygon", "coordinates": [[[0, 0], [4, 0], [4, 3], [0, 0]]]}
        found["features"][0]["properties"]["lift"] = "A"
        found["features"].append({"type": "Feature", "geometry": shape, "properties": {"name": "gate"}})
        keep_areas(store, SITE, to_json(found), None, Actor("bob"))
        agree(page, {})
        expect(dialog.get_by_role("alert")).to_contain_text("were changed meanwhile; load them anew")
        dialog.get_by_role("button", name="No, change nothing").click()
        assert [area.name for area in store.areas(SITE).areas] == ["gate", "aisle <5>"]
        expect(areas).to_contain_text("lift A")
        page.get_by_role("button", name="Change aisle <5>").click()
        agree(page, renamed)
        expect(areas).to_contain_text("aisle 5: 128 m²")
        assert listed() == "aisle 5: 128.0 m2, lift A\ngate: 6.0 m2\n2 areas\n"
        page.get_by_role("button", name="Change gate").click()
        expect(dialog.get_by_label("Name of the lift")).to_be_hidden()
        agree(page, {"Kind": "the cabin of a lift", "Name of the lift": "B", "Your name": "ada"})
        expect(areas).to_contain_text("gate: 6 m², lift B")
        assert listed() == "aisle 5: 128.0 m2, lift A\ngate: 6.0 m2, lift B\n2 areas\n"

        page.get_by_role("button", name="Change aisle 5").click()
        agree(page, {"Correct the map": "forget what is here, learn it anew", "Your name": "ada"})
        assert dialog.get_by_label("Reason").evaluate("field => field.matches(':invalid')"), "a correction has a reason"
        agree(page, {"Reason": "new racks"})
        expect(areas).to_contain_text(re.compile(r"to be forgotten once a recording shows it .*, \d+ s ago: new racks"))
        assert listed().startswith("aisle 5: 128.0 m2, lift A, forget: new racks\n")
        expect(page.locator(".site-map path.area.warn")).to_have_count(1)
        change(page, "Undo the last change of areas")
        expect(areas).not_to_contain_text("new racks")
        for name in ("aisle 5", "gate"):
            change(page, f"Remove {name}")
            expect(areas).not_to_contain_text(name)
        assert listed() == "0 areas\n"
        seen.refused(412)


def test_a_recording_is_uploaded_built_and_tried_again(page: Page, tmp_path: Path) -> None:
    store, inbox, chosen = tmp_path / "store", tmp_path / "inbox", tmp_path / "mon day.mcap"
    store.mkdir()
    fill_store(store)
    inbox.mkdir()
    chosen.write_bytes(bytes(20_000_000))
    (tmp_path / "notes.txt").write_bytes(bytes(20_000_000))
    with serving(store, "--inbox", str(inbox)) as served:
        seen = opened(page, served, "surveys")
        waiting, uploads = page.get_by_role("list", name="Inbox"), page.get_by_role("list", name="Uploads")
        expect(waiting).to_contain_text("Nothing waits in the inbox.")
        page.get_by_text("Upload recordings").click()
        with page.expect_file_chooser() as chooser:
            page.get_by_role("button", name="Recordings").click()
        chooser.value.set_files([tmp_path / "notes.txt", chosen])
        form = page.locator("#upload")
        form.get_by_label("Your name").fill("ada")
        form.get_by_label("Reason").fill("aisle 3")
        form.get_by_role("button", name="Upload", exact=True).click()
        expect(waiting.get_by_role("listitem").filter(has_text="mon day.mcap")).to_contain_text("20.0 MB")
        expect(uploads.get_by_role("listitem")).to_have_text(re.compile("notes.txt .*is an invalid name of a rec"))
        page.route("**/inbox/other.mcap?*", lambda route: route.fulfill(status=413, json={"message": "too large"}))
        page.locator("#upload [type=file]").set_input_files({"name": "other.mcap", "mimeType": "", "buffer": b"1"})
        form.get_by_role("button", name="Upload", exact=True).click()
        expect(uploads.get_by_role("listitem").last).to_have_text("other.mcap The server refused it (413).")
        assert (inbox / SITE / chosen.name).stat().st_size == 20_000_000
        expect(waiting).to_contain_text("ready", timeout=15_000)
        change(page, "Build now")
        expect(waiting).to_contain_text("mon day.mcap is not an MCAP file", timeout=60_000)
        page.get_by_role("link", name="Job 3: nightly").click()
        page.get_by_text("Log of job 3").click()
        expect(page.locator("#log pre")).to_contain_text("bad: mon day.mcap: ")
        (inbox / SITE / chosen.name).touch()
        change(page, "Try again")
        expect(page.get_by_role("alert")).to_contain_text("the inbox has another mon day.mcap")
        page.get_by_role("button", name="No, change nothing").click()
        (inbox / SITE / chosen.name).unlink()
        change(page, "Try again")
        expect(waiting.locator(".bad")).to_have_count(0)
        with MapStore.open(store) as maps:
            kinds = [(event.kind, event.actor) for event in maps.log(site=SITE, limit=3)]
        assert kinds == [(kind, "ada") for kind in ("recording_tried_again", "build_started", "recording_uploaded")]
        seen.refused(422, 413, 409)


def test_publish_promote_and_roll_back_ask_first(page: Page, tmp_path: Path) -> None:
    fill_store(tmp_path)
    with serving(tmp_path) as served:
        seen = opened(page, served, "map")
        used, dialog = page.get_by_role("status"), page.get_by_role("dialog")
        page.get_by_role("button", name="Roll back to version 1").click()
        for name, reason, lacks in ((" ", "why", "actor"), ("ada", "", "reason"), ("ada", " ", "reason")):
            agree(page, {"Your name": name, "Reason": reason})
            expect(dialog.locator("input:invalid")).to_have_attribute("name", lacks)
        dialog.get_by_role("button", name="No, change nothing").click()
        expect(used).to_have_text("Robots should use version 2.")
        change(page, "Publish draft 3")
        expect(used).to_have_text("Robots should use version 3.")
        expect(page.get_by_role("list", name="History")).to_contain_text("robots lose themselves in aisle 3")

        # Somebody else acts: the page follows, and what it still offered before is refused.
        page.get_by_role("button", name="Roll back to version 2").click()
        with MapStore.open(served.folder) as store:
            releases.roll_back(store, SITE)
            agree(page, {"Your name": "ada", "Reason": "worse"})
            expect(dialog.get_by_role("alert")).to_contain_text("no longer leads to version 2")
            dialog.get_by_role("button", name="No, change nothing").click()
            expect(used).to_have_text("Robots should use version 2.")
        seen.refused(409)


def test_what_the_gate_refuses_is_told_and_can_be_forced(page: Page, tmp_path: Path) -> None:
    fill_store(tmp_path)
    with MapStore.open(tmp_path) as store:
        thin = [tile for tile in hall_tiles() if (tile.tile_x, tile.tile_y) == (0, 0)]
        store.save(SITE, DraftContent(tiles=thin, vocabulary=b"words" * 50, details=draft_details()))
    with serving(tmp_path) as served:
        seen = opened(page, served, "map", version=4)
        gate, card = page.locator("#gate"), page.locator("#versions li", has_text="Version 4")
        expect(gate).to_contain_text("The gate would refuse it.")
        expect(gate).to_contain_text("The number of landmarks is 0.")
        expect(gate.locator(".not_judged")).to_contain_text("Frames that the build left out: too few of them")
        assert "_" not in gate.inner_text(), "no key of the code"
        change(page, "Publish draft 4")
        dialog = page.get_by_role("dialog")
        expect(dialog.get_by_role("alert")).to_contain_text("draft 4 of hall is refused")
        seen.refused(409)
        dialog.get_by_role("button", name="No, change nothing").click()
        expect(card).to_contain_text("The gate refused it: the number of landmarks")
        change(page, "Publish draft 4 by force")
        expect(page.get_by_role("status")).to_have_text("Robots should use version 4.")
        expect(card).to_contain_text("Published by force, although: the number of landmarks")


def test_a_version_taken_back_by_the_server_is_told_with_its_reason(page: Page, served: Served) -> None:
    with MapStore.open(served.folder) as store:
        canary = releases.start_canary(store, SITE, 1, 0.05)
        opened(page, served, "map")
        expect(page.get_by_role("status")).to_contain_text("Version 1 is tried by 5.0 % of them")
        expect(page.get_by_role("button", name="Stop trying version 1")).to_be_visible()
        expect(page.get_by_role("button", name="Roll back")).to_have_count(0)
        opened(page, served, "")
        trial = page.locator(".notice", has_text="Version 1")
        expect(trial).to_contain_text("Version 1 is tried by 5.0 % of the robots")
        releases.end_canary(store, canary, promote=False, outcome="it fails more often than the margin allows")
    expect(trial).to_contain_text("rolled back", timeout=10_000)
    expect(trial).to_contain_text("It fails more often than the margin allows")


def test_an_act_stays_with_what_it_was_begun_for(page: Page, tmp_path: Path) -> None:
    fill_store(tmp_path)
    with MapStore.open(tmp_path) as store:
        store.update_job(store.begin_job(SITE, "nightly"), "failed", "see `mapserver doctor`", {"waiting": []})
    with serving(tmp_path) as served, MapStore.open(tmp_path) as store:
        seen, dialog = opened(page, served, "", since="2026-01-01"), page.get_by_role("dialog")
        notices = page.locator("#notices p")
        expect(notices.first).to_contain_text("The night of hall failed")
        expect(notices.first.locator("code")).to_have_text("mapserver doctor")
        expect(notices.first.get_by_role("link")).not_to_have_attribute("href", re.compile("since"))
        notices.first.get_by_role("button", name="Acknowledge").click()
        hour, batch = hour_of(store.now_ns()), FleetBatch()
        driven_ms = 1_000_000_000
        batch.add(
            SITE,
            "site",
            "",
            hour,
            Counters(driving_ms=driven_ms, judged_ms=driven_ms, failures=999, blind_failures=999),
        )
        store.fleet.add(batch)  # another alert takes its place on the page
        page.wait_for_timeout(8000)
        agree(page, {"Your name": "ada"})
        expect(notices.first).to_contain_text("robots of hall failed", ignore_case=True)
        expect(notices.nth(1)).to_contain_text("ada has it.")
        notices.first.get_by_role("button", name="Acknowledge").click()
        faster = {"incident": f"FleetmapFailureRate/{SITE}", "actor": "bob"}
        httpx.post(f"{served.http}/v1/incidents/acknowledge", json=faster).raise_for_status()
        agree(page, {"Your name": "ada"})
        expect(dialog.get_by_role("alert").locator("code")).to_have_text("incidents list")
        seen.refused(409)


def test_operators_tokens_and_robots_begin_and_end(page: Page, tmp_path: Path) -> None:
    fill_store(tmp_path)
    with MapStore.open(tmp_path) as store:
        init_here(store)
        RobotRegister(store).authorities.init(["127.0.0.1"], None, None)
        fleet = Fleet(store)
        health = RobotHealth(site=SITE, robot="tug-8", stamp_ns=1, version=2, status="TRACKING")
        fleet.take_health(SITE, "tug-8", health)
        fleet.flush()

    def ask(words: str, name: str | None = None, **fields: str) -> None:
        page.get_by_role("button", name=words, exact=True).click()
        for label, value in fields.items():
            dialog.get_by_label(label, exact=True).fill(value)
        if name is not None:
            dialog.get_by_label("Your name").fill(name)
        dialog.get_by_label("Reason").fill("a new shift")

    def told() -> str:
        dialog.get_by_role("button", name=re.compile("^Yes")).click()
        expect(dialog.get_by_role("button", name=re.compile("^Yes"))).to_be_hidden()
        expect(dialog.locator("output")).not_to_be_empty()
        return dialog.locator("output").inner_text()

    with serving(tmp_path, "--zenoh", "tls/127.0.0.1:0") as served:
        seen, dialog = opened(page, served, "administration/people"), page.get_by_role("dialog")
        expect(page.get_by_text("Nobody signs in yet")).to_be_visible()
        with httpx.stream("GET", f"{served.http}/dashboard/now?site={SITE}", timeout=60) as stream:
            ask("Add an operator", name="carl", Name="bob")
            roles = dialog.get_by_label("Role").locator("option").all_inner_texts()
            assert roles == ["admin: everything, people and robots, too"]
            password = told()
            assert "event: ended" in stream.iter_lines(), "nobody follows without signing in any more"
        page.keyboard.press("Escape")
        expect(dialog).to_contain_text("is shown only now")
        dialog.get_by_role("button", name="Close").click()
        page.get_by_label("Name", exact=True).fill("bob")  # not that of the page that is left
        page.get_by_label("Password").fill(password)
        page.get_by_role("button", name="Sign in").click()
        people = page.get_by_role("list", name="Operators and programs")
        robots = page.get_by_role("table", name="Robots, problems first").locator("tbody")
        expect(people.locator("li", has_text="bob")).to_contain_text("signed in")

        ask("Disable bob")
        dialog.get_by_role("button", name="Yes: Disable bob").click()
        expect(dialog.get_by_role("alert")).to_contain_text("bob is the last admin")
        dialog.get_by_role("button", name="No, change nothing").click()
        seen.refused(409)

        ask("Make a token for a program", **{"Name of the program": "grafana"})
        dialog.get_by_label("read maps, robots and failures").uncheck()
        dialog.get_by_label("read the metrics").check()
        with httpx.Client(base_url=served.http, headers={"Authorization": f"Bearer {told()}"}) as grafana:
            assert [grafana.get(path).status_code for path in ("/metrics", "/v1/sites")] == [200, 403]
            dialog.get_by_role("button", name="Close").click()
            grafanas = people.locator("li", has_text="grafana")
            expect(grafanas).to_contain_text("may read the metrics. It ends in 90 days.")
            ask("Disable grafana")
            dialog.get_by_role("button", name="Yes: Disable grafana").click()
            expect(grafanas).to_contain_text("disabled program")
            assert grafana.get("/metrics").status_code == 401

        tug = robots.locator("tr", has_text="tug-7")
        expect(tug).to_contain_text("not enrolled")
        ask("Enrol the chosen")
        expect(dialog).to_contain_text("Choose rows of the table first.")
        dialog.get_by_role("button", name="No, change nothing").click()
        page.get_by_label("Choose tug-7").check()
        ask("Enrol the chosen")
        with page.expect_download() as download:
            assert told() == "tug-7.fleetmap"
        bundle = Path(download.value.path()).read_bytes()
        dialog.get_by_role("button", name="Close").click()
        expect(tug).to_contain_text("bundle unused, 24 h left")
        identity = RobotIdentity.enrol(tmp_path / "robot", bundle)
        assert (identity.who.site, identity.who.robot) == (SITE, "tug-7")
        expect(tug).to_contain_text("certificate for 365 days")
        page.get_by_label("Choose tug-7").check()
        ask("Revoke the chosen")
        expect(dialog).to_contain_text("tug-7: Remove robots, such as stolen ones")
        dialog.get_by_role("button", name="Yes: Revoke the chosen").click()
        expect(tug).to_contain_text("not enrolled")
        page.get_by_label("Choose all").check()
        ask("Remove the chosen")
        dialog.get_by_role("button", name="Yes: Remove the chosen").click()
        expect(robots).to_contain_text("No robot was ever heard here")

        with MapStore.open(tmp_path) as store:
            kinds = [line.kind for line in store.log()[::-1] if line.actor == "bob" and line.reason == "a new shift"]
            robots = ["robot enrolled", "robot revoked", "robot removed", "robot removed"]
            assert kinds == ["token made", "operator disabled", *robots]
            store.operators.set_role("bob", "viewer", Actor("root"))
        opened(page, served, "administration/people", site=SITE)
        expect(page.get_by_role("alert")).to_have_text("bob (viewer) may not open this page; an admin may.")
        seen.refused(403)
