"""The page of a failure: its answer says what the recording shows and no more, and its seconds can be stepped through."""

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC
from pathlib import Path
from zoneinfo import ZoneInfo

import httpx
import msgspec
import pytest
from playwright.sync_api import Page, expect

from fleetmap.failure_summary import Moment
from fleetmap.messages import FailureReport
from mapserver.dashboard import failure as story
from mapserver.dashboard import failures
from mapserver.dashboard.console import PageContext
from mapserver.fleet.fleet import Fleet
from mapserver.fleet_statistics.kpis import HOUR_NS
from mapserver.store import FailureDetail, FailureRow, MapStore, PictureRow
from support.fleet.dashboard_scene import SITE, Served, failure, fill_store, marks, opened, picture, serving, wait_until
from support.fleet.failed_robot import send_replay, small_file
from support.pages.browser import Chromium
from support.pages.whole_page import assert_whole

BEGAN_NS = 50_000_000_000
AT_NS = 1_790_000_000_000_000_000  # by the server's clock: 2026-09-21 14:13:20 UTC


def told(status: str, since_s: float, until_s: float, x_m: float | None, cause: str = "") -> list[Moment]:
    """What a robot says every 0.1 s, driving along x."""
    said = []
    for tenth in range(round(10 * since_s), round(10 * until_s)):
        place = None if x_m is None else (x_m + 0.05 * (tenth - 10 * since_s), 6.0, 0.0)
        said.append(Moment(BEGAN_NS + tenth * 10**8, status, cause, place, 0.0, None if place is None else 0.05))
    return said


CARRIED = (
    *told("TRACKING", -5, 0, 17.5),
    *told("LOST", 0, 1.9, None, "odometry lost"),
    *told("TRACKING", 1.9, 5, 25.0),
)


def detail(**changes: object) -> FailureDetail:
    report = msgspec.structs.replace(failure("tug-7", "f"), **changes)
    told = report.duration_s, report.kind, report.cause, report.status
    row = FailureRow(1, SITE, "tug-7", "f", AT_NS, AT_NS, *told, 2, "1,0", 20.0, 6.0)
    return FailureDetail(row, report, [])


def answer(moments: tuple[Moment, ...], **changes: object) -> str:
    return story.answer(detail(**changes), moments, story.FailureClock(BEGAN_NS, AT_NS, UTC))


def test_a_robot_that_was_carried() -> None:
    words = answer(CARRIED, cause="carried", wrong_by_m=5.0)
    assert words == "carried 5.0 m, by its own fixes, between 14:13:19.9 and 14:13:21.9, found again after 1.9 s"
    words = answer(CARRIED[:60], cause="carried", wrong_by_m=5.0)
    assert words == (
        "carried 5.0 m, by its own fixes, after 14:13:19.9, not found again until the recording ends at 14:13:20.9"
    )


def test_the_answer_says_what_the_recording_shows_and_no_more() -> None:
    assert answer(()) == "dark, lost for 3.5 s when it reported"
    assert answer((), wrong_by_m=2.0).endswith("; its later fixes put it 2.0 m from where it believed to be")
    assert answer(CARRIED) == "dark, no position to rely upon from 14:13:20.0 until 14:13:21.9, found again after 1.9 s"
    always = tuple(told("TRACKING", -5, 5, 17.5))
    assert answer(always, status="TRACKING") == "dark, localised for 3.5 s when it reported", "it never said otherwise"
    before = (*told("LOST", -5, -3, None), *told("TRACKING", -3, 0, 17.5), *told("LOST", 0, 5, None))
    words = answer(before)
    assert "from 14:13:20.0 until 14:13:24.9" in words, "what was over before the failure is another matter"
    assert "not found again until the recording ends at 14:13:24.9" in words
    unsure = [msgspec.structs.replace(each, radius_95_m=0.4) for each in told("DEGRADED", 0, 2, 20.0)]
    parts = (*told("TRACKING", -5, 0, 17.5), *unsure, *told("TRACKING", 2, 3, 21.0), *told("LOST", 3, 4, None))
    words = answer((*parts, *told("NEW_WORD", 4, 5, 22.0)))
    assert "for 3.0 s in 2 parts from 14:13:20.0 until 14:13:24.0, not found again" in words
    assert "since before 14:13:15.0" in answer(tuple(told("INITIALISING", -5, 5, None)), kind="not_found")


