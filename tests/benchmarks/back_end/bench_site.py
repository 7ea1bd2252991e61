"""What the back end of a survey costs as its site grows: the fulfilment centre without pictures, its first so many keyframes.

CPU seconds and peak memory by keyframes, the slopes of their growth (log-log fits), the error against the truth, and loops
that are wrong. Everything after the odometry is the survey's own; sub-pixel alignment is drawn (see `common/simulated_survey.py`), so
that its cost, which goes with the observations, is not in the figures. Each size runs in a process of its own.

    PYTHONPATH=tests python -m benchmarks.back_end.bench_site [--keyframes 250,1000] [--frames N]
        [--drive FILE] [--out FILE.json]
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.common.recorded_runs import write_results
from benchmarks.common.simulated_survey import SimulatedSurvey, drawn_alignment, session_of, simulated_survey
from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.samples import SensorSet, Trajectory
from fleetsim.scene.layout import Layout
from mapserver.config import survey_settings
from mapserver.drafting.mapped_images import MappedImageStore
from mapserver.drafting.worker import open_executor
from mapserver.evaluation.trajectory_error import absolute_trajectory_error
from mapserver.survey.state import ImageStore
from mapserver.survey.survey_inputs import SurveyTools

SETTINGS = survey_settings(None, SensorSet.STEREO_INERTIAL)
_WRONG_M = 0.5 * Layout.bay_m  # half of the smallest step by which the site repeats


def measure(drive: Path, keyframes: int) -> dict[str, Any]:
    """One survey's figures."""
    with MappedImageStore(drive.parent) as store, open_executor(1, None) as executor:
        survey = SimulatedSurvey.read(drive, keyframes, store)
        Path("/proc/self/clear_refs").write_text("5")  # the peak from now on
        begun_s = time.process_time()
        with drawn_alignment(survey):
            made = survey.surveyed(SETTINGS, SurveyTools(images=store, executor=executor))
        cpu_s, peak_mb = time.process_time() - begun_s, _peak_mb()
    truth = survey.map_from_body[[k.frame_index for k in made.odometry.keyframes]]
    return {
        "keyframes": len(survey.odometry.keyframes),
        "cpu_s": cpu_s,
        "peak_mb": peak_mb,
        "loops": len(made.loops.edges),
        "wrong_loops": wrong_loops(made.loops.edges, survey),
        "ate_m": ate_m(made.state.map_from_body, truth),
    }


def ate_m(map_from_body: Array, truth: Array) -> float:
    """Root mean square of position errors after rigid alignment."""
    stamps = np.arange(len(truth), dtype=np.int64)
    return absolute_trajectory_error(Trajectory(stamps, map_from_body), Trajectory(stamps, truth)).rmse_m


def wrong_loops(edges: Any, survey: SimulatedSurvey) -> int:
    """How many accepted loops join what the truth says is elsewhere."""
    frames, wrong = [k.frame_index for k in survey.odometry.keyframes], 0
    for edge in edges:
        true = se3_inverse(survey.map_from_body[frames[edge.i]]) @ survey.map_from_body[frames[edge.j]]
        off = se3_inverse(true) @ edge.i_from_j
        wrong += int(np.linalg.norm(off[:3, 3]) > _WRONG_M)
    return wrong


def measured(sizes: Sequence[int], drive: Path) -> Iterator[dict[str, Any]]:
    """The figures of each size, in a process of its own whose memory has held no more than its part of the drive."""
    for size in sizes:
        with TemporaryDirectory(dir=drive.parent) as folder:
            part = Path(folder) / "part.drive"
            command = [sys.executable, __file__, "--one", str(size), "--drive"]
            subprocess.run([*command, str(drive), "--cut", str(part)], check=True)
            done = subprocess.run([*command, str(part)], check=True, stdout=subprocess.PIPE, text=True)
        yield json.loads(done.stdout.splitlines()[-1])


def slope(rows: list[dict[str, Any]], key: str) -> float:
    """Of the log-log fit over the keyframes."""
    return float(np.polyfit(np.log([r["keyframes"] for r in rows]), np.log([r[key] for r in rows]), 1)[0])


def _peak_mb() -> float:
    status = Path("/proc/self/status").read_text()
    return float(status.split("VmHWM:")[1].split()[0]) / 1024


def main() -> None:
    """Print the figures; write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keyframes", default="250,1000", help="sizes, comma separated")
    parser.add_argument("--frames", type=int, default=None, help="at most so many frames of it, at 7.5 Hz")
    parser.add_argument("--drive", type=Path, default=Path("out/site.drive"), help="as simulated; made where missing")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--one", type=int, default=None, help=argparse.SUPPRESS)
    parser.add_argument("--cut", type=Path, default=None, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.cut is not None:
        SimulatedSurvey.read(given.drive, given.one, ImageStore()).write(given.cut)
        return
    if given.one is not None:
        print(json.dumps(measure(given.drive, given.one)), flush=True)
        return
    if not given.drive.exists():
        given.drive.parent.mkdir(parents=True, exist_ok=True)
        simulated_survey(session_of("fulfilment-centre", ["survey"], frames=given.frames), SETTINGS).write(given.drive)
    rows = list(measured(sorted(int(size) for size in given.keyframes.split(",")), given.drive))
    slopes = {"cpu": slope(rows, "cpu_s"), "memory": slope(rows, "peak_mb")}
    write_results(given.out, {"sizes": rows, "slopes": slopes})


if __name__ == "__main__":
    main()
