"""Surveys of all recordings, with one configuration for each sensor set.

`PYTHONPATH=tests python tests/benchmarks/survey/bench_survey.py [--only NAME...] [--work FOLDER] [--out FILE.json]`.
The real recordings come from the data folder,
simulated ones are recorded into the work folder (some minutes).
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.common.recorded_runs import parsed, write_results
from support.recordings.realdata import DATA

REPOSITORY = Path(__file__).resolve().parents[3]
SOURCES = os.pathsep.join(str(REPOSITORY / folder) for folder in ("shared", ""))
SIMULATED = "five-aisles", "small-loop"
CASES = "euroc_mh01_start", "euroc_v101_keyframes", "kitti_stereo_51", "7scenes_redkitchen_200", *SIMULATED
KEYS = "ate_rmse_m", "ate_max_m", "evaluated_share"


def run(module: str, *arguments: str | Path) -> None:
    command = [sys.executable, "-c", f"from {module} import main; main()", *map(str, arguments)]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": SOURCES}, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[2:])}: {done.stderr[-2000:]}")


def recording_of(name: str, folder: Path) -> Path:
    """The real recording, or the simulated one, made where it is not there yet."""
    if name not in SIMULATED:
        return DATA / name
    path = folder / f"{name}.mcap"
    if not path.exists():
        run("fleetsim.cli", "record", name, "--seed", "1", "--out", path)
    return path


def survey(name: str, recording: Path) -> dict[str, Any]:
    """Figures of the build's report."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        store = Path(folder) / "store"
        run("mapserver.cli", "build", recording, "--site", name, "--store", store, "--report", report)
        found: dict[str, Any] = json.loads(report.read_text("utf-8"))
    return {key: found[key] for key in KEYS}


def main() -> None:
    """Print the figures; write them as JSON where asked."""
    given = parsed(__doc__, CASES)
    names = given.only or CASES
    write_results(given.out, {name: survey(name, recording_of(name, given.work)) for name in names})


if __name__ == "__main__":
    main()
