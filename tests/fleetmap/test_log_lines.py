"""The log: one line a message whatever it holds, and one line a key and minute of what others cause. Row 22 of docs/security.md."""

import io
import logging
from collections.abc import Iterator
from unittest.mock import Mock

import pytest

from fleetmap.log_lines import LineFormatter, LogLimit, printable
from support.fleet.memory_bus import MemoryBus, MemoryHub

FORGED = "hall\n2026-11-22 00:00:00,000 INFO mapserver: ada promoted version 9"


@pytest.fixture(params=[LineFormatter, logging.Formatter], ids=["ours", "the control"])
def lines(request: pytest.FixtureRequest) -> Iterator[tuple[logging.Logger, io.StringIO, bool]]:
    """A logger, what it wrote, and whether its formatter is ours."""
    out = io.StringIO()
    handler = logging.StreamHandler(out)
    handler.setFormatter(request.param("%(levelname)s %(name)s: %(message)s"))
    log = logging.getLogger("test of lines")
    log.addHandler(handler)
    log.propagate = False
    yield log, out, request.param is LineFormatter
    log.removeHandler(handler)
    log.propagate = True


FORGERIES = {
    "line": FORGED, "return": "a\rb", "terminal": "a\x1b[2Jb", "separator": "a\u2028b", "zero": "a\x00b", "surrogate": "a\ud800b",
}  # fmt: skip


@pytest.mark.parametrize("words", FORGERIES.values(), ids=FORGERIES)  # names that every runner can print
def test_nobody_forges_a_line(lines: tuple[logging.Logger, io.StringIO, bool], words: str) -> None:
    log, out, is_ours = lines
    record = log.makeRecord(log.name, logging.WARNING, "here", 1, "message under %s refused", (words,), None)
    # By its own handler alone: the runner's may not know what to do with a surrogate.
    next(h for h in log.handlers if isinstance(h, logging.StreamHandler) and h.stream is out).handle(record)
    text = out.getvalue()
    assert text.removesuffix("\n").isprintable() is is_ours
    assert len(text.splitlines()) == 1 or not is_ours


def test_nobody_forges_a_line_by_way_of_an_error(lines: tuple[logging.Logger, io.StringIO, bool]) -> None:
    log, out, is_ours = lines
    try:
        raise ValueError(FORGED)
    except ValueError:
        log.exception("a request failed")
    first, *rest = out.getvalue().splitlines()
    assert first == "ERROR test of lines: a request failed"
    assert all(line.startswith("    ") for line in rest) is is_ours
    assert any("ada promoted" in line for line in rest), "it can still be read"


def test_the_keys_of_the_bus_are_shown_as_python_writes_them(caplog: pytest.LogCaptureFixture) -> None:
    with MemoryBus(MemoryHub()) as bus:
        bus.queryable("fleetmap/**", Mock(side_effect=ValueError("broken")))
        with pytest.raises(Exception, match="internal error"):
            bus.get(f"fleetmap/{FORGED}")
    assert repr(FORGED)[1:-1] in caplog.records[0].getMessage()
    assert "\n" not in caplog.records[0].getMessage()


def test_printable_keeps_words() -> None:
    assert printable("Wände 42 m, 倉庫") == "Wände 42 m, 倉庫"
    assert printable("a\nb\x07") == "a\\nb\\x07"


def test_a_flood_makes_one_line_a_key_and_minute(caplog: pytest.LogCaptureFixture) -> None:
    clock = Mock(return_value=0.0)
    limit = LogLimit(logging.getLogger("flood"), clock)
    for number in range(3000):
        limit.warning(f"key {number % 3}", "refused %d", number)
    assert [record.getMessage() for record in caplog.records] == ["refused 0", "refused 1", "refused 2"]
    clock.return_value = 61.0
    limit.warning("key 0", "refused %d", 3000)
    before = "in the minute before: 999 more of 'key 2', 999 more of 'key 1', 999 more of 'key 0'"
    assert [record.getMessage() for record in caplog.records[3:]] == [before, "refused 3000"]
    caplog.clear()
    for _ in range(3000):  # the control
        logging.getLogger("flood").warning("refused")
    assert len(caplog.records) == 3000


def test_invented_keys_do_not_make_more_lines(caplog: pytest.LogCaptureFixture) -> None:
    clock = Mock(return_value=0.0)
    limit = LogLimit(logging.getLogger("flood"), clock)
    for number in range(10_000):
        limit.warning(f"key {number}" + "x" * 10_000, "refused")
    assert len(caplog.records) == 60
    clock.return_value = 61.0
    limit.warning("key", "refused")
    assert "9940 of further keys" in caplog.records[60].getMessage()
    assert all(len(record.getMessage()) < 2000 for record in caplog.records)
