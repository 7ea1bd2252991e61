"""What people change from the dashboard, in a real browser: versions, where a robot stands, what is surveyed again."""

import re
import time
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from fleetmap.bus import Bus
from fleetmap.messages import InitialPoseMessage, decode_message, robot_key
from mapserver import releases
from mapserver.store import MapStore
from support.fleet.dashboard_scene import SITE, Served, change, fill_store, marks, opened, serving, talking


def test_a_robot_is_told_where_it_stands(page: Page, served: Served) -> None:
    heard: list[InitialPoseMessage] = []
    with talking(served.zenoh, 8), Bus.connect(served.zenoh) as bus:
        bus.subscribe(
            robot_key(SITE, "tug-5", "initial_pose"),
            lambda _, data: heard.append(decode_message(data, InitialPoseMessage)),
        )
        seen = opened(page, served, "robots/tug-5")
        page.get_by_role("button", name="tug-5 is here").click()
        expect(page.get_by_role("dialog")).to_contain_text("Click into the map")
        page.get_by_role("button", name="No, change nothing").click()
        page.locator(".site-map").click(position={"x": 150, "y": 150})
        expect(page.get_by_label("x (m)")).not_to_have_value("")
        assert "chosen place" in [mark["words"] for mark in marks(page)]
        page.get_by_label("Heading (°)").fill("90")
        x, y = (float(page.get_by_label(f"{axis} (m)").input_value()) for axis in "xy")
        change(page, "tug-5 is here")
        deadline_s = time.monotonic() + 20
        while not heard:
            assert time.monotonic() < deadline_s
            page.wait_for_timeout(100)
    assert (heard[0].x_map_m, heard[0].y_map_m, heard[0].heading_rad) == pytest.approx((x, y, 1.5708), abs=1e-3)
    assert seen.faults == []


def test_a_survey_is_asked_for_by_drawing_it_and_ended(page: Page, served: Served) -> None:
    seen = opened(page, served, "map")
    drawing = page.locator(".site-map").first
    page.get_by_text("Draw on the map").click()
    for place in ((250, 200), (300, 200), (300, 260), (100, 100)):
        drawing.click(position=dict(zip("xy", place, strict=True)))
    page.wait_for_function("document.querySelector('.site-map').marks().length === 4")
    page.get_by_role("button", name="Take back the last corner").click()
    page.wait_for_function("document.querySelector('.site-map').marks().length === 3")
    change(page, "Ask for a survey of it")
    asked = page.get_by_text(re.compile("asked by ada at .*robots lose themselves in aisle 3"))
    expect(asked).to_have_count(1)
    expect(page.locator(".site-map path.area")).to_have_count(1)
    opened(page, served, "trends")
    expect(page.get_by_role("table", name="Tiles to survey again")).to_contain_text("ada asked for it", timeout=15_000)
    opened(page, served, "map")
    change(page, page.get_by_role("button", name=re.compile("^Survey .* is done")).inner_text())
    expect(asked).to_have_count(0)
    assert seen.faults == []


def current(served: Served) -> int:
    with MapStore.open(served.folder) as store:
        return store.current(SITE).version


def test_publish_promote_and_roll_back_ask_first(page: Page, tmp_path: Path) -> None:
    fill_store(tmp_path)
    with serving(tmp_path) as served:
        seen = opened(page, served, "map")
        page.get_by_role("button", name="Roll back to version 1").click()
        page.get_by_role("button", name="No, change nothing").click()
        expect(page.locator(".q-dialog")).to_have_count(0)
        assert current(served) == 2

        change(page, "Roll back to version 1", name=" ")
        expect(page.locator(".q-dialog .notice")).to_contain_text("your name")
        page.keyboard.press("Escape")
        opened(page, served, "map")
        change(page, "Roll back to version 1")
        expect(page.locator(".nicegui-content")).to_contain_text("Robots should use version 1.")
        assert current(served) == 1
        history = page.get_by_role("region", name="History")
        expect(history).to_contain_text("robots lose themselves in aisle 3")
        change(page, "Promote version 2")
        expect(page.locator(".nicegui-content")).to_contain_text("Robots should use version 2.")
        change(page, "Publish draft 3")
        expect(page.locator(".nicegui-content")).to_contain_text("Robots should use version 3.")
        assert current(served) == 3
        assert seen.faults == []

        # Somebody else acts: the page follows.
        with MapStore.open(served.folder) as store:
            releases.roll_back(store, SITE)
        expect(page.locator(".nicegui-content")).to_contain_text("Robots should use version 2.", timeout=10_000)


def test_a_version_taken_back_by_the_server_is_told_with_its_reason(page: Page, served: Served) -> None:
    with MapStore.open(served.folder) as store:
        canary = releases.start_canary(store, SITE, 1, 0.05)
        seen = opened(page, served, "map")
        expect(page.locator(".nicegui-content")).to_contain_text("Version 1 is tried by 5.0 % of them")
        expect(page.get_by_role("button", name="Stop trying version 1")).to_be_visible()
        expect(page.get_by_role("button", name="Roll back")).to_have_count(0)
        opened(page, served, "")
        trial = page.locator(".notice", has_text="Version 1")
        expect(trial).to_contain_text("Version 1 is tried by 5.0 % of the robots")
        releases.end_canary(store, canary, promote=False, outcome="it fails more often than the margin allows")
    expect(trial).to_contain_text("rolled back", timeout=10_000)
    expect(trial).to_contain_text("It fails more often than the margin allows")
    assert seen.faults == []
