"""Trend of areas: failures of a time compared with those of a time before, per area. Pure."""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import scipy

from mapserver.fleet_statistics.kpis import Counters, Rate, figure, is_enough, kpis, rate

Verdict = Literal["worse", "better", "no clear change", "too little driving to say"]
_CONFIDENCE_TAIL = 0.05
_UNKNOWN: Verdict = "too little driving to say"
_ORDER: dict[Verdict, int] = {"worse": 0, "no clear change": 1, "better": 2, "too little driving to say": 3}


class AreaTrend(NamedTuple):
    """An area now and before. low, high: interval of the ratio of failure rates, now over before; high None if unbounded.

    localised_*: share of the driving time in which robots were localised, None if unknown.
    """

    name: str
    verdict: Verdict
    now: Rate
    before: Rate
    low: float | None
    high: float | None
    localised_now: float | None
    localised_before: float | None

    @property
    def times_words(self) -> str:
        """The ratio as text; a dash with too little driving."""
        if self.low is None:
            return "–"
        if self.high is None:
            return f"at least {figure(self.low)} times" if self.low > 0 else "any"
        return f"{figure(self.low)} to {figure(self.high)} times"


def area_trends(now: Mapping[str, Counters], before: Mapping[str, Counters]) -> list[AreaTrend]:
    """Return all areas of either time, the worsened first. All intervals together hold the true ratios with 95 %.

    Given all failures of both times, those of the last one are binomial (Przyborowski and Wilenski 1940); the exact interval of that share
    (Clopper and Pearson 1934) gives that of the ratio, and Bonferroni's correction accounts for the number of areas.
    """
    nothing = Counters()
    pairs = {name: (now.get(name, nothing), before.get(name, nothing)) for name in {*now, *before}}
    told = [name for name, both in pairs.items() if all(is_enough(counts.robot_days) for counts in both)]
    tail = _CONFIDENCE_TAIL / max(1, len(told)) / 2
    found = []
    for name, (newer, older) in pairs.items():
        rates = (rate(newer.position_failures, newer.robot_days), rate(older.position_failures, older.robot_days))
        shares = (kpis(newer).localised_share_of_all, kpis(older).localised_share_of_all)
        low, high, verdict = None, None, _UNKNOWN
        if name in told:
            low, high = _ratio(*rates, tail)
            verdict = "worse" if low > 1 else "better" if high is not None and high < 1 else "no clear change"
        found.append(AreaTrend(name, verdict, *rates, low, high, *shares))
    return sorted(found, key=lambda trend: (_ORDER[trend.verdict], -(trend.low or 0.0), -trend.now.events, trend.name))


def _ratio(now: Rate, before: Rate, tail: float) -> tuple[float, float | None]:
    """Return the interval of the ratio of two rates with `tail` outside on either side."""
    a, b = now.events, before.events
    low = 0.0 if a == 0 else float(scipy.special.betaincinv(a, b + 1, tail))
    high = 1.0 if b == 0 else float(scipy.special.betaincinv(a + 1, b, 1 - tail))
    odds = before.robot_days / now.robot_days
    return odds * low / (1 - low), None if high >= 1.0 else odds * high / (1 - high)


def trend_sentence(trends: list[AreaTrend]) -> str:
    """Return a sentence that names the worsened areas."""
    worse = [trend.name for trend in trends if trend.verdict == "worse"]
    silent = sum(trend.verdict == _UNKNOWN for trend in trends)
    if worse:
        names = " and ".join([", ".join(worse[:-1]), worse[-1]] if len(worse) > 1 else worse)
        told = f"{names[:1].upper()}{names[1:]} got worse"
    elif silent < len(trends):
        told = "Nothing got clearly worse"
    else:
        return "Too little was driven to say"
    return told + (f"; in {silent} of {len(trends)} too little was driven to say" if silent else "")
