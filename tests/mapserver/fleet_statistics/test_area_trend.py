"""Which area got worse: clear changes are told, chance is not, and little driving says nothing."""

import numpy as np
import pytest

from mapserver.fleet_statistics.area_trend import area_trends, trend_sentence
from mapserver.fleet_statistics.kpis import ROBOT_DAY_S, Counters


def driven(robot_days: float, failures: int, found: float = 1.0) -> Counters:
    ms = round(robot_days * ROBOT_DAY_S * 1000)
    return Counters(driving_ms=ms, judged_ms=ms, found_ms=round(found * ms), failures=failures)


def test_the_area_that_got_worse_is_named_first() -> None:
    now = {"aisle 1": driven(3, 4), "aisle 2": driven(3, 24, 0.9), "aisle 3": driven(3, 2), "dock": driven(0.05, 3)}
    before = {"aisle 1": driven(3, 4), "aisle 2": driven(3, 3), "aisle 3": driven(3, 30)}
    found = area_trends(now, before)
    assert [(trend.name, trend.verdict) for trend in found] == [
        ("aisle 2", "worse"),
        ("aisle 1", "no clear change"),
        ("aisle 3", "better"),
        ("dock", "too little driving to say"),
    ]
    low, high = found[0].low, found[0].high
    assert 1 < low < 8 < high
    assert found[0].localised_now == pytest.approx(0.9)
    assert found[3].times_words == "–"
    assert trend_sentence(found) == "Aisle 2 got worse; in 1 of 4 too little was driven to say"
    assert trend_sentence(found[1:3]) == "Nothing got clearly worse"
    assert trend_sentence(found[3:]) == "Too little was driven to say"


def test_without_any_failure_before_there_is_no_upper_bound() -> None:
    (trend,) = area_trends({"a": driven(2, 9)}, {"a": driven(2, 0)})
    assert (trend.verdict, trend.high) == ("worse", None)
    assert trend.times_words.startswith("at least ")
    (quiet,) = area_trends({"a": driven(2, 0)}, {"a": driven(2, 0)})
    assert (quiet.verdict, quiet.low, quiet.high, quiet.times_words) == ("no clear change", 0.0, None, "any")


def test_twice_the_driving_is_not_twice_the_failures() -> None:
    (trend,) = area_trends({"a": driven(20, 40)}, {"a": driven(10, 20)})
    assert trend.verdict == "no clear change"
    assert trend.low < 1 < trend.high


def test_chance_alone_seldom_names_any_of_many_areas() -> None:
    """Expected: at most one week in twenty, with twenty areas that are the same in both weeks."""
    rng = np.random.default_rng(11)
    named = 0
    for _ in range(200):
        weeks = [{f"{n}": driven(2, int(rng.poisson(6))) for n in range(20)} for _ in range(2)]
        named += any(trend.verdict in {"worse", "better"} for trend in area_trends(*weeks))
    assert named <= 16  # of 200, of which 10 may be: more than 16 would come with 3 %
