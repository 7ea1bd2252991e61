"""A rate of failures from strata that were simulated for other times than they last in a robot-day."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from studies.robot_days.tails import TailStratum, resampled_rates, tail_rate

_LEVEL = 0.95


class Stratum(NamedTuple):
    """What was simulated of one situation.

    per_day: hours or events of it in a robot-day. exposure: hours or events that were simulated, in the same unit. failures: those of
    each drive.
    """

    per_day: float
    exposure: float
    failures: tuple[int, ...]

    @property
    def weight(self) -> float:
        """Robot-days' worth of one failure: what one that was seen adds to the rate."""
        return self.per_day / self.exposure


class DayRate(NamedTuple):
    """Failures per robot-day with the interval that holds the true rate with 95 %.

    robot_days: of a plain simulation of whole robot-days whose rate would be as uncertain. least_days: of the situation that was
    simulated least, which bounds what no failure at all may be taken to mean.
    """

    rate: float
    low: float
    high: float
    robot_days: float
    least_days: float


def day_rate(strata: Sequence[Stratum]) -> DayRate:
    """Weighted sum of the strata's failures, with the gamma interval of Fay and Feuer 1997.

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


def combined(
    counted: Sequence[Stratum], modelled: Sequence[Sequence[TailStratum]], seed: int, draws: int = 1000
) -> DayRate:
    """Counted strata and modelled ones together: each one's confidence distributions are added up.

    modelled: for each way to fail the strata whose figures of it are extrapolated; their rates are added, as if no failure were of two
    ways, and rise and fall together in the bootstrap. A counted stratum's distributions are gammas, for its lower end of the failures
    that were seen, for its upper end of one more; failures of one drive are one event of their number. Those of the model are its
    bootstrap. Source: Fay, Proschan and Brittain 2015, melding.
    """
    low, rate = np.zeros(draws), 0.0
    for strata in modelled:
        low = low + resampled_rates(strata, draws, np.random.default_rng(seed))
        rate += tail_rate(strata)
    high, rng = low.copy(), np.random.default_rng([seed, 1])
    for stratum in counted:
        seen = sum(stratum.failures)
        size = sum(n * n for n in stratum.failures) / seen if seen else 1.0
        rate += stratum.weight * seen
        low = low + stratum.weight * size * (rng.gamma(seen / size, size=draws) if seen else 0.0)
        high += stratum.weight * size * rng.gamma(seen / size + 1.0, size=draws)
    tail = 100 * (1 - _LEVEL) / 2
    variance = float(high.var())
    largest = max((s.weight for s in counted), default=0.0)
    ends = float(np.percentile(low, tail)), float(np.percentile(high, 100 - tail))
    return DayRate(rate, *ends, rate / variance if variance else 0.0, 1 / largest if largest else 0.0)
