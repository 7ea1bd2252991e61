"""Intervals against scipy.stats and against chance itself; sums against their parts."""

import runpy
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from mapserver.fleet_statistics.kpis import (
    COUNTER_COLUMNS,
    Counters,
    driven_words,
    format_rate,
    is_enough,
    kpis,
    poisson_interval,
    rate,
    share,
)
from mapserver.store.database import SqliteDatabase
from support.fleet.contracts_documents import REPOSITORY


@pytest.mark.parametrize("events", [0, 1, 2, 7, 40, 1000])
def test_poisson_intervals_are_garwoods(events: int) -> None:
    low, high = poisson_interval(events)
    if events == 0:
        assert (low, high) == (0.0, pytest.approx(-np.log(0.05)))  # the rule of three
    else:
        assert low == pytest.approx(stats.chi2.ppf(0.025, 2 * events) / 2)
        assert high == pytest.approx(stats.chi2.ppf(0.975, 2 * events + 2) / 2)


@pytest.mark.parametrize(("hits", "tries"), [(0, 12), (12, 12), (3, 12), (1, 400)])
def test_shares_have_the_exact_interval(hits: int, tries: int) -> None:
    found = share(hits, tries)
    level = 0.90 if hits in {0, tries} else 0.95  # one-sided at the ends
    exact = stats.binomtest(hits, tries).proportion_ci(level, "exact")
    assert (found.low, found.high) == (pytest.approx(exact.low), pytest.approx(exact.high))


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(1)
    for mean in (0.3, 2.0, 9.0):
        inside = [low <= mean <= high for low, high in map(poisson_interval, rng.poisson(mean, 2000).tolist())]
        assert np.mean(inside) >= 0.94


def test_a_rate_without_driving_is_not_known() -> None:
    assert rate(3, 0.0).per_robot_day is None
    found = rate(0, 150.0)
    assert (found.per_robot_day, found.high) == (0.0, pytest.approx(0.02, rel=2e-3))  # slam.md's 150 robot-days


def test_what_is_not_known_is_none_not_zero() -> None:
    found = kpis(Counters(reports=3, observed_ms=2000))
    assert found.availability == 0.0
    assert (found.localised_share, found.first_fix_mean_s, found.frame_drop_share) == (None, None, None)
    assert (found.docks_wrong.share, found.failures.per_robot_day) == (None, None)


def test_silent_failures_are_estimates_apart() -> None:
    rest = {"docks": 10, "docks_wrong": 1, "blind_seen": 4, "blind_failures": 1}
    found = kpis(Counters(driving_ms=57_600_000, failures=2, suspected=3, **rest))
    assert (found.failures.events, found.silent_estimated.events) == (5, 4), "two reported, three seen in the statuses"
    assert found.docks_wrong.share == 0.1
    assert found.unreported_blindness == 3


def test_every_sum_has_its_column(tmp_path: Path) -> None:
    made = SqliteDatabase(tmp_path / "store.sqlite3", lambda: 1)
    kinds = {row["name"]: row["type"] for row in made.query("PRAGMA table_info(tallies)")[2:]}
    made.close()
    assert tuple(kinds) == COUNTER_COLUMNS
    assert all((kinds[f.name] == "REAL") == (f.type in {float, "float"}) for f in fields(Counters))


# Rates are told where enough was driven, counts everywhere.


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
