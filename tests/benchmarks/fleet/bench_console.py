"""The console in a real browser while robots report: first content, paints a second, memory of open pages, and the server's start.

Server, robots and browser share the machine: on two cores the browser's times are those of a busy machine. CPU of the start is also given
by the yardstick.
"""

import itertools
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright

from benchmarks.common.recorded_runs import Options, Results, benchmark, resident_mb
from benchmarks.common.yardstick import at_reference, slowness
from benchmarks.fleet.server_process import cpu_s
from support.fleet.dashboard_scene import SITE, fill_store, serving, talking
from support.pages.browser import Chromium
from support.waiting import repeated

_PAGES = ("", "trends", "map", "failures", "surveys")
_LOOKS, _PAINTED_S, _SETTLE_S = 7, 5.0, 10.0
# Counts the paints of the canvas on which robots move.
_COUNT = """seconds => new Promise(done => {
  const clear = CanvasRenderingContext2D.prototype.clearRect;
  let frames = 0, last = -1;
  CanvasRenderingContext2D.prototype.clearRect = function (...box) {
    const now = performance.now();
    if (now - last > 5) [frames, last] = [frames + 1, now];
    return clear.apply(this, box);
  };
  setTimeout(() => { CanvasRenderingContext2D.prototype.clearRect = clear; done(frames / seconds); }, 1000 * seconds);
})"""
_FIRST = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? null"


@contextmanager
def driving(zenoh: str, robots: int) -> Iterator[None]:
    """Robots that report every second, and drive."""
    steps = itertools.count(1)
    with talking(zenoh, robots) as moved:

        def drive() -> None:
            step = next(steps)
            moved.update({f"tug-{n}": (5.0 + (n * 0.7 + step) % 50, 3.0 + n % 26) for n in range(robots)})

        with repeated(drive, 1.0):
            yield


def first_content_s(page: Page, address: str) -> float:
    """Time from asking for a page to its first content, by the browser's clock."""
    page.goto(address)
    while (found := page.evaluate(_FIRST)) is None:
        page.wait_for_timeout(20)
    return float(found) / 1e3


def measure(http: str, zenoh: str, server: int, robots: int) -> dict[str, Any]:
    """Figures of a server that runs, with so many robots that drive and report every second."""
    with driving(zenoh, robots), sync_playwright() as playwright:
        time.sleep(_SETTLE_S)
        browser = Chromium(playwright)
        with browser.context(viewport={"width": 1440, "height": 900}) as context:
            page = context.new_page()
            overview = f"{http}/dashboard/?site={SITE}"
            looks = sorted(first_content_s(page, overview) for _ in range(_LOOKS))
            listed = page.locator("#robots li").count()
            paints = page.evaluate(_COUNT, _PAINTED_S)
            page.close()
            time.sleep(_SETTLE_S)
            before_mb = resident_mb(server)
            for name in _PAGES:
                context.new_page().goto(f"{http}/dashboard/{name}?site={SITE}")
            time.sleep(_SETTLE_S)
            pages_mb = resident_mb(server) - before_mb
        browser.close()
    return {
        "robots listed": listed,
        "first_content_s": {"median": looks[len(looks) // 2], "worst": looks[-1]},
        "paints_per_s": paints,
        "five_pages_mb": pages_mb,
    }


@benchmark(robots=300)
def main(asked: Options) -> Results:
    with tempfile.TemporaryDirectory() as folder:
        fill_store(Path(folder))
        slow = slowness()
        with serving(Path(folder)) as served:
            ready_s = cpu_s(served.process)
            figures = measure(served.http, served.zenoh, served.process, asked.robots)
    return {f"{asked.robots} robots": figures | {"ready_cpu_s_at_reference": at_reference(ready_s, [slow])}}
