"""Surveys of all recordings beside the figures of the field, with one configuration for each sensor set.

`PYTHONPATH=tests python tests/benchmarks/survey/bench_survey.py [NAME...] [--out FILE.json]`
prints a table and JSON. The real recordings come from the data folder,
simulated ones are recorded on the way (some minutes; `--recordings DIR` keeps them there and takes them from there).
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from fleetmap.recordings import open_recording
from fleetmap.recordings.tum import read_tum
from mapserver.evaluation.trajectory_error import best_clock_shift
from support.recordings.realdata import DATA

REPOSITORY = Path(__file__).resolve().parents[3]
SOURCES = os.pathsep.join(str(REPOSITORY / folder) for folder in ("shared", ""))
LIBRARIES = ("numpy", "opencv-python-headless", "gtsam", "scipy")


@dataclass(frozen=True, slots=True)
class Case:
    """A recording, and what other systems reach on it."""

    name: str
    field: str


CASES = (
    Case("euroc_mh01_start", "ORB-SLAM3 4.2 mm, stella_vslam 4.6 mm"),
    Case("euroc_v101_keyframes", "COLMAP 13.5 mm with free scale; ORB-SLAM3 loses track"),
    Case("kitti_stereo_51", "ORB-SLAM3 42 mm, stella_vslam 99 mm"),
    Case("7scenes_redkitchen_200", ""),
    Case("five-aisles", "ORB-SLAM3 24 mm, stella_vslam 47 mm"),
    Case("small-loop", ""),
)
SIMULATED = "five-aisles", "small-loop"
KEYS = (
    "ate_rmse_m",
    "ate_max_m",
    "ate_sim3_rmse_m",
    "scale_error",
    "evaluated_share",
    "realtime_factor",
    "peak_rss_mb",
)


def run(module: str, *arguments: str | Path) -> None:
    command = [sys.executable, "-c", f"from {module} import main; main()", *map(str, arguments)]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": SOURCES}, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[2:])}: {done.stderr[-2000:]}")


def recording_of(case: Case, folder: Path) -> Path | None:
    """The real recording, or the simulated one, made where it is not there yet; None where the data folder is missing."""
    if (DATA / case.name).is_dir():
        return DATA / case.name
    if case.name not in SIMULATED:
        return None
    path = folder / f"{case.name}.mcap"
    if not path.exists():
        run("fleetsim.cli", "record", case.name, "--seed", "1", "--out", path)
    return path


def survey(case: Case, recording: Path, folder: Path) -> dict[str, Any]:
    """The build's report."""
    report = folder / f"{case.name}.json"
    run(
        "mapserver.cli", "build", recording, "--site", case.name, "--store", folder / "store", "--report", report,
        "--trajectory-out", folder / f"{case.name}.tum",
    )  # fmt: skip
    found: dict[str, Any] = json.loads(report.read_text("utf-8"))
    with open_recording(recording) as opened:
        truth = opened.ground_truth
    shift = None if truth is None else best_clock_shift(read_tum(folder / f"{case.name}.tum"), truth)
    return found | {"clock_shift": None if shift is None else dict(zip(("shift_s", "rmse_m"), shift, strict=True))}


def bench(names: list[str], recordings: Path | None = None) -> list[dict[str, Any]]:
    """One row for each case that can be run."""
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for case in CASES:
            recording = recording_of(case, recordings or folder) if not names or case.name in names else None
            if recording is None:
                continue
            report = survey(case, recording, folder)
            rows.append(
                asdict(case)
                | {key: report[key] for key in (*KEYS, "clock_shift", "loops", "frames", "duration_s", "seconds")}
            )
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Table and JSON."""
    columns = "ATE mm", "worst", "Sim(3)", "scale %"
    print(f"{'recording':24}{''.join(f'{c:>9}' for c in columns)} {'share':>6} {'x time':>7} {'MB':>6}  the field")
    for row in rows:
        lengths = (1e3 * row[key] for key in ("ate_rmse_m", "ate_max_m", "ate_sim3_rmse_m"))
        print(
            f"{row['name']:24}{''.join(f'{mm:9.2f}' for mm in lengths)} {100 * row['scale_error']:+8.3f} "
            f"{row['evaluated_share']:6.2f} {row['realtime_factor']:7.2f} {row['peak_rss_mb']:6.0f}  {row['field']}"
        )
    for row in rows:
        if row["clock_shift"] is not None:
            shift_ms, left_mm = (1e3 * row["clock_shift"][key] for key in ("shift_s", "rmse_m"))
            print(f"{row['name']}: with the truth's clock shifted by {shift_ms:+.1f} ms {left_mm:.2f} mm would be left")
    machine = {
        "machine": platform.processor() or platform.machine(), "cores": os.cpu_count(), "python": platform.python_version(),
        "versions": {name: metadata.version(name) for name in LIBRARIES}, "command": " ".join(sys.argv),
    }  # fmt: skip
    print(json.dumps(machine | {"surveys": rows}))


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[[], *(case.name for case in CASES)])
    parser.add_argument("--recordings", type=Path)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    rows = bench(given.names, given.recordings)
    show(rows)
    if given.out is not None:
        given.out.write_text(json.dumps({row["name"]: row for row in rows}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
