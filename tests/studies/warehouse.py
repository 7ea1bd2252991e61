"""A fulfilment centre without pictures: position failures per robot-day of the whole system, and with one decision taken away at a time."""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
from functools import partial

import numpy as np
from matplotlib.figure import Figure

from studies.robot_days import rendered
from studies.robot_days.closeness import KINDS
from studies.robot_days.configurations import CONFIGURATIONS, FULL
from studies.robot_days.drives import is_restart, row_of
from studies.robot_days.rates import DayRate, Stratum, combined, day_rate
from studies.robot_days.situations import SITUATIONS
from studies.robot_days.tails import TailStratum
from studies.study import Column, Row, publish, results, table

_BESIDE = "with pictures and without: "
SEED = 163  # of the site
EXTRAPOLATED = f"{FULL}, extrapolated"
_ROUNDS, _ABLATED, _ABLATED_SHORT = (
    8,
    1,
    6,
)  # drives of each situation under every other configuration, of short ones more
_SHORT_M = 60.0


def cases() -> dict[str, partial[Row]]:
    """Round by round, so that a study which was stopped has some of everything; drives along one way follow each other."""
    out = {}
    for round_number in range(_ROUNDS):
        drives = []
        for situation, about in SITUATIONS.items():
            begin, end = (about.drives * n // _ROUNDS for n in (round_number, round_number + 1))
            drives += [(about.day(number), about.length_m, number, situation) for number in range(begin, end)]
        drives.sort()
        out |= {f"{s}, {n}: {FULL}": partial(row_of, s, SEED, n, CONFIGURATIONS[FULL]) for *_, n, s in drives}
        for _, _, number, situation in drives:
            for name in [name for name in CONFIGURATIONS if _is_ablated(situation, number, name)]:
                one = partial(row_of, situation, SEED, number, CONFIGURATIONS[name])
                out[f"{situation}, {number}: {name}"] = one
        if round_number == 0:
            out |= {f"{_BESIDE}{name}": partial(rendered.row_of, name) for name in rendered.RENDERED}
    return out


def _is_ablated(situation: str, number: int, name: str) -> bool:
    """Whether another configuration than the whole system drives it."""
    is_short = SITUATIONS[situation].length_m < _SHORT_M
    return name != FULL and _has_own_drives(situation, name) and number < (_ABLATED_SHORT if is_short else _ABLATED)


def _has_own_drives(situation: str, name: str) -> bool:
    """Where a restart has lost the robot's map and nothing else is missing, all other drives are the whole system's."""
    about = CONFIGURATIONS[name]
    return about.has_shared_map or not about.has_imu or is_restart(situation)


def own(rows: list[Row], situation: str, name: str) -> list[Row]:
    """The drives of a situation under a configuration."""
    driven = name if _has_own_drives(situation, name) else FULL
    return [r for r in rows if r.get("situation") == situation and r["case"].endswith(f": {driven}")]


def strata(rows: list[Row], name: str, count: str) -> dict[str, Stratum]:
    """What was simulated of each situation under a configuration. count: failures or silent."""
    out = {}
    for situation, about in SITUATIONS.items():
        drives = own(rows, situation, name)
        if drives:
            exposure = sum(row["exposure"] for row in drives)
            out[situation] = Stratum(about.per_day, exposure, tuple(row[count] for row in drives))
    return out


def extrapolated(rows: list[Row], count: str) -> DayRate:
    """The whole system's rate; where a drive that began at a dock never failed, by how near it came."""
    found = strata(rows, FULL, count)
    modelled = [s for s, stratum in found.items() if not sum(stratum.failures) and not is_restart(s)]
    tails = [
        [TailStratum(found[s].weight, [np.array(row[kind].split(), float) for row in own(rows, s, FULL)]) for s in modelled]
        for kind in (KINDS if count == "failures" else KINDS[:1])
    ]  # fmt: skip
    return combined([stratum for s, stratum in found.items() if s not in modelled], tails, SEED)


def written(rate: DayRate) -> str:
    """With its interval; what is less than once in ten million days is written as 0."""
    rounded = (round(value, 7) for value in (rate.rate, rate.low, rate.high))
    return "{:.2g} ({:.2g} to {:.2g})".format(*rounded)


def configuration_row(rows: list[Row], name: str) -> Row:
    """A configuration's rates and their top causes."""
    found = strata(rows, name, "failures")
    failures, silent = day_rate(list(found.values())), day_rate(list(strata(rows, name, "silent").values()))
    shares = {situation: s.weight * sum(s.failures) for situation, s in found.items() if sum(s.failures)}
    causes = sorted(shares, key=lambda situation: -shares[situation])[:3]
    return {
        "name": name, "situations": len(found), "failures": written(failures), "silent": written(silent), "robot_days": failures.robot_days,
        "least_days": failures.least_days, "causes": "; ".join(f"{c} {shares[c]:.2g}" for c in causes), "rate": failures,
    }  # fmt: skip


def extrapolated_row(rows: list[Row]) -> Row:
    """The whole system's rates with what its drives came near to."""
    failures, silent = extrapolated(rows, "failures"), extrapolated(rows, "silent")
    return {
        "name": EXTRAPOLATED, "failures": written(failures), "silent": written(silent), "robot_days": failures.robot_days,
        "causes": "", "rate": failures,
    }  # fmt: skip


def situation_rows(rows: list[Row]) -> list[Row]:
    """What the whole system did in each situation, and the nearest that it came to a failure in each way."""
    out = []
    for situation, stratum in strata(rows, FULL, "failures").items():
        about, rate, drives = SITUATIONS[situation], day_rate([stratum]), own(rows, situation, FULL)
        p99 = [r["p99_mm"] for r in drives if r["p99_mm"] is not None]
        nearest = {kind: max((float(v) for r in drives for v in r[kind].split()), default=0.0) for kind in KINDS}
        out.append({
            "name": situation, "per_day": f"{about.per_day:g} {'h' if about.kind == 'hours' else ''}".strip(),
            "source": about.source, "simulated": f"{stratum.exposure:.3g}", "failures": sum(stratum.failures),
            "silent": sum(strata(rows, FULL, "silent")[situation].failures), "rate": written(rate),
            "p99": max(p99) if p99 else None,
        } | nearest)  # fmt: skip
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
    """Rates with their intervals on a logarithmic axis; from what was counted alone, but for the first one."""
    figure = Figure(figsize=(9, 0.55 * len(found) + 1.4), layout="constrained")
    axes = figure.subplots()
    for place, row in enumerate(found[::-1]):
        rate: DayRate = row["rate"]
        low = max(rate.low, 1e-4)
        is_whole = row["name"] in (FULL, EXTRAPOLATED)
        axes.plot([low, rate.high], [place, place], color="#9ca3af", linewidth=5, solid_capstyle="butt")
        if rate.rate > 0:
            axes.plot(rate.rate, place, "o", color="#14924b" if is_whole else "#d1342f", markersize=7)
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
    driven = [name for name in CONFIGURATIONS if strata(rows, name, "failures")]
    found = [extrapolated_row(rows), *(configuration_row(rows, name) for name in driven)]
    shown = [
        Column("name", "configuration"), Column("situations", "situations"), Column("failures", "failures per robot-day"),
        Column("silent", "silent ones"),
        Column("robot_days", "effective robot-days", "{:.2g}"), Column("least_days", "of the situation simulated least", "{:.2g}"),
        Column("causes", "most of them"),
    ]  # fmt: skip
    parts = [
        Column("name", "situation"), Column("per_day", "in a robot-day"), Column("source", "source"), Column("simulated", "simulated"),
        Column("failures", "failures"), Column("silent", "silent"), Column("rate", "per robot-day"),
        Column("p99", "p99 error, mm", "{:.0f}"), *(Column(kind, f"nearest: {kind}", "{:.2f}") for kind in KINDS),
    ]  # fmt: skip
    beside = [
        Column("name", "drive"), Column("tracking", "TRACKING", "{:.0%}"), Column("fixes", "fixes"), Column("inliers", "inliers of a fix"),
        Column("median_mm", "median error, mm"), Column("p95_mm", "p95"), Column("failures", "failures"),
    ]  # fmt: skip
    tables = [table(found, shown), table(situation_rows(rows), parts), table(beside_rows(rows), beside)]
    publish("warehouse", tables, draw(found))


if __name__ == "__main__":
    main()
