"""Calibration faults in recordings: the smallest that the doctor finds, what a build makes of them, and how often good ones are doubted.

`PYTHONPATH=tests python tests/benchmarks/survey/bench_calibration_faults.py RECORDING [--seconds 20] [--faults NAME...] [--good 10]
[--out FILE.json]`

Each fault is put into the calibration (or the images) of one stretch of the recording, the busiest; --good measures so many stretches as
they are, evenly spread. A fault is found where a check about the calibration warns or fails. `passes` means that a map would be published
without a word; what the calibration is off by then, and after a correction, is given as what it costs: 3 cm at each limit of
`mapserver.doctor.calibration`, in proportion.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import se3_inverse, so3_log
from fleetmap.recordings import Recording, open_recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from mapserver.build.admission import DECISIVE, CheckedRecording, checked
from mapserver.calibration import CalibrationParameter
from mapserver.calibration.recordings import busiest_frames
from mapserver.doctor import Verdict
from mapserver.doctor.calibration import TOLERANCES
from support.recordings.calibration_faults import IMAGE_FAULTS, another_robots_file, standard_faults, unlike_robot
from support.recordings.spoiled_recording import part

P = CalibrationParameter
LIMIT_CM = 3.0
FALSE_ALARMS = 0.01


@dataclass(frozen=True, slots=True)
class Row:
    """One recording with one fault: what warned or failed, what the build does, and the cost in cm before and after that."""

    recording: str
    fault: str
    found_by: list[str]
    build: str
    cost_cm: float
    cost_after_cm: float
    seconds: float

    @property
    def is_silent(self) -> bool:
        """Whether more than 3 cm would go out without a word."""
        return self.build in ("passes", "corrected") and self.cost_after_cm > LIMIT_CM


def cost_cm(rig: RigCalibration, true: RigCalibration) -> float:
    """The dearest error of `rig`: 3 cm at each limit, in proportion."""
    off = dict.fromkeys(P, 0.0)
    left, true_left = rig.cameras[0], true.cameras[0]
    focal_px = float(true_left.intrinsics_px[0])
    off[P.FOCAL] = float(left.intrinsics_px[0] / true_left.intrinsics_px[0] - 1)
    off[P.PRINCIPAL_X], off[P.PRINCIPAL_Y] = (left.intrinsics_px - true_left.intrinsics_px)[2:].tolist()
    off[P.TIME_OFFSET] = left.imu_minus_cam_s - true_left.imu_minus_cam_s
    turn = so3_log(Rectifier(rig).body_from_cam[:3, :3].T @ Rectifier(true).body_from_cam[:3, :3])
    if true.imu is not None:  # a principal point that moved with it looks the same way
        net = turn * [1, 1, 1] + np.array([-off[P.PRINCIPAL_Y], off[P.PRINCIPAL_X], 0]) / focal_px
        off[P.CAMERA_IMU_X], off[P.CAMERA_IMU_Y], off[P.CAMERA_IMU_Z] = np.minimum(np.abs(turn), np.abs(net)).tolist()
    if len(rig.cameras) > 1:
        right, true_right = rig.cameras[1], true.cameras[1]
        ratio = right.intrinsics_px[0] / left.intrinsics_px[0]
        off[P.FOCAL_RATIO] = float(ratio / (true_right.intrinsics_px[0] / true_left.intrinsics_px[0]) - 1)
        pairs = [se3_inverse(r.cameras[0].body_from_cam) @ r.cameras[1].body_from_cam for r in (rig, true)]
        lengths = [float(np.linalg.norm(pair[:3, 3])) for pair in pairs]
        off[P.BASELINE] = lengths[0] / lengths[1] - 1
        off[P.PAIR_PITCH], off[P.PAIR_YAW], off[P.PAIR_ROLL] = so3_log(pairs[0][:3, :3] @ pairs[1][:3, :3].T).tolist()
    return LIMIT_CM * max(abs(value) / TOLERANCES[p].warn_above for p, value in off.items() if np.isfinite(value))


def measured(name: str, fault: str, recording: Recording, true: RigCalibration) -> Row:
    """The doctor's findings, and what a build would do."""
    started = time.monotonic()
    before = float("inf") if fault in IMAGE_FAULTS else cost_cm(recording.calibration, true)
    try:
        found = checked(recording)
    except RecordingError as error:
        names = [str(error).removeprefix(f"{recording.path}: ").split(":")[0]]
        return Row(name, fault, names, "refused", before, 0.0, round(time.monotonic() - started, 1))
    loud = [
        f.name for f in found.findings if f.verdict in (Verdict.WARN, Verdict.FAIL) and _is_about_calibration(f.name)
    ]
    after = before if fault in IMAGE_FAULTS else cost_cm(found.rig, true)
    return Row(name, fault, loud, _decision(found), before, after, round(time.monotonic() - started, 1))


