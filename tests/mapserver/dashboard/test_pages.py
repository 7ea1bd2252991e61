"""The dashboard in a real browser: every page, live changes, versions promoted and rolled back, nothing loaded from elsewhere."""

import csv
import re
from datetime import datetime, timedelta
from io import StringIO
from pathlib import Path
from urllib.parse import parse_qs, urlsplit
from zoneinfo import ZoneInfo

import httpx
import pytest
from playwright.sync_api import Locator, Page, expect

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.mapformat.names import blob_path
from fleetmap.messages import FailureAck, decode_message, encode_message, robot_key
from mapserver.fleet_statistics.kpis import HOUR_NS, hour_of
from mapserver.store import FleetBatch, MapStore, TraceRow
from support.fleet.dashboard_scene import (
    ROBOTS,
    SITE,
    Served,
    failure,
    fill_store,
    marks,
    opened,
    place_of,
    serving,
    talking,
    wait_until,
    watch,
)
from support.pages.browser import box_of
from support.pages.whole_page import assert_whole

PAGES = {
    "": "Overview of hall",
    "robots": "Robots of hall",
    "trends": "Trends of hall",
    "map": "Map of hall",
    "failures": "Failures of hall",
    "failures/1": "Failure 1 of tug-7",
    "robots/tug-7": "tug-7",
    "surveys": "Surveys of hall",
    "administration": "Administration",
    "administration/people": "Administration",
    "administration/log": "Administration",
    "docs/floors.md": "Floors and lifts",
}
SPAN = ("since", "until")


def test_every_page_is_whole_in_both_looks_and_loads_nothing_from_elsewhere(page: Page, served: Served) -> None:
    for path, title in PAGES.items():
        seen = opened(page, served, path)
        expect(page.locator("h1")).to_have_text(title)
        assert_whole(page)
        page.wait_for_timeout(500)  # for what asks late; the browser's own "networkidle" does not always come
    assert len(seen.requests) > 3 * len(PAGES)


def test_every_link_to_a_document_leads_to_its_section(served: Served) -> None:
    waiting, texts = {f"/dashboard/{path}" for path in PAGES}, dict[str, str]()
    while waiting:
        texts |= {path: httpx.get(f"{served.http}{path}").raise_for_status().text for path in waiting}
        linked = {to for text in texts.values() for to in re.findall(r'href="(/dashboard/docs/[^"]*)"', text)}
        waiting = {to.partition("#")[0] for to in linked} - texts.keys()
    assert len(texts) > len(PAGES) + 25
    for path, _, section in (to.partition("#") for to in linked):
        assert not section or f'id="{section}"' in texts[path], f"{path} has no section {section}"
    for picture in {to for text in texts.values() for to in re.findall(r'src="(/dashboard/pictures/[^"]*)"', text)}:
        assert httpx.get(f"{served.http}{picture}").headers["content-type"] == "image/png"


def test_robots_are_seen_where_they_are_and_move(page: Page, served: Served) -> None:
    with talking(served.zenoh, ROBOTS) as moved:
        opened(page, served, "")
        expect(page.locator("#figures")).to_contain_text(f"{ROBOTS} of {ROBOTS}", timeout=15_000)
        assert len(marks(page, ROBOTS)) == ROBOTS
        assert page.locator(".site-map *").count() < ROBOTS / 3, "robots are painted: they cost no elements"
        assert page.evaluate(PLACE_OF, "tug-4") == pytest.approx(place_of(4), abs=0.05), "drawn where it is"
        page.get_by_role("button", name="Zoom in").click()
        page.wait_for_timeout(300)
        assert page.evaluate(PLACE_OF, "tug-4") == pytest.approx(place_of(4), abs=0.05)
        moved["tug-4"] = (40.0, 14.0)
        at_new_place = "marks => marks.some(m => m.name === 'tug-4' && m.x === 40 && m.y === 14 && m.tone === 'bad')"
        wait_until(page, f"({at_new_place})(document.querySelector('.site-map').marks())")
        expect(page.get_by_role("status")).to_contain_text(f"Of {ROBOTS} robots online: ")
        page.get_by_role("list", name="Robots, problems first").get_by_role("link").first.click()
        lost = page.url.rpartition("/")[2].partition("?")[0]
        expect(page.locator("h1")).to_have_text(lost)
        expect(page.get_by_role("status")).to_contain_text(re.compile(r"^Lost for \d+ "))
        expect(page.get_by_role("status")).to_have_attribute("title", re.compile(r"^since \d{4}-"))
        expect(page.locator("#advice")).to_have_text(re.compile("or say where it stands"))
        assert [mark["name"] for mark in marks(page)] == [lost]
        states = page.get_by_role("list", name="States, the last one first")
        expect(states).to_contain_text("lost", timeout=90_000)  # since seconds, and renewed each 30 s
        opened(page, served, "")
        before = page.evaluate("performance.timeOrigin")
        page.get_by_label("Find a robot").fill("tug-4")
        row = page.locator("#robots li", has=page.get_by_role("link", name="tug-4", exact=True))
        expect(row).to_contain_text("lost", timeout=15_000)
        assert page.evaluate("performance.timeOrigin") == before, "the page changed by itself, it was not loaded again"


