"""A browser, and a server with robots that talk, for the tests of the pages."""

import time
from collections.abc import Iterator

import httpx
import pytest

from support.fleet.dashboard_scene import ROBOTS, Served, fill_store, serving, talking
from support.pages.browser import Chromium


@pytest.fixture(scope="module")
def served(browser: Chromium, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
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


@pytest.fixture(scope="module")
def small_fleet(browser: Chromium, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server with eight robots, which the keyboard gets through."""
    folder = tmp_path_factory.mktemp("store")
    fill_store(folder)
    with serving(folder) as server, talking(server.zenoh, 8):
        yield server
