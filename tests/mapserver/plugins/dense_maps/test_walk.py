"""The walk through a version: step by step along the places of its surveys, with the plan beside it and the expected view."""

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Page, expect

from mapserver.dashboard.survey_jobs import Loop, loops_of_version
from support.fleet.dashboard_scene import Served, build_report, marks, opened, serving, wait_until
from support.pages.browser import Chromium, box_of
from support.pages.whole_page import assert_whole
from support.storage.dense_samples import rack_surfels, surfel_extras
from support.storage.operator_scene import fill_shift

SEEN = "document.querySelector('.space-view').seen()"


@pytest.fixture(scope="module")
def served(browser: Chromium, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("store")
    extras, said = surfel_extras(rack_surfels())
    fill_shift(folder, extras, surfels=said)
    with serving(folder) as server:
        yield server
    assert [line for line in server.log if "ERROR" in line or "Traceback" in line] == []


def stood(page: Page, place: int) -> tuple[float, float, float]:
    """Where the plan shows that one stands, once it is at this place: x, y and heading."""
    expect(page.locator(".where")).to_have_text(re.compile(f"^Place {place} of 174"))
    x, y, _ = page.evaluate(SEEN)["camera"]
    at = f"Math.abs(m.x - {x}) < 0.02 && Math.abs(m.y - {y}) < 0.02"
    wait_until(page, f"document.querySelector('.site-map').marks().some(m => m.name === 'you' && {at})")
    (here,) = (mark for mark in marks(page) if mark["name"] == "you")
    return here["x"], here["y"], here["heading_rad"]


def test_one_walks_along_the_survey(page: Page, served: Served) -> None:
    seen = opened(page, served, "space")
    page.get_by_role("button", name="Walk through it").click()
    start = stood(page, 1)
    page.keyboard.press("ArrowUp")
    ahead = stood(page, 2)
    assert ahead[0] - start[0] == pytest.approx(1.0, abs=0.03), "the next place of the survey lies a metre ahead"
    assert (ahead[1], ahead[2]) == pytest.approx((start[1], 0.0), abs=0.03)
    for _ in range(12):
        page.keyboard.press("ArrowLeft")
    you = "document.querySelector('.site-map').marks().find(m => m.name === 'you')"
    wait_until(page, f"Math.abs(Math.abs({you}.heading_rad) - Math.PI) < 0.01")
    page.keyboard.press("w")
    assert stood(page, 1)[0] == start[0], "who looks back walks back"
    page.get_by_role("button", name="Turn right").click()
    picture = page.locator(".expected img")
    wait_until(page, "document.querySelector('.expected img').naturalWidth === 320")
    expect(page.locator(".expected figcaption")).to_have_text(re.compile("^Drawn from the surfels: .* at place 1$"))
    first = picture.get_attribute("src")
    box = box_of(page.locator(".site-map"))
    page.locator(".site-map").click(position={"x": box["width"] * 0.6, "y": box["height"] * 0.5})
    expect(page.locator(".where")).not_to_have_text(re.compile("^Place 1 of"))
    wait_until(page, f"document.querySelector('.expected img').src !== {first!r}")
    assert_whole(page)
    page.get_by_role("button", name="Leave the walk").click()
    expect(page.get_by_role("button", name="Walk through it")).to_be_visible()
    assert seen.faults == []
    assert seen.elsewhere([served.http, served.http.replace("http:", "ws:")]) == []


def test_loops_are_shown_refused_ones_on_request(page: Page, served: Served) -> None:
    seen = opened(page, served, "space")
    wait_until(page, f"document.querySelector('.space-view').seen && {SEEN}.landmarks > 0")
    assert page.evaluate(SEEN)["loops"] == {"loops": 1, "refused loops": 2}
    painted = page.locator(".views canvas").screenshot()
    page.get_by_role("checkbox", name="refused loops").check()
    page.wait_for_timeout(300)
    assert page.locator(".views canvas").screenshot() != painted
    assert seen.faults == []


def test_without_surfels_one_walks_among_landmarks_and_is_told(page: Page, served: Served) -> None:
    seen = opened(page, served, "space", version=1, x=30, y=14)
    expect(page.locator(".where")).to_have_text(re.compile("^Place "))
    assert page.evaluate(SEEN)["camera"][:2] == pytest.approx((30.0, 14.0), abs=0.6)
    expect(page.locator("main")).to_contain_text("Version 1 of site hall has no surfels")
    expect(page.locator(".expected")).to_be_hidden()
    assert seen.faults == []
    opened(page, served, "space", version=1, x="here", y=14)
    expect(page.locator(".notice.bad")).to_contain_text("are no place; write metres")


def test_loops_are_those_of_the_build_that_made_the_version() -> None:
    night = {"builds": [build_report() | {"version": 2, "loop_places": []}, build_report()]}
    found = loops_of_version([{}, {"builds": "none"}, night], 3)
    assert [loop.is_accepted for loop in found] == [True, False, False]
    assert found[0] == Loop((10.0, 6.0), (12.0, 6.5), "accepted", "", "monday", 0.4)
    assert loops_of_version([night], 2) == loops_of_version([night], 9) == []
    broken = build_report() | {"loop_places": [{"from_map_m": [1], "to_map_m": [2.0, "x"]}, "none", None]}
    assert loops_of_version([broken], 3) == []
