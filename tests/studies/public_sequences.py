"""All public recordings at hand: surveys after the fact, odometry as it went, robots in a map of the other half; peers beside it."""

import argparse
import json
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure

from benchmarks.common.recorded_runs import SITE, mapped, played, tool
from benchmarks.robot.bench_real_robots import MAPPED, UNSEEN, robots_map
from fleetmap.recordings import open_recording
from fleetmap.recordings.tum import read_tum
from fleetmap.sensors.samples import Trajectory
from locclient.replay import run_metrics
from locclient.replay.run_result import ReplayResult
from mapserver.evaluation.trajectory_error import absolute_trajectory_error, paired
from mapserver.plugins.trajectory_errors.errors import at_first_stamp
from mapserver.survey.odometry_pass import FrameChain
from studies.study import PAGES, Column, Row, between_marks, publish, results, rms, study, table
from support.recordings.hashes import hashed, tiles_of
from support.recordings.realdata import DATA
from support.room_site import KNOWN_RIG

_SHORT_M = 1.0  # of less no share is said
_OF_KNOWN_RIG = {"median_mm": "robot_median_mm", "localised_share": "localised_share"}
COMPARISON = PAGES.parent / "comparison.md"
# What others reach on the same frames, measured by us once, and what their authors print of the whole sequence (docs/studies).
PEERS = {
    "euroc_mh01_start": ("EuRoC MH_01, first 15 s", "ORB-SLAM3 4.2, stella_vslam 4.6", "ORB-SLAM3 36, OKVIS2-X 28 (mean of 11)"),
    "euroc_v101_keyframes": ("EuRoC V1_01, 100 pairs", "COLMAP 13.5 with scale; ORB-SLAM3 loses track", "ORB-SLAM3 38"),
    "kitti_stereo_51": ("KITTI odometry, 51 pairs", "ORB-SLAM3 42, stella_vslam 99", "ORB-SLAM2 1.15 %, cuVSLAM 0.75 % drift"),
    "7scenes_redkitchen_200": ("7-Scenes red kitchen, 200", "", ""),
    "tumvi_room1_fisheye_8": ("TUM-VI room1, 8 pairs", "", "ORB-SLAM3 9 (mean of rooms)"),
}  # fmt: skip


SAME_RIG = {"euroc_v101_keyframes": "euroc_mh01_start"}  # the first cannot judge its pair of cameras, the other can


def survey(path: Path, same_rig: Path | None = None) -> Row:
    """Every frame's pose after the adjustment of all, against the truth: after the best rigid alignment.

    same_rig: a recording by the same rig, whose map was published before in the same store.
    """
    with TemporaryDirectory() as scratch:
        report, out = Path(scratch) / "report.json", Path(scratch) / "out.tum"
        store = Path(scratch) / "store" if same_rig is None else robots_map(Path(scratch), same_rig, ":")
        to_store = ["--site", "surveyed", "--store", str(store)]
        files = ["--report", str(report), "--trajectory-out", str(out)]
        done = subprocess.run(
            [*tool("mapserver"), "build", str(path), *to_store, *files], capture_output=True, text=True, check=False
        )
        if done.returncode:
            return {"survey": done.stderr.strip().splitlines()[-1]}
        with open_recording(path) as recording:
            truth, frames = recording.ground_truth, len(recording)
        found = absolute_trajectory_error(read_tum(out), truth, frames=frames)
        rigid = json.loads(report.read_text())
        tiles = tiles_of(store, "surveyed")
    return tiles | {
        "frames": frames,
        "seconds": rigid["duration_s"],
        "evaluated_share": found.evaluated_share,
        "survey_mm": 1e3 * found.rmse_m,
        "survey_scaled_mm": 1e3 * rigid["ate_sim3_rmse_m"],
    }


def odometry(run: ReplayResult, truth: Trajectory) -> Row:
    """Each frame's pose as it was known then, in one frame that the first of them places; nothing is fitted."""
    chain = FrameChain()
    odom_from_body = np.array([chain.append(estimate.odometry) for estimate in run.estimates])
    stamps_ns = np.array([estimate.stamp_ns for estimate in run.estimates])
    mine, true = paired(at_first_stamp(Trajectory(stamps_ns, odom_from_body), truth), truth)
    errors = np.linalg.norm(mine.positions_m - true.positions_m, axis=1)
    path_m = float(np.linalg.norm(np.diff(true.positions_m, axis=0), axis=1).sum())
    return {
        "path_m": path_m,
        "odometry_mm": 1e3 * rms(errors),
        "odometry_share": float(errors[-1]) / path_m if path_m >= _SHORT_M else None,
        "odometry_errors_mm": (1e3 * errors).round(2).tolist(),
    }