def test_robots_are_filtered_and_columns_chosen_by_the_address(page: Page, served: Served) -> None:
    with talking(served.zenoh, ROBOTS) as moved:
        moved["tug-4"] = (40.0, 14.0)
        opened(page, served, "robots")
        table = page.get_by_role("table", name="Robots, problems first")
        rows = table.locator("tbody tr").filter(visible=True)
        expect(rows).to_have_count(ROBOTS)
        expect(rows.first).to_contain_text(re.compile("lost|several places fit"))
        page.get_by_role("navigation", name="States").get_by_role("link", name=re.compile("^lost")).click()
        page.get_by_text("Columns", exact=True).click()
        page.get_by_role("navigation", name="Columns").get_by_role("link", name="Since").click()
        expect(table.get_by_role("columnheader", name="Since")).to_have_count(0)
        page.get_by_label("Find a robot").fill("tug-4")
        expect(page).to_have_url(re.compile("find=tug-4"))
        expect(rows).to_have_count(1)
        page.reload()
        expect(rows).to_have_text([re.compile(r"^\s*tug-4\s*lost.*40.0, 14.0 m")])
        expect(table.get_by_role("columnheader", name="Since")).to_have_count(0)
        del moved["tug-4"]
        expect(rows).to_have_count(0)
        page.get_by_label("Find a robot").fill("")
        chosen = page.get_by_role("navigation", name="States").locator(".chosen")
        expect(chosen).not_to_have_attribute("href", re.compile("find="))
        chosen.click()
        expect(rows).to_have_count(ROBOTS)
        names = rows.get_by_role("link").all_inner_texts()
        assert names.index("tug-9") < names.index("tug-10")
        natural = sorted(names, key=lambda name: int(name.removeprefix("tug-")))
        for order in (natural, natural[::-1]):
            table.get_by_role("columnheader", name="Robot").get_by_role("button").click()
            assert rows.get_by_role("link").all_inner_texts() == order
        page.get_by_label("Find a robot").fill("tug-29")
        page.wait_for_timeout(6000)  # it is renewed
        assert rows.get_by_role("link").all_inner_texts() == [*(f"tug-{n}" for n in range(299, 289, -1)), "tug-29"]
        with page.expect_download() as download:
            page.get_by_role("button", name="Save as CSV").click()
        saved = list(csv.DictReader(StringIO(Path(download.value.path()).read_text("utf-8"), newline="")))
        assert [row["Robot"] for row in saved][-2:] == ["tug-290", "tug-29"]
        assert saved[0]["Map version"] == "2"
        page.get_by_label("Find a robot").fill("")
        row = rows.filter(has=page.get_by_role("link", name="tug-9", exact=True))
        row.locator(".where").click(force=True)  # all of the row is the link, which covers it
        expect(page.locator("h1")).to_have_text("tug-9")


