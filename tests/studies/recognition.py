"""Recognition across sessions: switched on anywhere, knowing nothing, a day or a week later and by night. What does a robot answer?"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmarks.common.looks import EVERY_S, Answer, as_row, curve, looks, map_of, right_at
from benchmarks.common.recorded_runs import kept_folder, recorded, surveyed
from benchmarks.robot.bench_real_robots import MAPPED, UNSEEN, mapped
from locclient.maps.loaded_map import LoadedMap
from locclient.replay.starts import LOOK_S
from studies.study import Column, Row, publish, results, table
from support.recordings.realdata import DATA

SEEDS = 88, 89
AT_WRONG = 0.01
_FEW = ("--frames", "240")


class Condition(NamedTuple):
    """A site of the simulator, and the drive of a robot in it."""

    scenario: str
    options: tuple[str, ...]


_RUNNER, _TOTE = ("--robot", "runner-1", *_FEW), ("--robot", "tote-1", *_FEW)
_NIGHT = ("--light", "night")
CONDITIONS = {
    "next day": Condition("small-loop", (*_RUNNER, "--day", "1")),
    "next night": Condition("small-loop", (*_RUNNER, "--day", "1", *_NIGHT)),
    "a week later, night": Condition("small-loop", (*_RUNNER, "--day", "7", *_NIGHT)),
    "five aisles, next day": Condition("five-aisles", (*_TOTE, "--day", "1")),
    "five aisles, a week later, night": Condition("five-aisles", (*_TOTE, "--day", "7", *_NIGHT)),
}
REAL = {"V1_01, odd frames": (MAPPED, UNSEEN)}  # frames of the map, of the robot
BESIDE_M = 1.5  # of a place of the map that looks a like way


def simulated(condition: str, seed: int) -> Row:
    """Looks of a robot's drive in the map of a survey by day."""
    work, (scenario, options) = kept_folder(), CONDITIONS[condition]
    work.mkdir(parents=True, exist_ok=True)
    loaded = map_of(surveyed(work, seed, scenario))
    return looked(condition, seed, recorded(work, (*options, "--seed", str(seed)), scenario), loaded)


def real(name: str) -> Row:
    """Looks of the frames of V1_01 that its map was not made of: the same flight, so the same light."""
    folder, (of_map, of_robot) = DATA / "euroc_v101_keyframes", REAL[name]
    return looked(name, None, folder, map_of(mapped(kept_folder(), folder, of_map)), of_robot)


def looked(condition: str, seed: int | None, path: Path, loaded: LoadedMap, frames: str = ":") -> Row:
    """What all looks of a recording answered."""
    return {"condition": condition, "seed": seed, "looks": [as_row(look) for look in looks(path, loaded, frames)]}


def answers(rows: Sequence[Row], which: str) -> list[Answer]:
    """Of all looks of some rows."""
    return [Answer(*look[which]) for row in rows for look in row["looks"]]


def summary(condition: str, rows: Sequence[Row]) -> Row:
    """What a condition comes to, all seeds together."""
    found = [look for row in rows for look in row["looks"]]
    first, joined = answers(rows, "first"), answers(rows, "joined")
    tracked = [look["tracking_s"] for look in found if look["tracking_s"] is not None]
    return {
        "condition": condition, "looks": len(found),
        "beside": float(np.mean([look["off_m"] is not None and look["off_m"] <= BESIDE_M for look in found])),
        "first": right_at(first, AT_WRONG), "joined": right_at(joined, AT_WRONG),
        "first_any": float(np.mean([a.is_right for a in first])), "first_wrong": sum(a.is_wrong for a in first),
        "joined_any": float(np.mean([a.is_right for a in joined])), "joined_wrong": sum(a.is_wrong for a in joined),
        "tracking": len(tracked) / len(found), "silent": sum(look["is_silent"] for look in found),
        "median_s": float(np.median(tracked)) if tracked else None,
    }  # fmt: skip


def draw(grouped: dict[str, list[Row]]) -> Figure:
    """Right over threshold, and wrong below it, of single frames and of looks."""
    figure = Figure(figsize=(2.6 * len(grouped), 3.4), layout="constrained")
    kinds = ("first", "#8b95a1", "single frame"), ("joined", "#2563eb", f"look of {LOOK_S:.0f} s")
    for axes, (condition, rows) in zip(figure.subplots(1, len(grouped), sharey=True), grouped.items(), strict=True):
        for which, color, label in kinds:
            points = np.array([[1.0, 0.0, 0.0], *reversed(curve(answers(rows, which)))])
            axes.step(points[:, 0], points[:, 1], where="pre", color=color, label=f"{label}: right")
            axes.step(points[:, 0], points[:, 2], where="pre", color=color, linestyle=":", label="of its answers wrong")
        axes.set(ylim=(-0.03, 1.05), xscale="log")
        axes.set_title(condition, fontsize=9)
    figure.axes[0].legend(fontsize=7, frameon=False)
    figure.supxlabel("inliers of all fixes behind the answer, at least", fontsize=9)
    return figure


def main() -> None:
    """Rows, tables and picture of docs/studies/recognition.md."""
    cases = {f"{name}, seed {seed}": partial(simulated, name, seed) for name in CONDITIONS for seed in SEEDS}
    if (DATA / "euroc_v101_keyframes").is_dir():
        cases |= {name: partial(real, name) for name in REAL}
    rows = results("recognition", cases, list(SEEDS))
    grouped = {name: [row for row in rows if row["condition"] == name] for name in [*CONDITIONS, *REAL]}
    grouped = {name: found for name, found in grouped.items() if found}
    look = f"looks of {LOOK_S:.0f} s"
    shown = [
        Column("condition", "condition"), Column("looks", "looks"), Column("beside", f"begun within {BESIDE_M} m of the map", "{:.0%}"),
        Column("first", "single frames right, at 1 % wrong", "{:.0%}"),
        Column("joined", f"{look} right, at 1 % wrong", "{:.0%}"), Column("first_any", "single frames right, all answers", "{:.0%}"),
        Column("first_wrong", "wrong"), Column("joined_any", f"{look} right, all answers", "{:.0%}"), Column("joined_wrong", "wrong"),
        Column("tracking", "TRACKING within the look", "{:.0%}"), Column("median_s", "after, median s", "{:.1f}"),
        Column("silent", "TRACKING elsewhere"),
    ]  # fmt: skip
    summaries = table([summary(n, of) for n, of in grouped.items()], shown)
    publish("recognition", [summaries, f"A look begins every {EVERY_S} s."], draw(grouped))


if __name__ == "__main__":
    main()
