"""The browser that tests look with: one that never answers costs them seconds, not the run."""

import signal

import psutil
import pytest

from support.pages import browser
from support.pages.browser import running_chromium


def test_a_browser_that_does_not_answer_is_killed_and_started_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(browser, "_CLOSE_S", 1.0)
    with running_chromium() as started:
        with started.context() as context:
            context.new_page()
            asleep = [p for p in psutil.Process().children(recursive=True) if "chrom" in p.name()]
            for process in asleep:
                process.send_signal(signal.SIGSTOP)
        assert asleep
        with started.context() as context:
            page = context.new_page()
            page.set_content("<p>here again</p>")
            assert page.inner_text("p") == "here again"
