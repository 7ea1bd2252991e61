"""What the back end of a survey costs as its site grows: the fulfilment centre without pictures, its first so many keyframes.

CPU seconds and peak memory by keyframes, the slopes of their growth (log-log fits), the error against the truth, and loops that are wrong.
Everything after the odometry is the survey's own; sub-pixel alignment is drawn (see `common/simulated_survey.py`), so that its cost, which
goes with the observations, is not in the figures. Each size runs in a process of its own.

The drive, of at most `--frames` frames at 7.5 Hz, stays in the work folder.
"""

import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.common.recorded_runs import Options, Results, benchmark
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
        cpu_s, status = time.process_time() - begun_s, Path("/proc/self/status").read_text()
    truth = survey.map_from_body[[k.frame_index for k in made.odometry.keyframes]]
    return {
        "keyframes": len(survey.odometry.keyframes),
        "cpu_s": cpu_s,
        "peak_mb": float(status.split("VmHWM:")[1].split()[0]) / 1024,
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


def cut(drive: Path, keyframes: int, part: Path) -> None:
    """Writes the drive up to a keyframe."""
    SimulatedSurvey.read(drive, keyframes, ImageStore()).write(part)


def measured(size: int, drive: Path) -> dict[str, Any]:
    """The figures of a size, in a process of its own whose memory has held no more than its part of the drive."""
    alone = partial(ProcessPoolExecutor, 1, get_context("spawn"))
    with TemporaryDirectory(dir=drive.parent) as folder:
        part = Path(folder) / "part.drive"
        with alone() as process:
            process.submit(cut, drive, size, part).result()
        with alone() as process:
            return process.submit(measure, part, size).result()


def slope(rows: list[dict[str, Any]], key: str) -> float:
    """Of the log-log fit over the keyframes."""
    return float(np.polyfit(np.log([r["keyframes"] for r in rows]), np.log([r[key] for r in rows]), 1)[0])


@benchmark(several="keyframes", frames=12_600)
def main(options: Options) -> Results:
    drive = options.work / f"site-{options.frames}.drive"
    if not drive.exists():
        simulated_survey(session_of("fulfilment-centre", ["survey"], frames=options.frames), SETTINGS).write(drive)
    rows = [measured(size, drive) for size in sorted(map(int, options.keyframes))]
    return {"sizes": rows, "slopes": {"cpu": slope(rows, "cpu_s"), "memory": slope(rows, "peak_mb")}}
