"""A browser, and a server with robots that talk, for the tests of the pages."""

from collections.abc import Iterator

import pytest

from support.fleet.dashboard_scene import Served, fill_store, serving, talking
from support.pages.browser import Chromium


@pytest.fixture(scope="module")
def small_fleet(browser: Chromium, tmp_path_factory) -> Iterator[Served]:
    """A server with eight robots, which the keyboard gets through."""
    folder = tmp_path_factory.mktemp("store")
    fill_store(folder)
    with serving(folder) as server, talking(server.zenoh, 8):
        yield server
