"""Moments in addresses and on pages."""

from datetime import UTC
from itertools import pairwise
from zoneinfo import ZoneInfo

import pytest

from fleetmap.errors import UsageError
from mapserver.api.moments import moment_text, read_moment, read_range, steps, written, zone_of

BERLIN = ZoneInfo("Europe/Berlin")
NOON_NS = 1_767_268_800_000_000_000  # 2026-01-01T12:00Z


@pytest.mark.parametrize(
    ("text", "zone", "hours"),
    [
        ("2026-01-01T12:00Z", None, 0),
        ("2026-01-01T12:00:00+01:00", None, -1),
        ("2026-01-01T12:00:00 01:00", None, -1),  # + in an address means a space
        ("2026-01-01T12:00", BERLIN, -1),
        ("2026-07-01T12:00", BERLIN, 181 * 24 - 2),
        ("2026-01-01", UTC, -12),
    ],
)
def test_what_is_written_is_that_moment(text: str, zone: ZoneInfo | None, hours: float) -> None:
    assert read_moment(text, "since", zone) == NOON_NS + hours * 3_600_000_000_000


def test_a_day_ends_with_its_end() -> None:
    assert read_range("2026-01-01", "2026-01-01", UTC) == (NOON_NS - 12 * 3600 * 10**9, NOON_NS + 12 * 3600 * 10**9)
    assert read_range("", None) == (None, None)


@pytest.mark.parametrize("text", ["soon", "14:03", "2026-13-01", "0001-01-01", "9999-12-31", "1e9", "2026-01-01T25:00"])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"until .* is an invalid time; write"):
        read_moment(text, "until", UTC, is_end=True)


def test_a_range_that_ends_before_it_begins_is_refused() -> None:
    with pytest.raises(UsageError, match="exchange them"):
        read_range("2026-01-02T00:00Z", "2026-01-01")


def test_moments_name_their_zone() -> None:
    assert moment_text(NOON_NS, BERLIN) == "2026-01-01 13:00:00 CET"
    assert moment_text(NOON_NS + 181 * 24 * 3600 * 10**9, BERLIN) == "2026-07-01 14:00:00 CEST"
    assert moment_text(None, UTC) is None
    for name in (None, "", "Nowhere/At_all", "../../etc/passwd", "x" * 70, "a\nb"):
        assert zone_of(name) is None
    assert zone_of("Europe/Berlin") == BERLIN


@pytest.mark.parametrize("day", ["2026-10-25", "2026-03-29"])
@pytest.mark.parametrize("minutes", [5, 60, 6 * 60, 24 * 60])
def test_steps_around_a_clock_change_are_ranges_that_can_be_asked_for(day: str, minutes: int) -> None:
    first_ns, end_ns = read_range(day, day, BERLIN)
    edges = steps(first_ns, end_ns, minutes * 60 * 10**9, BERLIN)
    assert (edges[0], edges[-1]) == (first_ns, end_ns)
    for edge, following in pairwise(edges):
        assert read_range(written(edge, BERLIN), written(following, BERLIN), BERLIN) == (edge, following)


def test_steps_go_on_where_a_zone_lost_a_day() -> None:
    apia = ZoneInfo("Pacific/Apia")  # crossed the date line at the end of 2011
    first_ns, end_ns = read_range("2011-12-28", "2012-01-02", apia)
    edges = steps(first_ns or 0, end_ns or 0, 6 * 3600 * 10**9, apia)
    assert (edges[0], edges[-1]) == (first_ns, end_ns)


def test_days_begin_at_midnight_also_after_a_clock_change() -> None:
    first_ns, end_ns = read_range("2026-10-24", "2026-10-26", BERLIN)
    edges = steps(first_ns or 0, end_ns or 0, 24 * 3600 * 10**9, BERLIN)
    assert [written(edge, BERLIN) for edge in edges] == [f"2026-10-{day}T00:00" for day in (24, 25, 26, 27)]


def test_a_time_that_is_repeated_is_the_longest_range() -> None:
    since_ns, until_ns = read_range("2026-10-25T02:30", "2026-10-25T02:30", BERLIN)
    assert (until_ns or 0) - (since_ns or 0) == 3600 * 10**9
    assert written(until_ns or 0, BERLIN) == "2026-10-25T02:30+01:00"
