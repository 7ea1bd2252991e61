"""The operator's questions, asked as somebody would who has not seen the pages before: the right answer in at most two clicks each."""

import re
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field

import pytest
from playwright.sync_api import Locator, Page, TimeoutError, expect

from mapserver.store import MapStore
from support.fleet.dashboard_scene import SITE, Served, marks, opened, overlapping, serving, talking
from support.pages.browser import Chromium, box_of
from support.storage.operator_scene import WORSE, fill_shift

MOST_CLICKS = 2


@pytest.fixture(scope="module")
def served(browser: Chromium, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("store")
    fill_shift(folder)
    with serving(folder) as server:
        yield server


@dataclass
class Operator:
    """Looks at pages and counts clicks. Begins on the Overview."""

    page: Page
    served: Served
    clicks: int = 0
    faults: list[str] = field(default_factory=list)

    def begin(self) -> None:
        self.clicks, self.faults = 0, opened(self.page, self.served, "").faults

    def click(self, thing: Locator) -> None:
        self.clicks += 1
        thing.click()

    def follow(self, link: Locator, to: str) -> None:
        """Clicks a link of a table that is drawn anew each second: a row that is replaced under the pointer takes no click."""
        self.clicks += 1
        for _ in range(5):
            link.click()
            with suppress(TimeoutError):
                return self.page.wait_for_url(to, timeout=15_000)
        raise AssertionError(f"{link} does not lead to {to}")


@pytest.fixture
def operator(page: Page, served: Served) -> Iterator[Operator]:
    made = Operator(page, served)
    with talking(served.zenoh, 20) as moved:
        moved["tug-4"] = (33.0, 14.0)  # lost in aisle 2
        time.sleep(3)
        made.begin()
        yield made
    assert made.faults == []


@pytest.mark.parametrize("size", [(390, 844), (1280, 800)])
def test_names_of_robots_keep_off_those_of_areas(page: Page, served: Served, size: tuple[int, int]) -> None:
    page.set_viewport_size({"width": size[0], "height": size[1]})
    with talking(served.zenoh, 8):
        opened(page, served, "")
        expect(page.locator("#figures")).to_contain_text("8 of 8", timeout=60_000)
        names = [mark["nameBox"] for mark in marks(page, 8) if mark["nameBox"]]
        areas = page.evaluate(
            "[...document.querySelectorAll('.area-name')].map(e => e.getBoundingClientRect()).filter(r => r.width)"
            ".map(r => [r.left, r.top, r.right, r.bottom])"
        )
    assert len(areas) >= 3
    assert len(names) >= 6
    assert overlapping(names) == []
    assert overlapping(names, areas) == []


def test_which_robots_need_a_person_now(operator: Operator) -> None:
    expect(operator.page.get_by_role("status")).to_contain_text("not localised", timeout=60_000)
    row = operator.page.locator("#robots li", has=operator.page.get_by_role("link", name="tug-4", exact=True))
    expect(row).to_contain_text("lost")
    expect(row).to_contain_text(WORSE)
    expect(row.locator(".since")).to_have_attribute("title", re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d"))
    assert box_of(row)["y"] < 600, "the answer is in sight"
    assert operator.clicks == 0


def test_why_did_tug_7_fail_at_14_03(operator: Operator) -> None:
    page = operator.page
    operator.follow(page.get_by_role("link", name="tug-7", exact=True).last, "**/robots/tug-7*")
    failed = page.get_by_role("list", name="Failures").locator("li", has=page.get_by_title(re.compile(r" \d\d:03:07 ")))
    operator.click(failed.get_by_role("link", name=re.compile("^Failure")))
    expect(page.get_by_role("status")).to_contain_text(
        re.compile(r"^tug-7 failed .* in aisle 2: carried 5.0 m, by its own fixes, .*found again after 1.9 s")
    )
    assert operator.clicks <= MOST_CLICKS


def listed_in(page: Page, area: str) -> None:
    """All failures that are listed are of an area."""
    listed = page.get_by_role("list", name="Failures").get_by_role("listitem")
    expect(listed.first).to_contain_text(area)
    assert all(area in words for words in listed.all_inner_texts())


def test_which_aisle_got_worse_this_week(operator: Operator) -> None:
    page = operator.page
    week = page.locator(".notice", has_text="This week: Aisle 2 got worse; in 1 of 4 too little was driven")
    assert box_of(week)["y"] < 600, "without scrolling"
    operator.click(page.get_by_role("link", name="Area by area"))
    heading = page.get_by_role("heading", name="What got worse this week")
    expect(heading).to_be_in_viewport()
    table = page.get_by_role("table", name="What got worse this week")
    expect(table.get_by_role("row").nth(1)).to_contain_text(re.compile(r"^aisle 2\s*worse\S+ to \S+ times"))
    expect(table.get_by_role("row", name=re.compile("^dock"))).to_contain_text("too little driving to say")
    operator.click(table.get_by_role("link", name="aisle 2"))
    expect(page.locator("h1")).to_have_text("Failures of hall")
    listed_in(page, "aisle 2")
    assert operator.clicks <= MOST_CLICKS


def test_what_failed_in_aisle_2_today(operator: Operator) -> None:
    page = operator.page
    operator.click(page.get_by_role("link", name="Area by area"))
    week = page.get_by_role("table", name="What got worse this week")
    operator.click(week.get_by_role("link", name="aisle 2"))
    operator.clicks = 0
    chosen = page.get_by_role("list", name="Area").locator(".chosen")
    operator.click(page.get_by_role("link", name="Today", exact=True))
    expect(chosen).to_contain_text("aisle 2")
    expect(page.locator("input[name=since]")).to_have_value(re.compile(r"^\d{4}-\d\d-\d\dT00:00$"))
    assert operator.clicks <= MOST_CLICKS
    operator.clicks = 0
    operator.click(page.get_by_role("list", name="Area").get_by_role("link", name="aisle 1"))
    expect(chosen).to_contain_text("aisle 1")
    operator.click(page.get_by_role("link", name="Last 7 days", exact=True))
    listed_in(page, "aisle 1")
    assert operator.clicks <= MOST_CLICKS


def test_what_would_promoting_do_and_undo_it(operator: Operator) -> None:
    """Undoing is two clicks and a form: the button, a name and a reason, and yes."""
    page = operator.page
    operator.click(page.get_by_role("link", name="Map", exact=True))
    operator.click(page.get_by_role("button", name="Publish draft 3", exact=True))
    dialog, used = page.get_by_role("dialog"), page.get_by_role("status")
    expect(dialog).to_contain_text(
        re.compile("Draft 3 goes through the gate. If the gate accepts it, all 20 robots of hall get it.")
    )
    assert operator.clicks <= MOST_CLICKS
    dialog.get_by_label("Your name").fill("ada")
    dialog.get_by_role("button", name=re.compile("^Yes")).click()
    expect(used).to_have_text("Robots should use version 3.")

    operator.begin()
    operator.click(page.get_by_role("link", name="Map", exact=True))
    operator.click(page.get_by_role("button", name="Roll back to version 2", exact=True))
    expect(dialog).to_contain_text("All 20 robots of hall go from version 3 back to version 2.")
    assert operator.clicks <= MOST_CLICKS
    dialog.get_by_label("Your name").fill("ada")
    dialog.get_by_label("Reason").fill("it got worse")
    dialog.get_by_role("button", name=re.compile("^Yes")).click()
    expect(used).to_have_text("Robots should use version 2.")
    with MapStore.open(operator.served.folder) as store:
        assert store.current(SITE).version == 2