# Where a mark is drawn, in metres, by the picture of the landmarks, whose corners the page knows; null without paint.
PLACE_OF = """name => {
  const map = document.querySelector('.site-map');
  const picture = map.querySelector('img.picture').getBoundingClientRect();
  const [x, y] = map.marks().find(mark => mark.name === name).page;
  const canvas = map.querySelector('.leaflet-marker-pane canvas'), corner = canvas.getBoundingClientRect();
  const copy = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
  copy.drawImage(canvas, corner.x - x, corner.y - y);
  const paint = copy.getImageData(0, 0, 1, 1).data;
  const { layers } = JSON.parse(map.dataset.scene);
  const [left, low, right] = layers.flatMap(({ items }) => items).find(({ kind }) => kind === 'picture').box;
  const scale = (right - left) / picture.width;
  return paint[3] === 255 ? [left + (x - picture.x) * scale, low + (picture.bottom - y) * scale] : null;
}"""


def test_marks_are_read_and_opened_with_the_pointer(page: Page, served: Served) -> None:
    opened(page, served, "")
    for _ in range(3):  # until no other robot is within the pointer's reach
        page.get_by_role("button", name="Zoom in").click()
    box = box_of(page.locator(".site-map"))
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    shown = {mark["name"]: mark for mark in marks(page)}
    name = min(shown, key=lambda name: sum(abs(a - b) for a, b in zip(shown[name]["page"], middle, strict=True)))
    x, y = shown[name]["page"]
    page.mouse.move(x + 3, y - 3)
    expect(page.locator(".leaflet-tooltip")).to_have_text(re.compile(f"^{name}: "))
    page.mouse.move(x + 60, y + 60)
    page.mouse.click(x + 3, y - 3)
    expect(page.locator("h1")).to_have_text(name)


def listed(page: Page) -> Locator:
    return page.get_by_role("list", name="Failures").get_by_role("listitem")


def test_a_failure_is_found_opened_and_shown_with_its_context(page: Page, served: Served) -> None:
    opened(page, served, "failures")
    expect(page.get_by_role("list", name="Cause")).to_contain_text("<b>bold</b>")
    expect(listed(page).filter(has_text="suspected")).to_contain_text("<b>bold</b>")
    assert page.locator("main b").count() == 0, "words of robots are words"
    page.get_by_role("list", name="Cause").get_by_role("link", name="dark", exact=True).click()
    expect(page).to_have_url(re.compile("cause=dark"))
    expect(listed(page)).to_have_count(1)
    page.get_by_role("list", name="Cause").get_by_role("link", name="dark", exact=True).click()
    expect(listed(page)).to_have_count(2)
    page.get_by_role("group", name="Failures over time").get_by_role("link").first.click()
    expect(page).to_have_url(re.compile("since=.*until="))
    expect(listed(page)).to_have_count(2)
    page.get_by_role("link", name="Failure 1", exact=True).click()
    expect(page.locator("h1")).to_have_text("Failure 1 of tug-7")
    for words in ("dark", "tug-7", "1,0", "0.4 m", "too few matches"):
        expect(page.locator("main")).to_contain_text(words)
    expect(page.get_by_role("status")).to_have_text(re.compile(r"^tug-7 failed .* in tile 1,0: dark, lost for 3.5 s"))
    page.get_by_alt_text("The image, and the landmarks").scroll_into_view_if_needed()
    wait_until(
        page, "[...document.querySelectorAll('main figure img')].every(i => i.complete && i.naturalWidth === 160)"
    )
    assert page.locator("main figure img").count() == 2


def test_a_new_failure_appears_by_itself(page: Page, served: Served) -> None:
    opened(page, served, "failures", robot="tug-12")
    expect(page.get_by_role("status")).to_have_text("No failures match.")
    with Bus(served.zenoh).open() as bus:
        report = encode_message(failure("tug-12", "live", cause="glare"))
        answer = bus.get(robot_key(SITE, "tug-12", "failures"), report)
        assert not decode_message(answer, FailureAck).refused
    expect(listed(page)).to_contain_text("glare")
    assert [mark["tone"] for mark in marks(page)] == ["bad"]


