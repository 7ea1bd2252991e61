"""What the back end of a survey costs as its site grows: the fulfilment centre without pictures, its first so many keyframes.

CPU seconds and peak memory by stage and keyframes, the slopes of their growth (log-log fits), the error against the truth, and loops
that are wrong. Everything after the odometry is the survey's own; sub-pixel alignment is drawn (see `common/simulated_survey.py`), so
that its cost, which goes with the observations, is not in the figures. Each size runs in a process of its own.

    PYTHONPATH=tests python tests/benchmarks/back_end/bench_site.py [--keyframes 250,1000] [--frames N]
        [--drive FILE] [--out FILE.json]
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
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

from benchmarks.common.simulated_survey import SimulatedSurvey, drawn_alignment, session_of, simulated_survey
from fleetmap.bow.shipped_vocabulary import default_vocabulary
from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.samples import SensorSet, Trajectory
from fleetsim.scene.layout import Layout
from mapserver.config import survey_settings
from mapserver.drafting.mapped_images import MappedImageStore
from mapserver.drafting.worker import open_executor
from mapserver.evaluation.trajectory_error import absolute_trajectory_error
from mapserver.survey.stages import survey_from
from mapserver.survey.state import ImageStore, MemoryImageStore
from mapserver.survey.survey_inputs import SurveyConfig, SurveyTools

SETTINGS = survey_settings(None, SensorSet.STEREO_INERTIAL)
_WRONG_M = 0.5 * Layout.bay_m  # half of the smallest step by which the site repeats


class Stages:
    """CPU and peak memory by stage, said on standard error as each ends."""

    def __init__(self) -> None:
        self.cpu_s: dict[str, float] = {}
        self.peak_mb: dict[str, float] = {}
        self._last, self._since_s = "start", time.process_time()

    def __call__(self, stage: str, done: int, total: int) -> None:
        if stage == self._last:
            return
        last, now_s = self._last, time.process_time()
        self.cpu_s[last] = round(self.cpu_s.get(last, 0.0) + now_s - self._since_s, 2)
        self.peak_mb[last] = round(max(self.peak_mb.get(last, 0.0), _peak_mb()))
        print(f"{last}: {self.cpu_s[last]} s of CPU, peak {self.peak_mb[last]} MB", file=sys.stderr, flush=True)
        self._last, self._since_s = stage, now_s
        Path("/proc/self/clear_refs").write_text("5")  # the peak from now on


def measure(drive: Path, keyframes: int) -> dict[str, Any]:
    """One survey's figures."""
    with MappedImageStore(drive.parent) as store:
        survey = SimulatedSurvey.read(drive, keyframes, store)
        return _measure(survey, store)


def _measure(survey: SimulatedSurvey, store: ImageStore) -> dict[str, Any]:
    stages, before_mb = Stages(), _peak_mb()
    begun_s = time.process_time()
    options = SurveyConfig(SETTINGS, default_vocabulary())
    with drawn_alignment(survey), open_executor(1, None) as executor:
        made = survey_from(survey.odometry, survey.inputs, options, SurveyTools(stages, store, executor))
    stages("end", 0, 0)
    count = len(survey.odometry.keyframes)
    truth = survey.map_from_body[[k.frame_index for k in made.odometry.keyframes]]
    cpu_s = time.process_time() - begun_s
    return {
        "keyframes": count,
        "frames": len(survey.odometry.estimates),
        "driving_s": 1e-9 * (survey.odometry.estimates[-1].stamp_ns - survey.odometry.estimates[0].stamp_ns),
        "path_m": float(np.linalg.norm(np.diff(survey.map_from_body[:, :3, 3], axis=0), axis=1).sum()),
        "cpu_s": cpu_s,
        "cpu_ms_per_keyframe": 1e3 * cpu_s / count,
        "stages_s": stages.cpu_s,
        "stages_mb": stages.peak_mb,
        "peak_mb": max(stages.peak_mb.values()),
        "input_mb": before_mb,
        "observations": len(made.state.landmarks.obs_keyframe),
        "loops": len(made.loops.edges),
        "wrong_loops": wrong_loops(made.loops.edges, survey),
        "kept": len(made.odometry.keyframes),
        "ate_m": ate_m(made.state.map_from_body, truth),
        "odometry_ate_m": ate_m(survey.odometry.odom_from_body, survey.map_from_body),
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
    """Prints one line of JSON for each size, then the slopes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keyframes", default="250,1000", help="sizes, comma separated")
    parser.add_argument("--frames", type=int, default=None, help="at most so many frames of it, at 7.5 Hz")
    parser.add_argument("--drive", type=Path, default=Path("out/site.drive"), help="as simulated; made where missing")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--one", type=int, default=None, help=argparse.SUPPRESS)
    parser.add_argument("--cut", type=Path, default=None, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.cut is not None:
        SimulatedSurvey.read(given.drive, given.one, MemoryImageStore()).write(given.cut)
        return
    if given.one is not None:
        print(json.dumps(measure(given.drive, given.one)), flush=True)
        return
    if not given.drive.exists():
        given.drive.parent.mkdir(parents=True, exist_ok=True)
        simulated_survey(session_of("fulfilment-centre", ["survey"], frames=given.frames), SETTINGS).write(given.drive)
    rows = []
    for row in measured(sorted(int(size) for size in given.keyframes.split(",")), given.drive):
        rows.append(row)
        print(json.dumps(row), flush=True)
    slopes = {}
    if len(rows) > 1:
        slopes = {"cpu": slope(rows, "cpu_s"), "memory": slope(rows, "peak_mb")}
        print(json.dumps(slopes))
    if given.out is not None:
        given.out.write_text(json.dumps({"sizes": rows, "slopes": slopes}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
