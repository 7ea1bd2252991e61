"""The rate of failures that nobody has seen, from how near to one drives came: an extrapolation, with its model.

Above a threshold of its own each situation's figures follow a generalised Pareto distribution (peaks over threshold: Pickands 1975,
Davison and Smith 1990; for accidents by near misses: Songchitruksa and Tarko 2006). The shape is common to all situations, the scale is
each one's own (regional frequency analysis by L-moments: Hosking and Wallis 1997). What it cannot foresee is a failure that comes
without coming near first.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array

_QUANTILE = 0.8  # the threshold
_FEWEST = 5  # peaks of a situation that has a say in the shape
_SHAPES = -0.5, 0.5  # finite variance


class TailStratum(NamedTuple):
    """weight: robot-days' worth of one simulated block. drives: the figures (B,) of each drive."""

    weight: float
    drives: list[Array]


def tail_rate(strata: Sequence[TailStratum]) -> float:
    """Failures in a robot-day by the model."""
    peaks = [_peaks(np.concatenate(stratum.drives)) for stratum in strata]
    ratios = [(len(above), _l_ratio(above)) for above, _ in peaks if len(above) >= _FEWEST and np.ptp(above) > 0]
    if not ratios:
        return 0.0
    ratio = sum(count * ratio for count, ratio in ratios) / sum(count for count, _ in ratios)
    shape = float(np.clip(2.0 - 1.0 / ratio, *_SHAPES))
    return float(sum(s.weight * _beyond(above, room, shape) for s, (above, room) in zip(strata, peaks, strict=True)))


def resampled_rates(strata: Sequence[TailStratum], count: int, rng: np.random.Generator) -> Array:
    """(count,) rates of samples with drives drawn anew: what lies in one drive is not independent."""
    rates = []
    for _ in range(count):
        drawn = [
            TailStratum(s.weight, [s.drives[k] for k in rng.integers(len(s.drives), size=len(s.drives))])
            for s in strata
        ]
        rates.append(tail_rate(drawn))
    return np.array(rates)


def _peaks(figures: Array) -> tuple[Array, float]:
    """How far figures exceed their threshold, by rising size, and how much room that leaves to a failure."""
    if not len(figures):
        return np.zeros(0), 1.0
    threshold = float(np.quantile(figures, _QUANTILE))
    return np.sort(figures[figures > threshold]) - threshold, 1.0 - threshold


def _l_ratio(above: Array) -> float:
    """The second L-moment over the first, of values by rising size."""
    size = len(above)
    first = above.mean()
    second = 2.0 * (np.arange(size) * above).sum() / (size * (size - 1)) - first
    return float(second / first)


def _beyond(above: Array, room: float, shape: float) -> float:
    """How many of the peaks reach a failure, on average."""
    if len(above) < 2 or room <= 0.0:
        return float(len(above)) if room <= 0.0 else 0.0
    scale = above.mean() * (1.0 - shape)
    if abs(shape) < 1e-9:
        return float(len(above) * np.exp(-room / scale))
    return float(len(above) * max(1.0 + shape * room / scale, 0.0) ** (-1.0 / shape))