def test_a_job_shows_the_doctor_and_its_loops(page: Page, served: Served) -> None:
    with MapStore.open(served.folder) as store:  # a later night, in which nothing happened
        waiting = {"waiting": [{"name": "friday.mcap", "reason": "it is not whole yet"}]}
        store.update_job(store.begin_job(SITE, "nightly"), "done", "nothing to build", waiting)
    opened(page, served, "surveys")
    jobs, recordings = page.get_by_role("list", name="Jobs"), page.get_by_role("list", name="Recordings")
    expect(jobs).to_contain_text("recording tuesday: cameras are swapped")
    told = [re.sub(r"\s+", " ", row) for row in recordings.locator("> li").all_inner_texts()]
    assert told == [
        "sunday left out saw nothing that the map has 24 ok, 2 not judged: good enough to build",
        "saturday.mcap refused no images",
        "monday in the map found in the map 25 ok, 1 warn: good enough to build",
        "friday.mcap waits it is not whole yet",
    ]
    recordings.get_by_text("24 ok, 2 not judged: good enough to build").click()
    expect(recordings).to_contain_text("not judged gyro scale, gyro axes: it hardly turns; drive a curve")
    recordings.get_by_text("25 ok, 1 warn").click()
    expect(recordings.get_by_text("camera 1 is blurred")).to_be_visible()
    page.get_by_text("Why 2 candidates were refused").click()
    expect(page.get_by_role("table", name="Refused loops")).to_contain_text("its neighbours disagree")
    assert page.locator(".line").count() == 1
    page.locator(".leaflet-control-layers").hover()
    page.get_by_role("checkbox", name="Refused loops").check()
    assert [page.locator(f".line.{tone}").count() for tone in ("good", "bad", "quiet")] == [1, 1, 1]
    with MapStore.open(served.folder) as store:
        job = store.begin_job(SITE, "convert")
        expect(jobs).to_contain_text("convert", timeout=15_000)
        store.tell_progress(job, {"stage": "matching", "done": 30, "total": 120, "stage_s": 60.0})
        expect(jobs).to_contain_text("matching: 30 of 120, about 3 min more", timeout=15_000)
        assert jobs.locator("progress").evaluate("bar => bar.value / bar.max") == 0.25
        expect(recordings.get_by_text("camera 1 is blurred")).to_be_visible()
        store.update_job(job, "done", "converted", {})
        new = store.begin_job("yard", "build")
        store.tell_progress(new, {"stage": "odometry", "done": 1, "total": 10, "stage_s": 1.0})
        of_yard = httpx.get(f"{served.http}/dashboard/surveys?site=hall&job={new}", timeout=60).text
        assert "Surveys of yard" in of_yard, "a job is on the map of its own site"
        assert 'href="/dashboard/map?site=yard"' in of_yard
        opened(page, served, "surveys", site="yard")
        expect(jobs).to_contain_text("odometry: 1 of 10")
        store.update_job(new, "failed", "no frames; `mapserver doctor` says more", {})
        expect(jobs.locator("code")).to_have_text("mapserver doctor", timeout=15_000)


def test_a_time_is_dragged_in_a_chart_and_kept_on_other_pages(page: Page, served: Served) -> None:
    opened(page, served, "failures")
    chart = page.locator("#chart")
    first_ms, end_ms = (float(chart.get_attribute(f"data-{name}")) for name in ("since", "until"))
    box = box_of(chart)
    for share, act in ((0.25, page.mouse.down), (0.75, page.mouse.up)):
        page.mouse.move(box["x"] + share * box["width"], box["y"] + 40, steps=4)
        act()
    page.wait_for_url(re.compile("since=.*until="))
    asked = parse_qs(urlsplit(page.url).query)
    for name, share in (("since", 0.25), ("until", 0.75)):
        chosen_ms = 1000 * datetime.fromisoformat(asked[name][0]).timestamp()
        assert chosen_ms == pytest.approx(first_ms + share * (end_ms - first_ms), abs=62_000)
    page.get_by_role("navigation", name="Pages").get_by_role("link", name="Robots").click()
    expect(page.locator("h1")).to_have_text("Robots of hall")
    page.get_by_role("navigation", name="Pages").get_by_role("link", name="Trends").click()
    expect(page.locator("h1")).to_have_text("Trends of hall")
    assert {name: asked[name] for name in ("since", "until")}.items() <= parse_qs(urlsplit(page.url).query).items()
    expect(page.locator("main")).to_contain_text("What got worse in the chosen time")
    page.locator(".range summary").click()
    page.get_by_role("link", name="Last 24 h", exact=True).click()
    expect(page.locator("main")).to_contain_text("What got worse this week")
    bars = page.locator(".bars .ground")
    bars.drag_to(bars, force=True, source_position={"x": 1, "y": 9})  # to its middle
    page.wait_for_url(re.compile("since=.*until="))
    since, until = (datetime.fromisoformat(parse_qs(urlsplit(page.url).query)[name][0]) for name in SPAN)
    assert until - since == pytest.approx(timedelta(days=7.5), abs=timedelta(hours=12))