def robots(run: ReplayResult) -> Row:
    """Frames that made no map, in the map of the others: as answered, unaligned."""
    errors = run_metrics.error_m(run.frames)
    return {
        "robot_frames": len(run.frames),
        "localised_share": run_metrics.localised_share_of_all(run.frames),
        "robot_median_mm": None if errors is None else 1e3 * errors["median"],
        "robot_max_mm": None if errors is None else 1e3 * errors["max"],
        "silent": run_metrics.silent_failures(run.frames),
    }


def robots_of_known_rig(path: Path, same_rig: Path) -> Row:
    """As `robots`, in a map by a rig that another recording, at another site of the same store, surveyed before."""
    with TemporaryDirectory() as scratch:
        store = Path(scratch) / "store"
        for site, recording, frames in (("rig", same_rig, ":"), (SITE, path, MAPPED)):
            mapped(store, recording, store.with_suffix(".json"), frames=frames, accepted=KNOWN_RIG, site=site)
        found = robots(played(path, store, UNSEEN))
    return {f"robot_of_known_rig_{name}": found[key] for name, key in _OF_KNOWN_RIG.items()}


def case(name: str) -> Row:
    """All of one recording; what cannot be measured is left out, and said."""
    path, shown = DATA / name, dict(zip(("recording", "peers", "published"), PEERS[name], strict=True))
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: the public recordings are not there; without them this study shows nothing")
    row = shown | survey(path)
    if "survey_mm" not in row:
        return row
    if (same := SAME_RIG.get(name)) is not None:
        row["survey_of_known_rig_mm"] = survey(path, DATA / same)["survey_mm"]
        row |= robots_of_known_rig(path, DATA / same)
    with TemporaryDirectory() as scratch:
        try:
            store = robots_map(Path(scratch), path)
        except subprocess.CalledProcessError as error:
            return row | {"map": f"no map of the even frames: status {error.returncode}"}
        with open_recording(path) as recording:
            truth = recording.ground_truth
        run = played(path, store, UNSEEN)
        return row | odometry(played(path, store), truth) | robots(run) | {"robot": hashed(run.estimates)["estimates"]}


CASES: dict[str, Callable[[], Row]] = {name: partial(case, name) for name in PEERS}
COLUMNS = [
    Column("recording", "recording"), Column("survey_mm", "survey, aligned", "{:.1f}"),
    Column("survey_of_known_rig_mm", "survey, rig known", "{:.1f}"), Column("peers", "others, same frames"),
    Column("odometry_mm", "as it drives, not aligned", "{:.0f}"),
    Column("odometry_share", "its end, of the path", "{:.2%}"), Column("robot_median_mm", "robot in the map, not aligned", "{:.1f}"),
    Column("robot_of_known_rig_median_mm", "robot, rig known", "{:.1f}"),
    Column("localised_share", "localised", "{:.0%}"), Column("silent", "silent failures"), Column("published", "published, whole sequence"),
]  # fmt: skip


def draw(rows: list[Row]) -> Figure:
    """Three lengths of each recording, and what others reach on the same frames."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots()
    kinds = {"survey_mm": "survey, aligned", "robot_median_mm": "robot in the map", "odometry_mm": "as it drives"}
    for number, (key, label) in enumerate(kinds.items()):
        axes.bar(
            [k + 0.26 * (number - 1) for k in range(len(rows))], [row.get(key) or 0 for row in rows], 0.24, label=label
        )
    axes.set_yscale("log")
    axes.set_ylabel("error, mm")
    axes.set_xticks(range(len(rows)), [row["recording"].replace(", ", "\n") for row in rows], fontsize=8)
    axes.legend(frameon=False, fontsize=8)
    return figure


@study
def main() -> None:
    """Rows and picture of docs/studies/public_sequences.md and the table of docs/comparison.md. `--out FILE`: rows as JSON, no page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    if (out := parser.parse_args().out) is not None:
        out.write_text(json.dumps({name: make() for name, make in CASES.items()}))
        return
    rows = results("public_sequences", CASES)
    shown = table(rows, COLUMNS)
    publish("public_sequences", [shown], draw(rows))
    COMPARISON.write_text(between_marks(COMPARISON.read_text(), shown, COMPARISON))
