"""Rates are told where enough was driven, counts everywhere."""

from mapserver.fleet_statistics.kpis import driven_words, format_rate, is_telling, rate


def test_one_failure_in_two_minutes_is_no_rate() -> None:
    little, enough = rate(1, 2 / 960), rate(1, 50.0)
    assert (is_telling(little), format_rate(little), driven_words(little.robot_days)) == (
        False,
        "–",
        "2 min of driving",
    )
    assert (is_telling(enough), format_rate(enough)) == (True, "0.02 (0.00051 to 0.11)")
    assert not is_telling(rate(0, 0.0))
    assert [driven_words(days) for days in (0.0, 0.5, 1.0, 37.4)] == [
        "0 min of driving", "8.0 h of driving", "1 robot-days", "37 robot-days",
    ]  # fmt: skip