def test_a_robots_page_opens_on_its_last_drive(page: Page, tmp_path: Path) -> None:
    fill_store(tmp_path)
    with MapStore.open(tmp_path) as store:
        begin_ns, batch = store.now_ns() - 30 * HOUR_NS, FleetBatch()
        for at_s in (*range(0, 600, 10), *range(900, 1200, 10), 4000):  # silent for five minutes, then it stands
            stamp_ns = begin_ns + at_s * 10**9
            place_m = 10.0 + 0.02 * min(at_s, 1190), 6.0
            row = TraceRow(SITE, "tug-7", hour_of(stamp_ns), stamp_ns, "TRACKING", 2, *place_m, 0.1, heard_ns=stamp_ns)
            batch.traces.append(row)
        store.fleet.add(batch)
    with serving(tmp_path) as served:
        opened(page, served, "robots/tug-7")
        expect(page.locator(".range summary")).to_have_text("Last drive")
        shown_ms = [int(page.locator("#band").get_attribute(f"data-{name}")) for name in SPAN]
        assert [ms / 1000 - begin_ns / 1e9 for ms in shown_ms] == pytest.approx([0.0, 1220.0], abs=60)
        expect(page.locator(".site-map path.line.good")).to_have_count(2)


def test_versions_are_compared(page: Page, served: Served) -> None:
    opened(page, served, "map", before=1, after=3)
    expect(page.locator("path.cell.added")).to_have_count(2)
    assert page.locator("path.cell.changed").count() == 6
    content = page.locator("main")
    for words in ("2 added, 6 changed, 0 removed", "211.0 m before, 213.0 m after", "The gate would accept it."):
        expect(content).to_contain_text(words)
    swipe = page.locator(".swipe")
    swipe.get_by_role("slider").fill("0.25")
    sides = swipe.locator("svg").evaluate_all("all => all.map(side => getComputedStyle(side).clipPath)")
    assert sides == ["inset(0px 75% 0px 0px)", "inset(0px 0px 0px 25%)"]
    one, other = swipe.locator("image").evaluate_all("all => all.map(i => i.width.baseVal.value)")
    assert other - one == pytest.approx(16.0, abs=1.0), "a tile was added"


def test_a_page_that_stays_as_it_is_is_not_sent_again(served: Served) -> None:
    first = httpx.get(f"{served.http}/dashboard/trends", timeout=60)
    for tag, status in ((first.headers["etag"], 304), ('"0"', 200), ("", 200)):
        again = httpx.get(f"{served.http}/dashboard/trends", headers={"If-None-Match": tag}, timeout=60)
        assert (again.status_code, bool(again.content)) == (status, status == 200)


