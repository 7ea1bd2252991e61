"""A browser, and a server with robots that talk, for the tests of the pages."""

import time
from collections.abc import Iterator

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from support.fleet.dashboard_scene import ROBOTS, Served, chromium, fill_store, serving, talking

expect.set_options(timeout=30_000)  # a busy machine answers late


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
