"""The dashboard in a real browser: every page, live changes, versions promoted and rolled back, nothing loaded from elsewhere."""

import re
import time
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from urllib.parse import urlsplit
from zoneinfo import ZoneInfo

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from fleetmap.bus import ZenohBus
from fleetmap.messages import FailureAck, decode_message, encode_message, robot_key
from mapserver import releases
from mapserver.store import MapStore
from support.fleet.dashboard_scene import (
    SITE,
    Seen,
    Served,
    chromium,
    failure,
    fill_store,
    place_of,
    serving,
    talking,
    watch,
)

ROBOTS = 300
expect.set_options(timeout=30_000)  # a busy machine answers late
PAGES = {
    "": "Robots of hall",
    "map": "Map of hall",
    "failures": "Failures of hall",
    "failures/1": "Failure 1 of tug-7",
    "robots/tug-7": "tug-7",
    "surveys": "Surveys of hall",
    "live": "Survey of hall",
}


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    path = chromium()
    with sync_playwright() as playwright:
        # The second name is how a page from elsewhere would reach loopback.
        rules = "--host-resolver-rules=MAP elsewhere.example 127.0.0.1"
        started = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", rules])
        yield started
        started.close()


@pytest.fixture(scope="module")
def served(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("store")
    fill_store(folder)
    with serving(folder) as server:
        with talking(server.zenoh, ROBOTS):
            deadline_s = time.monotonic() + 30
            while len(httpx.get(f"{server.http}/v1/robots?limit=1000").json()["robots"]) < ROBOTS:
                assert time.monotonic() < deadline_s
                time.sleep(0.2)
        yield server
    assert [line for line in server.log if "ERROR" in line or "Traceback" in line] == []


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    context.set_default_timeout(90_000)
    yield context.new_page()
    context.close()


def opened(page: Page, served: Served, path: str, **query: object) -> Seen:
    """Opens a page and waits until it is live."""
    seen = watch(page)
    asked = "&".join(f"{name}={value}" for name, value in query.items())
    page.goto(f"{served.http}/dashboard/{path}?{asked}")
    expect(page.locator("h1")).to_be_visible()
    page.wait_for_function("window.socket && window.socket.connected")
    return seen


def test_every_page_is_whole_in_both_looks_and_loads_nothing_from_elsewhere(page: Page, served: Served) -> None:
    for path, title in PAGES.items():
        seen = opened(page, served, path)
        expect(page.locator("h1")).to_have_text(title)
        for look, width in ((look, width) for look in ("light", "dark") for width in (1280, 820)):
            page.emulate_media(color_scheme=look)
            page.set_viewport_size({"width": width, "height": 1000})
            page.wait_for_function(f"document.body.classList.contains('body--{look}')")
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), f"{path} is wider than {width}"
            contrast, words = page.evaluate(WEAKEST_CONTRAST)
            assert contrast >= 4.5, f"{path}, {look}: {words}"
        page.wait_for_timeout(500)  # for what asks late; the browser's own "networkidle" does not always come
        assert seen.faults == []
        assert len(seen.requests) > 3
        assert seen.elsewhere([served.http, served.http.replace("http:", "ws:")]) == []


# Contrast (WCAG 2) of all words with the nearest ground that is painted behind them: the weakest, and its words.
WEAKEST_CONTRAST = """() => {
  const numbers = text => (text.match(/[\\d.]+/g) || []).map(Number);
  const light = rgb => rgb.map(v => v / 255).map(v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, n) => sum + v * [0.2126, 0.7152, 0.0722][n], 0);
  const ground = node => {
    for (let at = node; at; at = at.parentElement) {
      const found = numbers(getComputedStyle(at).backgroundColor);
      if (found.length === 3 || found[3] === 1) return found.slice(0, 3);
    }
    return [255, 255, 255];
  };
  let weakest = [21, ''];
  for (const node of document.querySelectorAll('body *')) {
    const words = [...node.childNodes].some(child => child.nodeType === 3 && child.textContent.trim());
    if (!words || !node.checkVisibility() || node.closest('svg, style, script, .nicegui-error-popup')) continue;
    const behind = ground(node), ink = numbers(getComputedStyle(node).color), share = ink[3] ?? 1;
    const seen = ink.slice(0, 3).map((v, n) => share * v + (1 - share) * behind[n]);
    const [a, b] = [light(seen), light(behind)].sort((one, other) => one - other);
    const contrast = (b + 0.05) / (a + 0.05);
    if (contrast < weakest[0]) weakest = [contrast, node.tagName + ' ' + node.className + ' ' + node.textContent.slice(0, 80)];
  }
  return weakest;
}"""


