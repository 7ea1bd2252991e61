"""The console without a pointer: Tab, Enter, Escape and arrow keys reach every page and act, and one always sees where one is."""

import re

from playwright.sync_api import Page, expect

from support.fleet.dashboard_scene import Served, marks, opened

_MOST_TABS = 120
_FOCUS = """() => {
  const at = document.activeElement, { outlineStyle, outlineWidth } = getComputedStyle(at), { width } = at.getBoundingClientRect();
  const name = (at.ariaLabel || at.labels?.[0]?.firstChild.textContent || at.textContent).trim();
  return [at === document.body ? '' : name || at.className, width > 0 && outlineStyle !== 'none' && parseFloat(outlineWidth) >= 2,
          Boolean(at.closest('dialog'))];
}"""


def tab_to(page: Page, name: str) -> None:
    """Presses Tab until something that begins so has the focus; all on the way show that they have it."""
    passed = []
    for _ in range(_MOST_TABS):
        page.keyboard.press("Tab")
        found, is_seen, _ = page.evaluate(_FOCUS)
        assert is_seen or not found, f"{found} does not show its focus on {page.url}"
        if found.startswith(name):
            return
        passed.append(found)
    raise AssertionError(f"no Tab leads to {name}: {passed}")


def enter(page: Page, name: str, title: str) -> None:
    """Follows a link with the keyboard."""
    tab_to(page, name)
    page.keyboard.press("Enter")
    expect(page.locator("h1")).to_have_text(title)


def test_everything_is_reached_with_the_keyboard_alone(page: Page, small_fleet: Served) -> None:
    opened(page, small_fleet, "")
    page.keyboard.press("Tab")
    assert page.evaluate(_FOCUS)[:2] == ["Skip to the page", True]
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "main"
    tab_to(page, "Map of hall")
    before = marks(page)[0]["page"][0]
    page.keyboard.press("ArrowRight")
    page.wait_for_timeout(600)
    assert marks(page)[0]["page"][0] < before - 20, "arrow keys move the map"
    enter(page, "tug-3", "tug-3")
    tab_to(page, "Theme")
    page.keyboard.press("ArrowDown")
    assert page.evaluate("document.body.className") == "console "
    tab_to(page, "Map of hall")
    for _ in range(20):
        page.keyboard.press("ArrowRight")
    page.wait_for_timeout(600)
    moved = marks(page)[0]["page"]
    page.wait_for_timeout(2500)
    assert marks(page)[0]["page"] == moved, "the map stays where it was moved to, and does not follow the robot"

    enter(page, "Trends", "Trends of hall")
    tab_to(page, "Last 24 h")
    for key in ("Enter", "Tab", "Escape"):
        page.keyboard.press(key)
    assert page.evaluate(_FOCUS)[0] == "Last 24 h"
    expect(page.get_by_label("Until")).to_be_hidden()

    enter(page, "Robots", "Robots of hall")
    assert page.evaluate("document.body.className") == "console ", "the look that was chosen stays"
    tab_to(page, "Find a robot")
    page.keyboard.type("tug-3")
    expect(page.locator("#rows tbody tr").filter(visible=True)).to_have_count(1)
    tab_to(page, "tug-3")
    page.wait_for_timeout(6000)
    assert page.evaluate(_FOCUS)[0] == "tug-3", "a list that renews itself keeps the focus"
    page.keyboard.press("Enter")
    expect(page.locator("h1")).to_have_text("tug-3")

    enter(page, "Map", "Map of hall")
    tab_to(page, "Roll back to version 1")
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog")).to_be_visible()
    for key in ("Tab", "Shift+Tab"):
        for _ in range(6):
            name, is_seen, is_inside = page.evaluate(_FOCUS)
            assert (is_inside and is_seen) or not name, f"the dialog lets {name} have the focus"
            page.keyboard.press(key)
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_have_count(0)
    assert page.evaluate(_FOCUS)[0] == "Roll back to version 1"
    page.keyboard.press("Enter")
    for words in ("ada", "it got worse"):
        page.keyboard.type(words)
        page.keyboard.press("Tab")
    assert page.evaluate(_FOCUS)[0].startswith("Yes")
    page.keyboard.press("Enter")
    expect(page.locator("#used")).to_have_text("Robots should use version 1.")

    enter(page, "Failures", "Failures of hall")
    tab_to(page, "dark")
    page.keyboard.press("Enter")
    expect(page).to_have_url(re.compile("cause=dark"))
    enter(page, "Failure 1", "Failure 1 of tug-7")
    tab_to(page, "Skip to the page")  # round the whole page