def test_moments_and_pictures_of_another_time_are_left_out() -> None:
    far = PictureRow(9, "replay", 1 << 61, 10)
    near = [PictureRow(n, "replay", BEGAN_NS + k * 10**8, 10) for n, k in enumerate((-50, -9, -2, 4, 19, 23))]
    assert story.pictures_near([far, *near[::-1]], BEGAN_NS) == near
    assert story.first_looks(CARRIED, BEGAN_NS) == {"A second before": 4000, "As it began": 5000, "Found again": 6900}
    assert list(story.first_looks(CARRIED[:60], BEGAN_NS)) == ["A second before", "As it began"]


def test_the_seconds_have_a_gap_where_the_robot_was_silent() -> None:
    found = story.instants((*CARRIED[:10], *CARRIED[60:]), [], story.FailureClock(BEGAN_NS, AT_NS, UTC))
    told = [(each["at_ms"], each["words"]) for each in found[9:12]]
    assert told == [(900, "localised"), (1000, "nothing recorded"), (6000, "lost, odometry lost")]


def test_the_path_is_broken_where_the_estimate_was_corrected() -> None:
    lines = story.believed_path(CARRIED, story.FailureClock(BEGAN_NS, AT_NS, None))
    assert [(line.tone, len(line.points)) for line in lines] == [("good", 50), ("good", 31)]
    at_once = (*CARRIED[:50], *CARRIED[69:])
    moments = tuple(msgspec.structs.replace(each, stamp_ns=BEGAN_NS + n * 10**8) for n, each in enumerate(at_once))
    lines = story.believed_path(moments, story.FailureClock(BEGAN_NS, AT_NS, None))
    assert [(line.tone, len(line.points)) for line in lines] == [("good", 50), ("quiet", 2), ("good", 31)]
    assert "corrected by 5.1 m" in lines[1].words


def test_causes_over_time_are_all_in_the_bars_and_a_bar_leads_to_its_time() -> None:
    query = {"since": "2026-09-21T16:13", "until": "2026-10-05T00:00", "robot": "r"}
    context = PageContext("", SITE, ZoneInfo("Africa/Cairo"), query)
    found = [("dark", 0), ("dark", 0), ("glare", 0), ("new", 1), ("dark", 13)]
    rows = [replace(detail().failure, cause=cause, happened_ns=AT_NS + day * 24 * HOUR_NS) for cause, day in found]
    chart = failures._chart(context, rows, {"dark": 0, "glare": 1}, {"robot": "r"})
    assert (len(chart["bars"]), chart["most"], chart["step"]) == (14, 3, "a day")
    first, second, *_, last = chart["bars"]
    assert [(p["shade"], round(p["top"]), round(p["height"])) for p in first["parts"]] == [(0, 33, 67), (1, 0, 33)]
    assert first["to"] == "/failures?site=hall&since=2026-09-21T00%3A00&until=2026-09-22T00%3A00&robot=r"
    assert second["parts"][0]["shade"] == 5, "a cause without a shade of its own"
    assert last["words"] == "2026-10-04 00:00:00 EEST, a day: 1 dark"


def report(name: str, **changes: object) -> FailureReport:
    return msgspec.structs.replace(failure(name, f"of-{name}"), **changes)


@pytest.fixture(scope="module")
def served(browser: Chromium, tmp_path_factory) -> Iterator[Served]:
    """Failure 3: a robot that was carried, with a recording. 4: a recording by somebody who wants to do harm."""
    folder = tmp_path_factory.mktemp("store")
    fill_store(folder)
    with MapStore.open(folder) as store:
        fleet = Fleet(store)
        jpegs = [picture(f"{n}", 320) for n in range(20)]
        far = msgspec.structs.replace(CARRIED[40], position_map_m=(1e11, -1e11, 0.0), cause="<b>y</b>")
        early, late = Moment(-(1 << 62), "LOST", "<b>x</b>"), Moment(1 << 61, "<i>", "", (1e11, 0.0, 0.0))
        harm = (early, far, *CARRIED[41:60], late)
        for name, moments in (("tug-3", CARRIED), ("tug-4", harm)):
            assert not fleet.take_failure(SITE, name, report(name, cause="carried", wrong_by_m=5.0)).refused
            stamps_ns = tuple(BEGAN_NS + k * 5 * 10**8 for k in range(-10, 10))
            given = {"site": SITE, "robot": name, "id": f"of-{name}", "began_ns": BEGAN_NS, "stamps_ns": stamps_ns}
            file = small_file(folder / "failure.mcap", jpegs=jpegs, moments=moments, **given)
            send_replay(fleet, SITE, name, f"of-{name}", file)
        fleet.flush()
    with serving(folder) as server:
        yield server
    assert [line for line in server.log if "ERROR" in line or "Traceback" in line] == []


