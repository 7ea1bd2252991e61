"""Debian's chromium for tests of the pages; killed if it takes too long to close."""

import re
import shutil
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import psutil
import pytest
from playwright.sync_api import Browser, BrowserContext, Error, FloatRect, Locator, Page, Playwright, sync_playwright

_CLOSE_S = 30.0


def chromium() -> str:
    """The browser of the machine; skips, with the reason, without one."""
    found = next(
        (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
    )
    if found is None:
        pytest.skip("NO BROWSER: the dashboard's pages are not tested; install Debian's chromium to do it")
    return found


class Chromium:
    """A browser that is restarted after it had to be killed.

    Chromium sometimes never answers that a context is to be closed, and Playwright then waits for ever: the test has long
    passed, and its whole run would fail.
    """

    def __init__(self, playwright: Playwright, arguments: Sequence[str] = ()) -> None:
        self._playwright, self._arguments = playwright, ["--no-sandbox", *arguments]
        self._browser = self._started()

    def _started(self) -> Browser:
        return self._playwright.chromium.launch(executable_path=chromium(), args=self._arguments)

    @contextmanager
    def context(self, **settings: Any) -> Iterator[BrowserContext]:
        """A context of its own, with patience for a busy machine."""
        if not self._browser.is_connected():
            self._browser = self._started()
        made = self._browser.new_context(**settings)
        made.set_default_timeout(90_000)
        try:
            yield made
        finally:
            with _killed_when_late():
                made.close()

    def close(self) -> None:
        """Ends the browser."""
        with _killed_when_late():
            self._browser.close()


@contextmanager
def running_chromium(*arguments: str) -> Iterator[Chromium]:
    """A browser with further arguments for its command line, until the block ends."""
    chromium()
    with sync_playwright() as playwright:
        started = Chromium(playwright, arguments)
        try:
            yield started
        finally:
            started.close()


def box_of(thing: Locator) -> FloatRect:
    """Box of an element, in CSS pixels. Repeats while there is no box: a live page replaces its elements."""
    for _ in range(50):
        if (box := thing.bounding_box()) is not None:
            return box
        thing.page.wait_for_timeout(100)
    raise AssertionError(f"{thing} has no box: it is not visible")


def fill(page: Page, fields: Mapping[str, str]) -> None:
    """Fills fields of the open dialog, by their labels."""
    for label, value in fields.items():
        field = page.get_by_role("dialog").get_by_label(label)
        (field.select_option if field.evaluate("field => field.matches('select')") else field.fill)(value)


def agree(page: Page, fields: Mapping[str, str]) -> None:
    """Fills fields of the open dialog, and says yes."""
    fill(page, fields)
    page.get_by_role("dialog").get_by_role("button", name=re.compile("^Yes")).click()


@contextmanager
def _killed_when_late() -> Iterator[None]:
    """Kills the browsers of this process when the block takes too long, and forgives what the block says of that."""
    killed = threading.Event()

    def kill() -> None:
        killed.set()
        for process in psutil.Process().children(recursive=True):
            if "chrom" in process.name():
                process.kill()

    timer = threading.Timer(_CLOSE_S, kill)
    timer.start()
    try:
        yield
    except Error:
        if not killed.is_set():
            raise
    finally:
        timer.cancel()