def _is_about_calibration(name: str) -> bool:
    return name in DECISIVE or name == "camera-imu time offset"


def _decision(found: CheckedRecording) -> str:
    """In the order of the gate: doubts and, for a first map, what nothing judged wait for a person."""
    if found.calibration.doubted:
        return "held: " + ", ".join(found.calibration.doubted)
    if found.calibration.unknown():
        return "held, not judged: " + ", ".join(found.calibration.unknown())
    return "corrected" if found.corrections else "passes"


def cases(good: Recording) -> Iterator[tuple[str, Callable[[Recording], Recording]]]:
    """Every fault that applies to the recording's sensors."""
    for fault in standard_faults():
        if fault.applies_to(good):
            yield fault.name, fault.recording
    if len(good.calibration.cameras) > 1:
        for seed in (1, 2):
            yield f"another robot's file {seed}", another_robots_file(unlike_robot(good.calibration, seed)).recording
        for image_fault in IMAGE_FAULTS.values():
            yield image_fault.name, image_fault.recording


def stretch(recording: Recording, start_s: float, seconds: float) -> Recording:
    """So many seconds of it, the IMU from a second before."""
    cut = part(recording, start_s, start_s + seconds)
    first, last = int(cut.frame_stamps_ns[0]), int(cut.frame_stamps_ns[-1])
    imu = recording.imu.between(first - 10**9, last + 2 * 10**8)
    wheel = tuple(w for w in recording.wheel if first - 10**9 <= w.stamp_ns <= last + 2 * 10**8)
    return replace(cut, imu=imu, wheel=wheel)


def busiest(recording: Recording, seconds: float) -> Recording:
    """The stretch of the recording that turns most."""
    first = recording.frame_stamps_ns[busiest_frames(recording)[0]]
    duration_s = float(recording.frame_stamps_ns[-1] - recording.frame_stamps_ns[0]) * 1e-9
    start_s = min(float(first - recording.frame_stamps_ns[0]) * 1e-9, max(duration_s - seconds, 0.0))
    return stretch(recording, start_s, seconds + 1e-3)


def bench(path: Path, seconds: float, names: Sequence[str] | None, good: int) -> list[Row]:
    """The faults with these words in their names (all for None, none for an empty list), then the good stretches."""
    rows = []
    with open_recording(path) as recording:
        base = busiest(recording, seconds)
        for name, spoil in cases(base):
            if names is None or any(word in name for word in names):
                rows.append(measured(path.name, name, spoil(base), base.calibration))
                show(rows[-1:])
        duration_s = float(recording.frame_stamps_ns[-1] - recording.frame_stamps_ns[0]) * 1e-9
        for start_s in np.linspace(0.0, max(duration_s - seconds, 0.0), good):
            one = stretch(recording, float(start_s), seconds + 1e-3)
            rows.append(measured(path.name, f"good from {start_s:.1f} s", one, recording.calibration))
            show(rows[-1:])
    return rows


def show(rows: Sequence[Row]) -> None:
    """One line each."""
    for row in rows:
        costs = f"{row.cost_cm:8.1f} cm {row.cost_after_cm:7.1f} cm"
        silent = " SILENT" if row.is_silent else ""
        print(
            f"{row.recording:28} {row.fault:26}{costs}  {row.build:34} {', '.join(row.found_by)} ({row.seconds:.0f} s){silent}",
            flush=True,
        )


def summary(rows: Sequence[Row]) -> dict[str, float]:
    """Counts: faults that cost more than 3 cm, those that go out silently, good stretches and those that were doubted or corrected."""
    faults = [row for row in rows if not row.fault.startswith("good")]
    good = [row for row in rows if row.fault.startswith("good")]
    alarms = [row for row in good if row.found_by]
    dear = [row for row in faults if row.cost_cm > LIMIT_CM]
    return {
        "dear": len(dear),
        "silent": sum(row.is_silent for row in faults),
        "good": len(good),
        "false_alarms": len(alarms),
    }


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--faults", nargs="*", default=None)
    parser.add_argument("--good", type=int, default=0)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    rows = [
        r for path in arguments.recordings for r in bench(path, arguments.seconds, arguments.faults, arguments.good)
    ]
    print(summary(rows))
    if arguments.out is not None:
        arguments.out.write_text(
            json.dumps({"rows": [asdict(row) for row in rows], "summary": summary(rows)}, indent=2)
        )


if __name__ == "__main__":
    main()