def test_robots_are_seen_where_they_are_and_move(page: Page, served: Served) -> None:
    with talking(served.zenoh, ROBOTS) as moved:
        seen = opened(page, served, "")
        expect(page.locator(".figures")).to_contain_text(f"{ROBOTS} of {ROBOTS}", timeout=15_000)
        mark = page.locator(".site-map .mark[data-name='tug-4']")
        expect(mark).to_have_attribute("data-at", "{:.2f} {:.2f}".format(*place_of(4)))
        assert page.locator(".site-map .mark").count() == ROBOTS
        assert page.evaluate(PLACE_OF, "tug-4") == pytest.approx(place_of(4), abs=0.05), "drawn where it is"
        page.get_by_role("button", name="Zoom in").click()
        page.wait_for_timeout(300)
        assert page.evaluate(PLACE_OF, "tug-4") == pytest.approx(place_of(4), abs=0.05)
        moved["tug-4"] = (40.0, 14.0)
        expect(mark).to_have_attribute("data-at", "40.00 14.00", timeout=15_000)
        expect(mark).to_have_class(re.compile("mark bad"), timeout=15_000)
        attention = page.get_by_role("region", name="Robots that need a look")
        expect(page.locator(".attention")).to_contain_text(f"of {ROBOTS} robots need a look")
        attention.get_by_role("link").first.click()
        lost = attention.page.url.rpartition("/")[2].partition("?")[0]
        expect(page.locator("h1")).to_have_text(lost)
        expect(page.locator(".notice.bad")).to_contain_text(re.compile(r"^Lost since \d{4}-"))
        expect(page.locator(f".site-map .mark[data-name='{lost}']")).to_have_count(1)
        expect(page.get_by_role("table", name="States, the last one first")).to_contain_text("lost")
        opened(page, served, "")
        before = page.evaluate("performance.timeOrigin")
        page.get_by_label("Find a robot").fill("tug-4")
        row = page.locator("tbody tr", has=page.get_by_role("link", name="tug-4", exact=True))
        expect(row).to_contain_text("lost", timeout=15_000)
        assert page.evaluate("performance.timeOrigin") == before, "the page changed by itself, it was not loaded again"
        assert seen.faults == []


# Where a mark is drawn, in metres: by the picture of the landmarks, whose corners are those of the hall's tiles.
PLACE_OF = """name => {
  const picture = document.querySelector('.site-map img.picture').getBoundingClientRect();
  const shape = document.querySelector(`.mark[data-name="${name}"] .shape`).getBoundingClientRect();
  const scale = 64 / picture.width;
  return [(shape.x + shape.width / 2 - picture.x) * scale, (picture.bottom - shape.y - shape.height / 2) * scale];
}"""


def test_a_failure_is_found_opened_and_shown_with_its_context(page: Page, served: Served) -> None:
    seen = opened(page, served, "failures")
    page.get_by_label("Cause").select_option("dark")
    page.get_by_role("button", name="Show").click()
    expect(page).to_have_url(re.compile("cause=dark"))
    expect(page.locator("tbody tr")).to_have_count(1)
    page.get_by_role("link", name="Failure 1", exact=True).click()
    expect(page.locator("h1")).to_have_text("Failure 1 of tug-7")
    for words in ("dark", "tug-7", "1,0", "0.4 m", "too few matches"):
        expect(page.locator(".nicegui-content")).to_contain_text(words)
    pictures = page.locator(".pictures img")
    expect(pictures).to_have_count(2)
    expect(pictures.first).to_have_attribute("alt", re.compile("^Matches"))
    expect(page.locator(".notice.bad")).to_contain_text(
        re.compile(r"^tug-7 failed at .* in tile 1,0: dark, lost for 3.5 s")
    )
    pictures.nth(1).scroll_into_view_if_needed()
    page.wait_for_function(
        "[...document.querySelectorAll('.pictures img')].every(i => i.complete && i.naturalWidth === 160)"
    )
    assert seen.faults == []


def test_what_robots_say_is_shown_as_words_and_never_runs(page: Page, served: Served) -> None:
    seen = opened(page, served, "failures")
    expect(page.locator("tbody")).to_contain_text("<b>bold</b>")
    assert page.locator("tbody b").count() == 0
    expect(page.locator("tbody")).to_contain_text("suspected")
    assert seen.faults == []