def test_the_seconds_are_stepped_through(page: Page, served: Served) -> None:
    opened(page, served, "failures/3")
    answer = page.get_by_role("status")
    told = r"^tug-3 failed .* ago in tile 1,0: carried 5.0 m, by its own fixes, between .*again after 1.9 s\.$"
    expect(answer).to_have_text(re.compile(told))
    expect(answer.locator("time")).to_have_attribute("title", re.compile(r"^\d{4}-\d\d-\d\d "))
    steps = page.locator("[data-at]")
    expect(steps).to_have_text(["A second before", "As it began", "Found again"])
    said, slider, seen_image = page.locator(".now"), page.get_by_role("slider", name="Moment"), page.locator("#seen")
    expect(said).to_have_text(re.compile(r"^lost, odometry lost at \d\d:\d\d:\d\d\.\d, 0.0 s after .*no position$"))
    first = seen_image.get_attribute("src")
    slider.press("ArrowLeft")
    before = r"^localised at .*, 0.1 s before .*at 19.95, 6.00 m, within 0.05 m with 95 %$"
    expect(said).to_have_text(re.compile(before))
    at = "x => document.querySelector('.site-map').marks().some(m => m.words.endsWith(': localised') && Math.abs(m.x - x) < 1e-6)"
    wait_until(page, at, 19.95)
    assert page.locator("#seen-when").inner_text()[-10:] not in said.inner_text(), "a picture is half a second older"
    slider.press("End")
    expect(slider).to_have_attribute("aria-valuetext", re.compile("4.9 s after the beginning: localised$"))
    wait_until(page, at, 26.5)
    expect(seen_image).not_to_have_attribute("src", first)
    wait_until(page, "document.getElementById('seen').naturalWidth === 320")
    steps.first.click()
    expect(said).to_contain_text("1.0 s before the beginning")
    assert page.locator("path.line.good").count() == 2
    assert_whole(page)
    with page.expect_download() as download:
        page.get_by_role("link", name=re.compile("MCAP")).click()
    assert Path(download.value.path()).read_bytes() == httpx.get(f"{served.http}/v1/failures/3/replay.mcap").content


def test_a_failure_without_a_recording_shows_what_the_report_has(page: Page, served: Served) -> None:
    opened(page, served, "failures/1")
    expect(page.get_by_label("Site")).to_have_value(SITE)
    expect(page.get_by_role("link", name="All failures")).to_have_attribute("href", re.compile(f"site={SITE}$"))
    expect(page.locator("#seen")).to_be_visible()
    expect(page.locator("main")).to_contain_text("no recording of the seconds around it")
    assert page.get_by_role("slider", name="Moment").count() == 0
    assert any(mark["shape"] == "cross" for mark in marks(page))


def test_one_or_many(page: Page, served: Served) -> None:
    opened(page, served, "failures/3")
    expect(page.locator("main")).to_contain_text(
        "3 others began within 5 m of it, 1 with this cause, of 3 other robots; tug-3 never failed elsewhere."
    )
    expect(page.get_by_role("list", name="Failures").get_by_role("listitem")).to_have_count(3)


def test_a_recording_made_to_harm_is_shown_as_words(page: Page, served: Served) -> None:
    opened(page, served, "failures/4")
    page.get_by_role("slider", name="Moment").press("Home")
    expect(page.locator("#now")).to_have_text("localised, <b>y</b>")
    assert page.locator("#now b").count() == 0
    assert all(abs(mark["x"]) < 100 for mark in marks(page))
