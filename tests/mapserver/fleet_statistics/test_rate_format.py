"""Rates are told where enough was driven, counts everywhere."""

import runpy

import pytest

from mapserver.fleet_statistics.kpis import Counters, driven_words, format_rate, is_enough, kpis, rate
from support.fleet.contracts_documents import REPOSITORY


@pytest.mark.parametrize("failures", [0, 2, 1000])
def test_no_rate_is_said_before_none_would_show_a_good_one(failures: int) -> None:
    in_words = runpy.run_path(str(REPOSITORY / "examples" / "fleet_figures.py"))["in_words"]
    for minutes, is_said in ((0, False), (5, False), (570, False), (580, True)):
        found = rate(failures, minutes / 960)
        assert {value is not None for value in (found.per_robot_day, found.low, found.high)} == {is_said}
        assert is_enough(minutes / 960) == (format_rate(found) != "–") == is_said
        words = in_words(kpis(Counters(failures=failures, driving_ms=60_000 * minutes)))
        assert (f" {failures} failures, too little driving" in words) != is_said


def test_rates_and_driving_as_text() -> None:
    assert format_rate(rate(1, 50.0)) == "0.02 (0.00051 to 0.11)"
    assert [driven_words(days) for days in (0.0, 0.5, 1.0, 37.4)] == [
        "0 min of driving", "8.0 h of driving", "1 robot-days", "37 robot-days",
    ]  # fmt: skip
