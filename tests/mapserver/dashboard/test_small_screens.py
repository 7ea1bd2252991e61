"""Acts on a phone, a tablet and a desk, in both looks: everything is in reach, readable and large enough to hit, and does what it says."""

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Locator, Page, expect

from support.fleet.dashboard_scene import Served, opened, overlapping
from support.pages.browser import Chromium, box_of
from support.pages.whole_page import SIZES, WEAKEST_CONTRAST

ACTS = {
    "map": ("Publish draft 3", "Roll back to version 1", "Try version 3 on 5% of the robots"),
    "robots/tug-5": ("tug-5 is here",),
    "administration/people": ("Add an operator",),
}
_LEAST_PX = 32  # of a thing to tap; WCAG 2.2 asks for 24


@pytest.fixture
def phone(browser: Chromium) -> Iterator[Page]:
    with browser.context(viewport={"width": 390, "height": 844}, has_touch=True, color_scheme="dark") as context:
        yield context.new_page()


def assert_in_reach(page: Page, thing: Locator) -> None:
    """Wholly within the width of the screen, and large enough, once it stands still: a dialog opens from a point."""
    thing.click(trial=True)
    box, size = box_of(thing), page.viewport_size
    assert box["x"] >= 0, thing
    assert box["x"] + box["width"] <= size["width"], thing
    assert min(box["width"], box["height"]) >= _LEAST_PX, (thing, box)


def test_every_act_is_in_reach_in_every_size_and_look(page: Page, small_fleet: Served) -> None:
    for path, names in ACTS.items():
        opened(page, small_fleet, path)
        for field in page.get_by_role("spinbutton").all():
            field.fill("6")  # the place of a robot, without which there is nothing to say yes to
        for look in ("light", "dark"):
            page.emulate_media(color_scheme=look)
            for width, height in SIZES:
                page.set_viewport_size({"width": width, "height": height})
                for name in names:
                    act = page.get_by_role("button", name=name, exact=True)
                    assert_in_reach(page, act)
                    act.click()
                    dialog = page.get_by_role("dialog")
                    for label in ("Your name", "Reason"):
                        assert_in_reach(page, dialog.get_by_label(label))
                    for begin in ("^Yes", "^No"):
                        assert_in_reach(page, dialog.get_by_role("button", name=re.compile(begin)))
                    contrast, words = page.evaluate(WEAKEST_CONTRAST)
                    assert contrast >= 4.5, f"{name}, {look}, {width}: {words}"
                    dialog.get_by_role("button", name=re.compile("^No")).click()
                    expect(dialog).to_have_count(0)


def test_every_page_is_in_reach_of_a_thumb(phone: Page, small_fleet: Served) -> None:
    opened(phone, small_fleet, "robots")
    links = phone.get_by_role("navigation", name="Pages").get_by_role("link").all()
    assert len(links) >= 7
    for link in links:
        assert_in_reach(phone, link)
    boxes = [(box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"]) for box in map(box_of, links)]
    assert overlapping(boxes) == []


def test_each_robot_is_in_reach_on_a_phone_held_sideways(phone: Page, small_fleet: Served) -> None:
    phone.set_viewport_size({"width": 844, "height": 390})
    opened(phone, small_fleet, "")
    phone.get_by_role("list", name="Robots, problems first").get_by_role("link", name="tug-7", exact=True).tap()
    expect(phone.locator("h1")).to_have_text("tug-7")
