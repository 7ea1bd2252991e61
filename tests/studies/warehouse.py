"""A fulfilment centre without pictures: position failures per robot-day of the whole system, and with one decision taken away at a time."""

import itertools
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import chi2

from studies.robot_days.drives import CONFIGURATIONS, FULL, row_of
from studies.robot_days.situations import SITUATIONS
from studies.study import Column, Row, publish, results, study, table

SEEDS = 1009, 2003, 3001  # of the sites; the other configurations drive the first
_ROUNDS = 8
# Drives of each situation under every other configuration, of short ones more
_ABLATED, _ABLATED_SHORT, _SHORT_M = 1, 6, 60.0


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


def cases() -> dict[str, partial[Row]]:
    """The whole system first; round by round, so that a study which was stopped has some of everything."""
    out = {}
    for number, seed in itertools.product(range(_ROUNDS), SEEDS):
        out |= {
            f"{s}, {n}, site {seed}: {FULL}": partial(row_of, s, seed, n, CONFIGURATIONS[FULL])
            for n, s in _round(number)
        }
    for number, situation in itertools.chain.from_iterable(map(_round, range(_ROUNDS))):
        is_short = SITUATIONS[situation].length_m < _SHORT_M
        is_ablated = number < (_ABLATED_SHORT if is_short else _ABLATED)
        for name in [name for name in CONFIGURATIONS if is_ablated and name != FULL]:
            one = partial(row_of, situation, SEEDS[0], number, CONFIGURATIONS[name])
            out[f"{situation}, {number}: {name}"] = one
    return out


def _round(number: int) -> list[tuple[int, str]]:
    """Number and situation of a round's drives; those along one way follow each other."""
    drives = []
    for situation, about in SITUATIONS.items():
        begin, end = (about.drives * n // _ROUNDS for n in (number, number + 1))
        drives += [(about.day(n), about.length_m, n, situation) for n in range(begin, end)]
    return [(n, situation) for *_, n, situation in sorted(drives)]


def own(rows: list[Row], situation: str, name: str) -> list[Row]:
    """The drives of a situation under a configuration."""
    return [row for row in rows if row["situation"] == situation and row["case"].endswith(f": {name}")]


def strata(rows: list[Row], name: str, count: str) -> dict[str, Stratum]:
    """What was simulated of each situation under a configuration. count: failures or silent."""
    out = {}
    for situation, about in SITUATIONS.items():
        drives = own(rows, situation, name)
        if drives:
            exposure = sum(row["exposure"] for row in drives)
            out[situation] = Stratum(about.per_day, exposure, tuple(row[count] for row in drives))
    return out


def written(rate: DayRate) -> str:
    """With its interval; what is less than once in ten million days is written as 0."""
    rounded = (round(value, 7) for value in (rate.rate, rate.low, rate.high))
    return "{:.2g} ({:.2g} to {:.2g})".format(*rounded)


def configuration_row(rows: list[Row], name: str) -> Row:
    """A configuration's rates and their top causes."""
    found = strata(rows, name, "failures")
    failures, silent = day_rate(list(found.values())), day_rate(list(strata(rows, name, "silent").values()))
    shares = {situation: s.per_day / s.exposure * sum(s.failures) for situation, s in found.items() if sum(s.failures)}
    causes = sorted(shares, key=lambda situation: -shares[situation])[:3]
    return {
        "name": name, "situations": len(found), "failures": written(failures), "silent": written(silent), "robot_days": failures.robot_days,
        "least_days": failures.least_days, "causes": "; ".join(f"{c} {shares[c]:.2g}" for c in causes), "rate": failures,
    }  # fmt: skip


def situation_rows(rows: list[Row]) -> list[Row]:
    """What the whole system did in each situation."""
    out = []
    for situation, stratum in strata(rows, FULL, "failures").items():
        about, rate, drives = SITUATIONS[situation], day_rate([stratum]), own(rows, situation, FULL)
        p99 = [r["p99_mm"] for r in drives if r["p99_mm"] is not None]
        out.append({
            "name": situation, "per_day": f"{about.per_day:g} {'h' if about.kind == 'hours' else ''}".strip(),
            "source": about.source, "simulated": f"{stratum.exposure:.3g}", "failures": sum(stratum.failures),
            "silent": sum(strata(rows, FULL, "silent")[situation].failures), "rate": written(rate),
            "p99": max(p99) if p99 else None,
        })  # fmt: skip
    return out


def draw(found: list[Row]) -> Figure:
    """Rates with their intervals on a logarithmic axis."""
    figure = Figure(figsize=(9, 0.55 * len(found) + 1.4), layout="constrained")
    axes = figure.subplots()
    for place, row in enumerate(found[::-1]):
        rate: DayRate = row["rate"]
        low = max(rate.low, 1e-4)
        axes.plot([low, rate.high], [place, place], color="#9ca3af", linewidth=5, solid_capstyle="butt")
        if rate.rate > 0:
            axes.plot(rate.rate, place, "o", color="#14924b" if row["name"] == FULL else "#d1342f", markersize=7)
    axes.axvline(0.02, color="#14924b", linestyle="--", linewidth=1, label="the target: at most 0.02")
    axes.set_yticks(np.arange(len(found)), [row["name"] for row in found[::-1]])
    axes.set_xscale("log")
    axes.set_xlim(1e-3, None)
    axes.set_xlabel("position failures in a robot-day of 16 hours, and 95 % interval")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), fontsize=8, frameon=False)
    return figure


@study
def main() -> None:
    """Rows, tables and picture of docs/studies/warehouse.md."""
    rows = results("warehouse", cases(), SEEDS)
    driven = [name for name in CONFIGURATIONS if strata(rows, name, "failures")]
    found = [configuration_row(rows, name) for name in driven]
    shown = [
        Column("name", "configuration"), Column("situations", "situations"), Column("failures", "failures per robot-day"),
        Column("silent", "silent ones"),
        Column("robot_days", "effective robot-days", "{:.2g}"), Column("least_days", "of the situation simulated least", "{:.2g}"),
        Column("causes", "most of them"),
    ]  # fmt: skip
    parts = [
        Column("name", "situation"), Column("per_day", "in a robot-day"), Column("source", "source"), Column("simulated", "simulated"),
        Column("failures", "failures"), Column("silent", "silent"), Column("rate", "per robot-day"),
        Column("p99", "p99 error, mm", "{:.0f}"),
    ]  # fmt: skip
    publish("warehouse", [table(found, shown), table(situation_rows(rows), parts)], draw(found))
