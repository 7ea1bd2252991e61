"""Failures per robot-day from situations that were tried much more often, or more rarely, than a day holds them. Pure."""

from collections.abc import Sequence
from typing import NamedTuple

from scipy.stats import chi2

_LEVEL = 0.95


class Stratum(NamedTuple):
    """The trials of one situation.

    per_day: hours or events of it in a robot-day. exposure: hours or events that were tried, in the same unit. failures: those of
    each trial.
    """

    per_day: float
    exposure: float
    failures: tuple[int, ...]

    @property
    def weight(self) -> float:
        """Robot-days' worth of one failure: its contribution to the rate."""
        return self.per_day / self.exposure


class DayRate(NamedTuple):
    """Failures per robot-day with the interval that holds the true rate with 95 %.

    robot_days: of a plain simulation of whole robot-days whose rate would be as uncertain. least_days: of the situation that was
    tried least, which limits the meaning of no failure at all.
    """

    rate: float
    low: float
    high: float
    robot_days: float
    least_days: float


def day_rate(strata: Sequence[Stratum]) -> DayRate:
    """Return the weighted sum of the strata's failures, with the gamma interval of Fay and Feuer 1997.

    A stratum without failures widens the upper end through the largest weight: where nothing failed at all, the end is 3.0 of it, the
    rule of three. Failures of one drive are counted as one event of their number (compound Poisson), since they may have one cause.
    """
    rate = sum(s.weight * sum(s.failures) for s in strata)
    variance = sum(s.weight**2 * sum(n * n for n in s.failures) for s in strata)
    largest = max(s.weight for s in strata)
    tail = (1 - _LEVEL) / 2
    if rate == 0.0:
        high = largest / 2 * float(chi2.ppf(_LEVEL, 2))
        return DayRate(0.0, 0.0, high, 1 / largest, 1 / largest)
    low = variance / (2 * rate) * float(chi2.ppf(tail, 2 * rate**2 / variance))
    wider, above = variance + largest**2, rate + largest
    high = wider / (2 * above) * float(chi2.ppf(1 - tail, 2 * above**2 / wider))
    return DayRate(rate, low, high, rate / variance, 1 / largest)
