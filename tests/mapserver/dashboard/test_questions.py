"""The operator's questions, asked as somebody would who has not seen the pages before: the right answer in at most two clicks each."""

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

import pytest
from playwright.sync_api import Locator, Page, expect

from mapserver import releases
from mapserver.fleet.building import ask_for_survey
from mapserver.fleet.fleet import Fleet
from mapserver.store import Actor, MapStore
from mapserver.trust.enrolment import RobotRegister
from support.fleet.dashboard_scene import SITE, Served, marks, opened, overlapping, serving, talking
from support.pages.browser import Chromium, agree, box_of
from support.storage.operator_scene import WORSE, failed_at, fill_shift, yesterday

MOST_CLICKS = 2


@pytest.fixture(scope="module")
def served(browser: Chromium, tmp_path_factory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("store")
    fill_shift(folder)
    with serving(folder) as server, MapStore.open(folder) as store:
        register = RobotRegister(store)
        register.authorities.init(["localhost"], None, None)
        register.enrol(SITE, ["tug-7"], "tls/localhost:7447", actor=Actor("ada", "a new robot"))
        yield server


@dataclass
class Operator:
    """Looks at pages and counts clicks; one too many fails. Begins on the Overview."""

    page: Page
    served: Served
    clicks: int = 0

    def begin(self) -> None:
        self.clicks = 0
        opened(self.page, self.served, "")

    def count(self) -> None:
        self.clicks += 1
        assert self.clicks <= MOST_CLICKS, f"click {self.clicks}, on {self.page.url}"

    def click(self, thing: Locator) -> None:
        self.count()
        thing.click()

    def go(self, name: str) -> None:
        """Clicks a link with this name."""
        self.click(self.page.get_by_role("link", name=name, exact=True).first)


@pytest.fixture
def operator(page: Page, served: Served) -> Iterator[Operator]:
    made = Operator(page, served)
    with talking(served.zenoh, 30) as moved:
        moved["tug-19"] = (33.0, 14.0)  # lost in aisle 2
        time.sleep(3)
        made.begin()
        yield made


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
    opened(page, served, "map")  # areas are in sight as wholes, also where they are larger than what was surveyed
    around = box_of(page.locator(".site-map"))
    for area in map(box_of, page.locator(".site-map path.area").all()):
        assert around["y"] <= area["y"]
        assert area["y"] + area["height"] <= around["y"] + around["height"]


def test_which_robots_need_a_person_now(operator: Operator) -> None:
    words = "Of 30 robots online: 2 not localised, 1 uncertain."
    expect(operator.page.get_by_role("status")).to_have_text(words, timeout=60_000)
    rows = operator.page.locator("#robots li")
    for n, told in enumerate(("tug-18lost", f"tug-19lost.*{WORSE}", "tug-17uncertain")):
        expect(rows.nth(n)).to_have_text(re.compile(f"{told}.*odometry lost"))
        expect(rows.nth(n).locator(".since")).to_have_attribute("title", re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d"))
        assert box_of(rows.nth(n))["y"] < 700, "the answer is in sight"
    operator.page.get_by_label("Find a robot").fill("tug-19")
    expect(rows.filter(visible=True)).to_have_count(1)
    assert operator.clicks == 0


def test_why_did_tug_7_fail_at_14_03(operator: Operator) -> None:
    page = operator.page
    operator.click(page.get_by_role("link", name="tug-7", exact=True).last)
    failed = page.get_by_role("list", name="Failures").locator("li", has=page.get_by_title(re.compile(r" \d\d:03:07 ")))
    operator.click(failed.get_by_role("link", name=re.compile("^Failure")))
    told = r"^tug-7 failed .* in aisle 2: carried 5.0 m, by its own fixes, .*found again after 1.9 s"
    expect(page.get_by_role("status")).to_contain_text(re.compile(told))


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
    expect(page.get_by_role("heading", name="What got worse this week")).to_be_in_viewport()
    table = page.get_by_role("table", name="What got worse this week")
    expect(table.get_by_role("row").nth(1)).to_contain_text(re.compile(r"^aisle 2\s*worse\S+ to \S+ times"))
    expect(table.get_by_role("row", name=re.compile("^dock"))).to_contain_text("too little driving to say")
    operator.click(table.get_by_role("link", name="aisle 2"))
    expect(page.locator("h1")).to_have_text("Failures of hall")
    listed_in(page, "aisle 2")
    opened(page, operator.served, "trends", until=f"{datetime.fromtimestamp(yesterday(12, 0) / 1e9, UTC):%Y-%m-%d}")
    page.get_by_role("link", name="aisle 2").click()
    expect(page.locator("h1")).to_have_text("Failures of hall")


def test_what_happened_last(operator: Operator) -> None:
    page = operator.page
    opened(page, operator.served, "failures")
    operator.click(page.get_by_role("link", name="happened", exact=True))
    listed = page.get_by_role("list", name="Failures").locator("time")
    expect(page.locator("strong", has_text="happened")).to_be_visible()
    moments = [datetime.fromisoformat(when[:19]) for when in listed.evaluate_all("all => all.map(one => one.title)")]
    assert len(moments) > 5
    assert moments == sorted(moments, reverse=True)
    operator.begin()  # and what happened between 14:00 and 15:00
    operator.go("Failures")
    operator.click(page.locator(".range summary"))
    for end, hour in (("From", 14), ("Until", 15)):
        page.get_by_label(end).fill(f"{datetime.fromtimestamp(yesterday(hour, 0) / 1e9, UTC):%Y-%m-%dT%H:%M}")
    page.keyboard.press("Enter")
    expect(page.locator("#answer")).to_have_text("1 failure.")


def test_what_failed_in_aisle_2_today(operator: Operator) -> None:
    page = operator.page
    with MapStore.open(operator.served.folder) as store:
        report = failed_at("tug-6", "today", store.now_ns(), (30.0, 14.0), cause="no_match")
        assert not Fleet(store).take_failure(SITE, "tug-6", report).refused
    operator.go("Failures")
    operator.click(page.get_by_role("list", name="Area").get_by_role("link", name=re.compile(r"^aisle 2: \d today")))
    chosen = page.get_by_role("list", name="Area").locator(".chosen")
    expect(chosen).to_contain_text("aisle 2")
    expect(page.get_by_role("list", name="Failures").get_by_role("listitem").first).to_contain_text("tug-6")
    expect(page.locator(".range [name=since]")).to_have_value(re.compile(r"^\d{4}-\d\d-\d\dT00:00$"))
    operator.clicks = 0
    operator.click(page.get_by_role("list", name="Area").get_by_role("link", name="aisle 1"))
    expect(chosen).to_contain_text("aisle 1")
    operator.clicks = 0
    operator.click(page.locator(".range summary"))
    operator.click(page.get_by_role("link", name="Last 7 days", exact=True))
    listed_in(page, "aisle 1")


def test_questions_that_a_page_answers(operator: Operator) -> None:
    with MapStore.open(operator.served.folder) as store:
        progress = {"stage": "matching", "done": 30, "total": 120, "stage_s": 60.0}
        store.tell_progress(store.begin_job(SITE, "build"), progress)
        ask_for_survey(store, SITE, [(20.0, 2.0), (30.0, 2.0), (30.0, 9.0)], Actor("bob", "new racks"))
        trial = releases.start_canary(store, SITE, 1, 0.2)
        store.update_job(store.begin_job(SITE, "nightly"), "failed", "it was interrupted", {"waiting": []})
    failures = r"1\d failures of 8 robots\. Most: no match \(1\d\), in aisle 2 \(\d+\)\."
    tried = r"Version 1 is tried by 20.0 % of the robots .*No decision before robots drive with it"
    for question, links, where, words in (
        ("what needs me now", [], "#notices p", r"The night of hall failed \(job \d+\): it was interrupted\. Surveys"),
        ("what needs me now", [], "#notices p", r"Draft 3 is not published\. .* Map"),
        ("is it one robot or one place", ["Failures"], "#answer", failures),
        ("who published last and why", ["Map"], "#versions", r"2\s*current[^V]*by ada .* ago: the nightly map"),
        ("is the canary good", [], "#notices", tried),
        ("what is being built", ["Surveys"], "#jobs", r"build\s*running[^J]*matching: 30 of 120, about 3 min more"),
        ("why was it left out", ["Surveys"], ".recordings", r"sunday\s*left out\s*saw nothing that the map has"),
        ("where must I survey again", ["Surveys", "Where to survey again"], "#again ~ .scroll tr", "bob asked for it"),
        ("is the disk filling", ["Administration"], "#disk", r"GB of .* GB are free: enough"),
        ("when do certificates end", ["Administration"], "#endings tr", r"of the server for robots.*\d+ days"),
        ("who enrolled this robot", ["Robots", "tug-7"], "main p", r"Enrolled by ada, \d+ \S+ ago"),
        ("which robots had drops", ["Robots"], "#rows tr", r"^tug-3.*2\.0 %$"),
        ("who did that", ["Administration", "Log"], "#lines tr", r"ada.*robot enrolled: tug-7.*a new robot"),
    ):
        operator.begin()
        for link in links:
            operator.go(link)
        answer = operator.page.locator(where).filter(has_text=re.compile(words, re.DOTALL)).first
        expect(answer, question).to_be_in_viewport()
    operator.begin()
    night = operator.page.locator("#notices p", has_text="The night of hall failed")
    night.get_by_role("button", name="Hand over").press("Enter")  # by the keyboard alone: as many keys as clicks
    operator.count()
    operator.page.keyboard.type("bob")
    operator.page.keyboard.press("Tab")
    operator.page.keyboard.type("ada")
    operator.page.keyboard.press("Enter")
    operator.count()
    expect(night).to_contain_text("bob has it.")
    operator.begin()
    operator.go("Map")
    operator.click(operator.page.get_by_role("button", name="Publish draft 3", exact=True))
    expect(operator.page.get_by_role("dialog")).to_contain_text("The trial of version 1 ends.")
    with MapStore.open(operator.served.folder) as store:
        releases.end_canary(store, trial, promote=False, outcome="tried enough")


def test_what_would_promoting_do_and_undo_it(operator: Operator) -> None:
    """Undoing is two clicks and a form: the button, a name and a reason, and yes."""
    page = operator.page
    operator.go("Map")
    operator.click(page.get_by_role("button", name="Publish draft 3", exact=True))
    dialog, used = page.get_by_role("dialog"), page.get_by_role("status")
    told = "goes through the gate. If the gate accepts it, all 30 robots of hall get it. "
    expect(dialog).to_contain_text(re.compile(f"{told}It changes .* tiles? of .* m²: .*landmarks"))
    agree(page, {"Your name": "ada"})
    expect(used).to_have_text("Robots should use version 3.")

    operator.begin()
    operator.go("Map")
    operator.click(page.get_by_role("button", name="Roll back to version 2", exact=True))
    expect(dialog).to_contain_text("All 30 robots of hall go from version 3 back to version 2.")
    agree(page, {"Your name": "ada", "Reason": "it got worse"})
    expect(used).to_have_text("Robots should use version 2.")
    with MapStore.open(operator.served.folder) as store:
        assert store.current(SITE).version == 2