def test_a_new_failure_appears_by_itself(page: Page, served: Served) -> None:
    seen = opened(page, served, "failures", robot="tug-12")
    expect(page.locator(".nicegui-content")).to_contain_text("No failure")
    with ZenohBus.connect(served.zenoh) as bus:
        answer = bus.get(
            robot_key(SITE, "tug-12", "failures"), encode_message(failure("tug-12", "live", cause="glare"))
        )
        assert not decode_message(answer, FailureAck).refused
    expect(page.locator("tbody")).to_contain_text("glare", timeout=8000)
    expect(page.locator(".mark.bad")).to_have_count(1)
    assert seen.faults == []


def test_a_job_shows_the_doctor_and_its_loops(page: Page, served: Served) -> None:
    seen = opened(page, served, "surveys")
    content = page.locator(".nicegui-content")
    for words in (
        "cameras are swapped",
        "camera 1 is blurred",
        "saw nothing that the map has",
        "its neighbours disagree",
    ):
        expect(content).to_contain_text(words)
    assert [page.locator(f".line.{tone}").count() for tone in ("good", "bad", "quiet")] == [1, 1, 1]
    with MapStore.open(served.folder) as store:
        store.begin_job(SITE, "convert")
    expect(page.locator("tbody").first).to_contain_text("convert", timeout=8000)
    assert seen.faults == []


def test_versions_are_compared(page: Page, served: Served) -> None:
    seen = opened(page, served, "map", before=1, after=3)
    expect(page.locator("path.cell.added")).to_have_count(2)
    assert page.locator("path.cell.changed").count() == 6
    content = page.locator(".nicegui-content")
    for words in ("2 added, 6 changed, 0 removed", "211.0 m before, 213.0 m after", "accepted"):
        expect(content).to_contain_text(words)
    assert seen.faults == []


def test_wrong_addresses_are_answered_in_words(served: Served) -> None:
    for path, words in (
        ("map?site=nowhere", "no site nowhere"),
        ("map?version=99", "no version 99"),
        ("map?version=x", "not a number"),
        ("failures/77", "no failure 77"),
        ("surveys?job=99", "no job 99"),
        ("robots/nobody", "never heard of a robot"),
        ("failures?sinc=2026-01-01", "this page knows site, robot"),
        ("failures?since=soon", "is no time; write"),
        ("robots/tug-7?since=2026-01-02&until=2026-01-01T00:00", "is not after since"),
    ):
        assert words in httpx.get(f"{served.http}/dashboard/{path}", timeout=60).text, path
    for path in ("plans/hall/99.png", "pictures/1/9.jpg", "underlays/hall/2/floor.png", "underlays/hall/99/grid.png"):
        assert httpx.get(f"{served.http}/dashboard/{path}").status_code == 404


def test_times_are_those_of_the_browser_and_ranges_are_kept_to(served: Served) -> None:
    def shown(query: str, zone: str) -> str:
        answer = httpx.get(f"{served.http}/dashboard/failures?{query}", cookies={"fleetmap_zone": zone}, timeout=60)
        return answer.text

    now = datetime.now(ZoneInfo("Asia/Tokyo"))
    assert f"{now:%Y-%m-%d}" in shown("", "Asia/Tokyo")
    assert " JST" in shown("", "Asia/Tokyo")
    assert " JST" not in shown("", "<script>"), "what is no zone is the server's"
    later, earlier = f"{now + timedelta(hours=1):%Y-%m-%dT%H:%M}", f"{now - timedelta(hours=1):%Y-%m-%dT%H:%M}"
    assert "No failures match" in shown(f"since={later}", "Asia/Tokyo")
    within = shown(f"since={earlier}&until={later}", "Asia/Tokyo")
    assert "No failures match" not in within
    assert later in within, "the form says what was asked"


def test_the_look_that_was_chosen_stays(page: Page, served: Served) -> None:
    opened(page, served, "")
    page.get_by_role("button", name="Light or dark").click()
    chosen = "document.body.classList.contains('body--dark')"
    assert page.evaluate(chosen)
    opened(page, served, "surveys")
    assert page.evaluate(chosen)


def change(page: Page, words: str, *, name: str | None = "ada") -> None:
    """Asks for a change and confirms it."""
    page.get_by_role("button", name=words, exact=True).click()
    dialog = page.locator(".q-dialog")
    if name is not None:
        dialog.get_by_label("Your name").fill(name)
    dialog.get_by_label("Reason").fill("robots lose themselves in aisle 3")
    dialog.get_by_role("button", name=f"Yes: {words}").click()


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


def test_under_another_name_there_is_no_page(page: Page, served: Served) -> None:
    answer = page.goto(f"http://elsewhere.example:{urlsplit(served.http).port}/dashboard/map")
    assert answer.status == 403
    assert "is not called" in page.content()


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
