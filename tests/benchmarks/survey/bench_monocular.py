"""Surveys with one camera, with and without IMU, on recordings that have more; and 5 % of scale drift that a loop takes away.

`python tests/benchmarks/survey/bench_monocular.py [--data DIR] [--simulated FILE.mcap] [--only NAME] [--out FILE.json]` prints machine,
versions and the table; --simulated is a recording of `fleetsim record small-loop --robot survey`.
"""

import argparse
import json
import platform
import sys
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

import numpy as np

from fleetmap.bow.shipped_vocabulary import default_vocabulary
from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, se3, se3_exp, se3_inverse
from fleetmap.odometry import OdometryEstimate, OdometryStatus
from fleetmap.recordings import Recording, open_recording
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import SensorSet, Trajectory
from mapserver.build.report import accuracy
from mapserver.build.sensor_subset import reduced
from mapserver.config import survey_settings
from mapserver.evaluation.trajectory_error import absolute_trajectory_error
from mapserver.survey.keyframes.keyframes import make_keyframe
from mapserver.survey.odometry_pass import OdometryPass
from mapserver.survey.pipeline import Survey, survey, survey_from
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyConfig, SurveyInputs
from mapserver.survey.survey_map import SurveyMap

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
CASES = (
    ("euroc_mh01_start", SensorSet.MONO),
    ("euroc_mh01_start", SensorSet.MONO_INERTIAL),
    ("kitti_stereo_51", SensorSet.MONO),
    ("7scenes_redkitchen_200", SensorSet.MONO),
)
DRIFT, _EVERY, _PARTS = 0.05, 5, 10


@dataclass(frozen=True, slots=True)
class Row:
    """One survey. ATE in metres after a rigid and a similarity alignment, of the survey and of its odometry; scale_error: how much
    too large (0.01 is 1 %); scale_drift: how much it grows from start to end, before by odometry; scale_residual: how far tenths of
    the way are from that; refused: why there is no map.
    """

    recording: str
    sensors: str
    scale: str = ""
    ate_rigid_m: float | None = None
    ate_similarity_m: float | None = None
    odometry_similarity_m: float | None = None
    scale_error: float | None = None
    scale_drift_before: float | None = None
    scale_drift: float | None = None
    scale_residual: float | None = None
    evaluated_share: float | None = None
    loops: int = 0
    seconds: float = 0.0
    refused: str = ""


def scale_along(estimate: Trajectory, truth: Trajectory) -> tuple[float, float]:
    """How the scale goes by the way, by lengths of tenths of it against the truth's: drift from start to end, and largest residual.

    The drift is that of a straight line through the logarithms; the residual is what noise and bends leave of each tenth.
    """
    found = [truth.at(int(s)) for s in estimate.stamps_ns]
    known = [n for n, there in enumerate(found) if there is not None]
    mine = estimate.positions_m[known]
    true = np.array([there[:3, 3] for there in found if there is not None])
    apart_m = 0.02 * np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    chosen = [0]  # a fiftieth of the way apart, so that the noise of single frames adds no length
    for n in range(1, len(true)):
        if np.linalg.norm(true[n] - true[chosen[-1]]) > apart_m:
            chosen.append(n)
    steps = [np.linalg.norm(np.diff(way[chosen], axis=0), axis=1) for way in (mine, true)]
    edges = np.searchsorted(np.cumsum(steps[1]), np.linspace(0, steps[1].sum(), _PARTS + 1)[1:-1])
    sums = [np.array([part.sum() for part in np.split(way, edges)]) for way in steps]
    logs = np.log(sums[0] / sums[1])
    middles = (np.arange(_PARTS) + 0.5) / _PARTS
    slope, offset = np.polyfit(middles, logs, 1)
    return float(slope), float(np.abs(logs - offset - slope * middles).max())


def judged(name: str, sensors: str, recording: Recording, done: Survey, seconds: float) -> Row:
    """The row of a finished survey."""
    guess, truth = done.odometry, recording.ground_truth
    assert truth is not None
    found = accuracy(done.map, truth)
    assert found.rigid is not None
    assert found.similarity is not None
    before = Trajectory(done.map.trajectory.stamps_ns[guess.tracked], guess.odom_from_body[guess.tracked])
    return Row(
        name, sensors, "metric" if done.map.scale_known else "unknown", found.rigid.rmse_m, found.similarity.rmse_m,
        absolute_trajectory_error(before, truth, with_scale=True).rmse_m, 1 / found.similarity.scale - 1,
        scale_along(before, truth)[0], *scale_along(_tied(done.map), truth), found.evaluated_share,
        done.loops.counts()["accepted"], seconds,
    )  # fmt: skip


def _tied(survey_map: SurveyMap) -> Trajectory:
    chosen = survey_map.trajectory_estimated
    return Trajectory(survey_map.trajectory.stamps_ns[chosen], survey_map.trajectory.frame_from_body[chosen])


def one(path: Path, use: SensorSet) -> Row:
    """A whole survey with the sensors of `use`."""
    began_s = time.perf_counter()
    with open_recording(path) as opened:
        recording = reduced(opened, use)
        settings, rectifier = survey_settings(None, use), Rectifier(recording.calibration)
        frames = (recording.read_frame(k) for k in range(len(recording)))
        try:
            inputs = SurveyInputs(frames, len(recording), recording.imu, recording.calibration, rectifier)
            done = survey(inputs, SurveyConfig(settings, default_vocabulary()))
        except SurveyError as error:
            return Row(path.stem, use.value, refused=str(error), seconds=time.perf_counter() - began_s)
        return judged(path.stem, use.value, recording, done, time.perf_counter() - began_s)