def test_wrong_addresses_are_answered_in_words(served: Served) -> None:
    for path, words in (
        ("map?site=nowhere", "no site nowhere"),
        ("map?version=99", "no version 99"),
        ("map?version=x", "not a number"),
        ("failures/77", "failure 77 does not exist"),
        ("surveys?job=99", "job 99 does not exist"),
        ("robots/nobody", "never heard of a robot"),
        ("robots?without=colour", "there is no column &#39;colour&#39;"),
        ("failures?sinc=2026-01-01", "this page knows site, find, since, until, cause"),
        ("failures?since=soon", "is an invalid time; write"),
        ("robots/tug-7?since=2026-01-02&until=2026-01-01T00:00", "is not after since"),
        ("surveys?since=soon", "is an invalid time; write"),
        ("map?until=soon", "is an invalid time; write"),
        ("trends?since=soon", "is an invalid time; write"),
        ("trends?sinc=2026-01-01", "this page knows site, find, since, until"),
        ("?site=nowhere", "no site nowhere"),
        ("nowhere?at=all", "There is no such page here"),
        ("map/nowhere?site=nowhere", "no site nowhere"),
    ):
        text = httpx.get(f"{served.http}/dashboard/{path}", timeout=60).text
        assert words in text, path
        assert 'href="/dashboard/?site=nowhere"' not in text, "a way back"
    for path in ("plans/hall/99.png", "underlays/hall/2/floor.png", "underlays/hall/99/grid.png"):
        assert httpx.get(f"{served.http}/dashboard/{path}").status_code == 404


@pytest.mark.parametrize("version", [1, 3])
def test_a_lost_tile_of_another_version_leaves_the_page_with_its_roll_back(tmp_path: Path, version: int) -> None:
    fill_store(tmp_path)
    with MapStore.open(tmp_path) as store:
        (store.folder / blob_path(store.manifest(SITE, version).tiles[-1].sha256)).unlink()
    with serving(tmp_path) as served:
        answer = httpx.get(f"{served.http}/dashboard/map", timeout=60)
    assert answer.status_code == 200
    assert "Roll back to version 1" in answer.text
    assert "Publish draft 3" in answer.text


def test_surveys_begin_with_a_site_that_has_a_map(served: Served) -> None:
    with MapStore.open(served.folder) as store:
        store.update_job(store.begin_job("depot", "build"), "failed", "no images", {})
        reading = store.begin_job("depot", "nightly")
    assert "Surveys of hall" in httpx.get(f"{served.http}/dashboard/surveys", timeout=60).text

    def shown(path: str) -> str:
        answer = httpx.get(f"{served.http}/dashboard/{path}?site=depot", timeout=60)
        assert answer.status_code == 200, path
        return answer.text

    assert "no images" in shown("surveys")
    assert "<p>starting</p>" in shown("surveys")
    with MapStore.open(served.folder) as store:
        store.tell_progress(reading, ["monday.mcap"], "looking_at")
        assert "<p>reading monday.mcap</p>" in shown("surveys")
        store.update_job(reading, "failed", "", {})
    assert "depot has no version yet" in shown("map")
    for path in ("", "trends", "failures", "live"):
        shown(path)


def test_a_refused_stream_is_opened_again_and_a_hidden_page_has_none(page: Page, served: Served) -> None:
    page.add_init_script(
        """window.streams = [];
        window.EventSource = class extends EventSource { constructor(to) { super(to); window.streams.push(this); } };"""
    )
    page.route("**/now?*", lambda route: route.fulfill(status=502))
    seen = opened(page, served, "")
    silent = page.get_by_text("The server does not answer; trying again.")
    expect(silent).to_be_visible()
    page.unroute("**/now?*")
    seen.refused(502)
    expect(silent).to_be_hidden()
    turned = "on => { Object.defineProperty(document, 'hidden', { value: on, configurable: true });"
    turned += "document.dispatchEvent(new Event('visibilitychange')); }"
    page.evaluate(turned, True)
    assert page.evaluate("streams.every(stream => stream.readyState === 2)")
    page.evaluate(turned, False)
    wait_until(page, "() => streams.at(-1).readyState === 1")
    opened(page, served, "failures")  # of a site that the server chose
    page.route("**/failures?site=hall", lambda route: route.fulfill(status=502))
    expect(silent).to_be_visible(timeout=15_000)
    page.unroute("**/failures?site=hall")
    expect(silent).to_be_hidden(timeout=15_000)
    assert {fault[:3] for fault in seen.faults if fault[0] != "F"} == {"502"}
    seen.faults.clear()


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


def test_under_another_name_there_is_no_page(page: Page, served: Served) -> None:
    assert page.goto(f"http://elsewhere.example:{urlsplit(served.http).port}/dashboard/map").status == 403
    assert "unknown host name" in page.content()
    watch(page).faults.clear()
