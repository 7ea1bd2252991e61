"""A ladder of twelve steps into the dark: pictures of robots made darker and darker, in maps made of pictures as they were taken."""

from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.common.recorded_runs import SITE, kept_folder, recorded, surveyed
from benchmarks.robot.bench_real_robots import UNSEEN, mapped
from fleetmap.recordings import FrameSelection, open_recording
from fleetmap.sensors.samples import CameraFrame, PositionPrior
from fleetmap.sources.replay_source import ReplaySource
from locclient.identity import MapAddress
from locclient.maps.connection import connected
from locclient.replay import run_metrics
from locclient.replay.replay import ReplayOptions, replay
from studies.study import Column, Row, publish, results, table
from support.recordings.realdata import DATA

SEED = 82
LEVELS = range(13)
_A_STEP, _GAMMA_STEP = 0.8, 0.85
RECORDINGS = {
    "MH_01, odd frames": "euroc_mh01_start",
    "V1_01, odd frames": "euroc_v101_keyframes",
    "warehouse, next day": None,
}
_DRIVE = ("--robot", "runner-1", "--day", "1", "--frames", "240", "--seed", str(SEED))
ENOUGH = 0.95


def parameters(level: int) -> tuple[float, float]:
    """A and gamma: they take turns to fall, A at odd levels, gamma at even ones."""
    return _A_STEP ** ((level + 1) // 2), _GAMMA_STEP ** (level // 2)


def darkening(level: int) -> NDArray[np.uint8]:
    """(256,) the grey that each grey becomes, V_out = A V_in^(1/gamma), in whole greys again."""
    most, gamma = parameters(level)
    return np.rint(255.0 * most * (np.arange(256) / 255.0) ** (1.0 / gamma)).astype(np.uint8)


@dataclass(frozen=True)
class DarkSource(ReplaySource):
    """A source whose pictures are darkened and which gives no prior: the robot knows nothing but what it sees."""

    greys: NDArray[np.uint8]

    def frame(self, number: int) -> CameraFrame:
        """As `ReplaySource.frame`."""
        frame = super().frame(number)
        return replace(frame, left=self.greys[frame.left], right=self.greys[frame.right])

    def priors_before(self, number: int) -> list[PositionPrior]:
        """None."""
        return []


@cache
def prepared(name: str) -> tuple[Path, Path, str]:
    """The recording, the store with its map, and the frames to play."""
    work, folder = kept_folder(), RECORDINGS[name]
    work.mkdir(parents=True, exist_ok=True)
    if folder is None:
        return recorded(work, _DRIVE), surveyed(work, SEED), ":"
    return DATA / folder, mapped(work, DATA / folder), UNSEEN


def case(name: str, level: int) -> Row:
    """One recording at one level."""
    path, store, frames = prepared(name)
    address, greys = MapAddress(site=SITE, robot="bench", store=str(store)), darkening(level)
    with open_recording(path) as recording, connected(address) as link:
        chosen = FrameSelection.parse(frames).apply(recording)
        source = DarkSource(recording, chosen, reverse=False, greys=greys)
        mean_grey = float(np.mean([source.frame(k).left.mean() for k in range(0, len(source), len(source) // 5)]))
        records = replay(source, link, ReplayOptions()).frames
    errors = run_metrics.error_m(records)
    a, gamma = parameters(level)
    return {
        "recording": name, "level": level, "a": round(a, 3), "gamma": round(gamma, 3), "grey": round(mean_grey, 1), "frames": len(records),
        "localised": run_metrics.localised_share_of_all(records), "silent": run_metrics.silent_failures(records),
        "status": run_metrics.status_share(records), "median_mm": None if errors is None else 1e3 * errors["median"],
        "max_mm": None if errors is None else 1e3 * errors["max"],
    }  # fmt: skip


def falls_at(rows: list[Row]) -> int | None:
    """The first level at which less than ENOUGH is localised; None where that never happens."""
    return next((row["level"] for row in rows if row["localised"] < ENOUGH), None)


def draw(rows: list[Row]) -> Figure:
    """What is localised by level, and one picture of the warehouse at some of the levels."""
    figure = Figure(figsize=(9, 5.2), layout="constrained")
    grid = figure.add_gridspec(2, 5, height_ratios=(2.2, 1))
    axes = figure.add_subplot(grid[0, :])
    for name, color in zip(RECORDINGS, ("#2563eb", "#c77700", "#14924b"), strict=True):
        of_name = [row for row in rows if row["recording"] == name]
        axes.plot([r["level"] for r in of_name], [r["localised"] for r in of_name], "o-", color=color, label=name)
        for row in of_name:
            if row["silent"]:
                axes.annotate(f"{row['silent']} silent", (row["level"], row["localised"]), color="#d1342f", fontsize=8)
    axes.axhline(ENOUGH, color="#8b95a1", linewidth=0.8, linestyle="--")
    axes.set(xlabel="level", ylabel="localised, of all frames", xticks=list(LEVELS), ylim=(-0.03, 1.05))
    axes.legend(fontsize=8, frameon=False)
    with open_recording(recorded(kept_folder(), _DRIVE)) as recording:
        shown = recording.read_frame(60).left
    for place, level in enumerate((0, 3, 6, 9, 12)):
        picture = figure.add_subplot(grid[1, place])
        picture.imshow(darkening(level)[shown], cmap="gray", vmin=0, vmax=255)
        picture.set_title(f"level {level}", fontsize=8)
        picture.set_axis_off()
    return figure


def main() -> None:
    """Rows, table and picture of docs/studies/dark_ladder.md."""
    there = [name for name, folder in RECORDINGS.items() if folder is None or (DATA / folder).is_dir()]
    rows = results("dark_ladder", {f"{n}, level {k}": partial(case, n, k) for n in there for k in LEVELS}, [SEED])
    ladder = [row for row in rows if row["recording"] == there[-1]]
    wide = [
        {"level": row["level"], "a": row["a"], "gamma": row["gamma"], "grey": row["grey"]}
        | {key + r["recording"]: r[key] for r in rows if r["level"] == row["level"] for key in ("localised", "silent")}
        for row in ladder
    ]
    shown = [
        Column("level", "level"),
        Column("a", "A", "{:.2f}"),
        Column("gamma", "gamma", "{:.2f}"),
        Column("grey", "mean grey, warehouse"),
    ]
    for name in there:
        shown += [Column(f"localised{name}", name, "{:.0%}"), Column(f"silent{name}", "silent")]
    by_name = {n: [row for row in rows if row["recording"] == n] for n in there}
    reached = [
        {
            "recording": n, "falls": falls_at(of) or "never", "silent": sum(r["silent"] for r in of),
            "max_mm": max(r["max_mm"] or 0.0 for r in of),
        }
        for n, of in by_name.items()
    ]  # fmt: skip
    summary = [
        Column("recording", "recording"), Column("falls", f"first level below {ENOUGH:.0%}"),
        Column("silent", "silent failures, all levels"), Column("max_mm", "largest error of a localised frame, mm", "{:.0f}"),
    ]  # fmt: skip
    publish("dark_ladder", [table(reached, summary), table(wide, shown)], draw(rows))


if __name__ == "__main__":
    main()
