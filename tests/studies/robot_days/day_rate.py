"""Failures per robot-day from situations that were tried much more often, or more rarely, than a day holds them. Pure."""

from collections.abc import Sequence
from typing import NamedTuple

from scipy.stats import chi2


class Stratum(NamedTuple):
    """Trials of one situation: hours or events of it in a robot-day, those that were tried, and the failures of each trial."""

    per_day: float
    exposure: float
    failures: tuple[int, ...]


class DayRate(NamedTuple):
    """Failures per robot-day with the interval that holds the true rate with 95 %.

    robot_days: of a plain simulation whose rate would be as uncertain. least_days: of the situation that was tried least, which limits
    the meaning of no failure at all.
    """

    rate: float
    low: float
    high: float
    robot_days: float
    least_days: float


def day_rate(strata: Sequence[Stratum]) -> DayRate:
    """Return the weighted sum of the strata's failures, with the gamma interval of Fay and Feuer 1997.

    Where nothing failed at all, the upper end is 3.0 of the largest weight, the rule of three. Failures of one drive are one event of
    their number (compound Poisson), since they may have one cause.
    """
    weighed = [(stratum.per_day / stratum.exposure, stratum.failures) for stratum in strata]
    rate = sum(weight * sum(failures) for weight, failures in weighed)
    variance = sum(weight**2 * sum(n * n for n in failures) for weight, failures in weighed)
    largest = max(weight for weight, _ in weighed)
    if rate == 0.0:
        return DayRate(0.0, 0.0, largest / 2 * float(chi2.ppf(0.95, 2)), 1 / largest, 1 / largest)
    low = variance / (2 * rate) * float(chi2.ppf(0.025, 2 * rate**2 / variance))
    wider, above = variance + largest**2, rate + largest
    high = wider / (2 * above) * float(chi2.ppf(0.975, 2 * above**2 / wider))
    return DayRate(rate, low, high, rate / variance, 1 / largest)