def drifting(path: Path, drift: float, seed: int = 0) -> Row:
    """A survey by one camera whose first guess is the truth with noise and with a scale that grows by `drift` along the way."""
    began_s = time.perf_counter()
    with open_recording(path) as opened:
        recording = reduced(opened, SensorSet.MONO)
        settings, rectifier = survey_settings(None, SensorSet.MONO), Rectifier(recording.calibration)
        guess = drifting_guess(recording, rectifier, settings, drift, np.random.default_rng(seed))
        inputs = SurveyInputs((), len(recording), recording.imu, recording.calibration, rectifier)
        done = survey_from(guess, inputs, SurveyConfig(settings, default_vocabulary()))
        return judged(path.stem, f"mono, {drift:.0%} drift injected", recording, done, time.perf_counter() - began_s)


def drifting_guess(
    recording: Recording, rectifier: Rectifier, settings: SurveySettings, drift: float, rng: np.random.Generator
) -> OdometryPass:
    """What one camera's odometry might say: every fifth frame a keyframe, noise of 0.5 % of each step, and the drift."""
    truth = recording.ground_truth
    assert truth is not None
    numbers = [k for k, stamp in enumerate(recording.frame_stamps_ns.tolist()) if truth.at(stamp) is not None]
    true = np.array([truth.at(int(recording.frame_stamps_ns[k])) for k in numbers])
    scale = np.exp(np.log1p(drift) * np.arange(len(numbers)) / (len(numbers) - 1))
    placed, spread = [se3(true[0, :3, :3], np.zeros(3))], [1e-8 * np.eye(6)]
    for k in range(len(numbers) - 1):
        step: Array = se3_inverse(true[k]) @ true[k + 1]
        length = float(np.linalg.norm(step[:3, 3]))
        step[:3, 3] *= scale[k]
        noise = np.concatenate([1e-4 * rng.normal(size=3), 0.005 * length * rng.normal(size=3)])
        placed.append(placed[-1] @ step @ se3_exp(noise))
        spread.append(spread[-1] + np.diag([1e-7] * 3 + [(0.03 * length) ** 2 + 1e-9] * 3))
    nothing = np.zeros(3)
    estimates = [
        OdometryEstimate(
            int(recording.frame_stamps_ns[number]), n, placed[n], spread[n], nothing, nothing, nothing, OdometryStatus.TRACKING,
            np.zeros(0, np.int64), 5.0, 1.0, False, False, None, False,
        )
        for n, number in enumerate(numbers)
    ]  # fmt: skip
    keyframes = [
        make_keyframe(rectifier.rectify(recording.read_frame(numbers[n])), n, rectifier.camera, settings)
        for n in range(0, len(numbers), _EVERY)
    ]
    return OdometryPass(
        estimates, np.array(placed), np.array(spread), np.ones(len(numbers), bool), keyframes, False, False
    )


def machine() -> dict[str, str]:
    """Where and with what this ran."""
    libraries = ("numpy", "numba", "opencv-python-headless", "gtsam", "scipy")
    return {
        "machine": platform.processor() or platform.machine(),
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in libraries},
        "command": " ".join(["python", *sys.argv]),
    }


def show(rows: Iterable[Row]) -> None:
    """The table."""
    print(
        f"{'recording':24s} {'sensors':26s} {'scale':8s} {'rigid m':>8s} {'sim3 m':>8s} {'odom m':>8s} {'scale err':>9s} drift %"
    )
    for r in rows:
        if r.refused:
            print(f"{r.recording:24s} {r.sensors:26s} refused: {r.refused}")
            continue
        drift = [100 * (share or 0.0) for share in (r.scale_drift_before, r.scale_drift, r.scale_residual)]
        print(
            f"{r.recording:24s} {r.sensors:26s} {r.scale:8s} {r.ate_rigid_m:8.4f} {r.ate_similarity_m:8.4f} "
            f"{r.odometry_similarity_m:8.4f} {r.scale_error:+9.4f} {drift[0]:+5.2f} -> {drift[1]:+5.2f} (residual {drift[2]:.2f})  "
            f"share {r.evaluated_share:.3f}  {r.loops} loops  {r.seconds:.0f} s"
        )


def main() -> None:
    """All cases for which there is data."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--simulated", type=Path)
    parser.add_argument("--only", default="")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    cases = [(given.data / name, use) for name, use in CASES if (given.data / name).exists()]
    if given.simulated is not None:
        cases += [(given.simulated, SensorSet.MONO_INERTIAL), (given.simulated, SensorSet.MONO)]
    rows = [one(path, use) for path, use in cases if given.only in f"{path.stem} {use}"]
    if given.simulated is not None and given.only in "drift":
        rows.append(drifting(given.simulated, DRIFT))
    show(rows)
    result = {"machine": machine(), "rows": [asdict(row) for row in rows]}
    print(json.dumps(result["machine"]))
    if given.out is not None:
        given.out.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
