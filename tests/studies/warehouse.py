"""A fulfilment centre without pictures: position failures per robot-day of the whole system, and with one decision taken away at a time."""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from studies.robot_days import rendered
from studies.robot_days.configurations import CONFIGURATIONS, FULL
from studies.robot_days.drives import DRIVES, Batch, row_of
from studies.robot_days.rates import DayRate, Stratum, day_rate
from studies.robot_days.situations import SITUATIONS
from studies.study import Column, Row, publish, results, table

_BESIDE = "with pictures and without: "
SEED = 21  # of the site
ABLATED, RARE = 1, 0.1  # drives of each situation under every other configuration; none of what a robot-day has less of


def cases() -> dict[str, partial[Row]]:
    """Batch by batch, so that a study which was stopped has some of everything. Ablations drive the first drives of the first batch."""
    out = {}
    for number in range(max(about.batches for about in SITUATIONS.values())):
        for situation in [name for name, about in SITUATIONS.items() if number < about.batches]:
            for name, configuration in CONFIGURATIONS.items():
                drives = DRIVES if name == FULL else ABLATED
                if name == FULL or (number == 0 and SITUATIONS[situation].per_day >= RARE):
                    one = partial(row_of, Batch(situation, SEED, number), configuration, drives)
                    out[f"{number}: {situation}: {name}"] = one
        if number == 0:
            out |= {f"{_BESIDE}{name}": partial(rendered.row_of, name) for name in rendered.RENDERED}
    return out


def strata(rows: list[Row], name: str, count: str) -> dict[str, Stratum]:
    """What was simulated of each situation under a configuration. count: failures or silent."""
    out = {}
    for situation, about in SITUATIONS.items():
        own = [r for r in rows if r.get("situation") == situation and r["case"].endswith(f": {name}")]
        failures = tuple(int(n) for row in own for n in row[count].split())
        if own:
            out[situation] = Stratum(about.per_day, sum(r["exposure"] for r in own), failures)
    return out


def written(rate: DayRate) -> str:
    """With its interval."""
    return f"{rate.rate:.2g} ({rate.low:.2g} to {rate.high:.2g})"


def configuration_row(rows: list[Row], name: str) -> Row:
    """A configuration's rates and their top causes."""
    found = strata(rows, name, "failures")
    failures, silent = day_rate(list(found.values())), day_rate(list(strata(rows, name, "silent").values()))
    shares = {situation: s.weight * sum(s.failures) for situation, s in found.items() if sum(s.failures)}
    causes = sorted(shares, key=lambda situation: -shares[situation])[:3]
    return {
        "name": name, "failures": written(failures), "silent": written(silent), "robot_days": failures.robot_days,
        "least_days": failures.least_days, "causes": "; ".join(f"{c} {shares[c]:.2g}" for c in causes), "rate": failures,
    }  # fmt: skip


def situation_rows(rows: list[Row]) -> list[Row]:
    """What the whole system did in each situation."""
    out = []
    for situation, stratum in strata(rows, FULL, "failures").items():
        about, rate = SITUATIONS[situation], day_rate([stratum])
        own = [r for r in rows if r.get("situation") == situation and r["case"].endswith(f": {FULL}")]
        p99 = [r["p99_mm"] for r in own if r["p99_mm"] is not None]
        out.append({
            "name": situation, "per_day": f"{about.per_day:g} {'' if about.events else 'h'}".strip(), "source": about.source,
            "simulated": f"{stratum.exposure:.3g}", "failures": sum(stratum.failures),
            "silent": sum(strata(rows, FULL, "silent")[situation].failures), "rate": written(rate),
            "p99": max(p99) if p99 else None,
        })  # fmt: skip
    return out


def beside_rows(rows: list[Row]) -> list[Row]:
    """Rendered runs beside those without pictures, one above the other."""
    return [
        {
            "name": f"{row['situation']}, {kind}",
            **{k.removeprefix(f"{kind}_"): v for k, v in row.items() if k.startswith(kind)},
        }
        for row in rows
        if row["case"].startswith(_BESIDE)
        for kind in ("pictures", "landmarks")
    ]


def draw(found: list[Row]) -> Figure:
    """Rates with their intervals on a logarithmic axis."""
    figure = Figure(figsize=(9, 0.55 * len(found) + 1.4), layout="constrained")
    axes = figure.subplots()
    for place, row in enumerate(found[::-1]):
        rate: DayRate = row["rate"]
        low = max(rate.low, 1e-4)
        axes.plot([low, rate.high], [place, place], color="#9ca3af", linewidth=5, solid_capstyle="butt")
        if rate.rate > 0:
            axes.plot(rate.rate, place, "o", color="#d1342f" if row["name"] != FULL else "#14924b", markersize=7)
    axes.axvline(0.02, color="#14924b", linestyle="--", linewidth=1, label="the target: at most 0.02")
    axes.set_yticks(np.arange(len(found)), [row["name"] for row in found[::-1]])
    axes.set_xscale("log")
    axes.set_xlim(1e-3, None)
    axes.set_xlabel("position failures in a robot-day of 16 hours, and 95 % interval")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), fontsize=8, frameon=False)
    return figure


def main() -> None:
    """Rows, tables and picture of docs/studies/warehouse.md."""
    rows = results("warehouse", cases(), [SEED, rendered.SEED])
    found = [configuration_row(rows, name) for name in CONFIGURATIONS]
    shown = [
        Column("name", "configuration"), Column("failures", "failures per robot-day"), Column("silent", "silent ones"),
        Column("robot_days", "effective robot-days", "{:.2g}"), Column("least_days", "of the situation simulated least", "{:.2g}"),
        Column("causes", "most of them"),
    ]  # fmt: skip
    parts = [
        Column("name", "situation"), Column("per_day", "in a robot-day"), Column("source", "source"), Column("simulated", "simulated"),
        Column("failures", "failures"), Column("silent", "silent"), Column("rate", "per robot-day"),
        Column("p99", "p99 error, mm", "{:.0f}"),
    ]  # fmt: skip
    beside = [
        Column("name", "drive"), Column("tracking", "TRACKING", "{:.0%}"), Column("fixes", "fixes"), Column("inliers", "inliers of a fix"),
        Column("median_mm", "median error, mm"), Column("p95_mm", "p95"), Column("failures", "failures"),
    ]  # fmt: skip
    tables = [table(found, shown), table(situation_rows(rows), parts), table(beside_rows(rows), beside)]
    publish("warehouse", tables, draw(found))


if __name__ == "__main__":
    main()
