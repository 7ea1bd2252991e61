"""How well a rig's calibration is found, and whether its covariance is right.

`PYTHONPATH=tests python tests/benchmarks/survey/bench_calibration.py drives [--seed 300] [--count 12] [--draws 3]`:
simulated drives without pictures, each
under calibrations that are off at random. `... recordings RECORDING... [--focal 0.05 --baseline -0.05]`: recordings whose own
calibration is the truth, spoiled by that much. `... good [--seed 400] [--count 90]`: what the doctor says of right calibrations, half a
minute of each drive. `... faults [--seed 500] [--count 10]`: every fault in each of so many drives, through the doctor and a build's
decision; `--images-only` leaves out IMU and wheels.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fleetmap.geometry import Array, se3_inverse, so3_log
from fleetmap.recordings import open_recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetsim.recorder import Order
from mapserver.calibration import CalibrationParameter, estimate_calibration, estimate_from
from mapserver.calibration.parameters import COLUMNS, INDEX
from mapserver.calibration.recordings import LONGEST_S
from mapserver.config import survey_settings
from mapserver.doctor import Verdict
from mapserver.doctor.calibration import TOLERANCES, MeasuredCalibration, corrected, findings_of
from mapserver.drafting.admission import rig_evidence
from support.recordings.calibration_faults import standard_faults
from support.worlds.calibration_scene import Stretch, make_stretch, measured, true_corrections, with_errors

P = CalibrationParameter
SCENARIOS = ("small-loop", "busy", "identical-aisles")
JUDGED_SCENARIOS = ("small-loop", "busy", "identical-aisles", "five-aisles", "marked-ends")
LIMIT_CM = 3.0
LOUD = (Verdict.WARN, Verdict.FAIL)
DURATION_S = 60.0
# Sigmas of the random errors that calibrations are given.
ERRORS = {
    P.BASELINE: 0.02, P.FOCAL: 0.01, P.FOCAL_RATIO: 0.003, P.PRINCIPAL_X: 3.0, P.PRINCIPAL_Y: 3.0, P.PAIR_PITCH: 0.002,
    P.PAIR_YAW: 0.002, P.PAIR_ROLL: 0.002, P.BASELINE_Y: 0.003, P.BASELINE_Z: 0.003, P.CAMERA_IMU_X: 0.01, P.CAMERA_IMU_Y: 0.01,
    P.CAMERA_IMU_Z: 0.01, P.CAMERA_POSITION_X: 0.01, P.CAMERA_POSITION_Y: 0.01, P.CAMERA_POSITION_Z: 0.01, P.TIME_OFFSET: 0.005,
}  # fmt: skip
WRONG = {"focal": P.FOCAL, "baseline": P.BASELINE, "yaw": P.PAIR_YAW, "delay": P.TIME_OFFSET}
NAMED = (P.FOCAL, P.BASELINE, P.TIME_OFFSET, P.PAIR_YAW, P.PAIR_PITCH, P.CAMERA_IMU_Y)


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


def drives(first_seed: int, count: int, draws: int) -> dict[str, Any]:
    """ANEES over what was judged, and errors of the parameters with a target. The wheels' own error is part of the simulation."""
    errors, nees = [], []
    for number in range(count):
        scenario, seed = SCENARIOS[number % len(SCENARIOS)], first_seed + number
        stretch = make_stretch(Order(scenario, seed=seed), 0.0, DURATION_S, step_s=0.6, per_frame=80)
        for draw in range(draws):
            theta = np.zeros(len(COLUMNS))
            theta[[INDEX[p] for p in ERRORS]] = np.random.default_rng([seed, draw]).standard_normal(len(ERRORS)) * list(
                ERRORS.values()
            )
            given = with_errors(stretch.session.true, theta)
            found = estimate_from([measured(stretch, given, draw)])
            judged = [INDEX[p] for p in ERRORS if found.get(p).is_judged]
            off = np.array([p.estimate for p in found.parameters[: len(COLUMNS)]]) - true_corrections(
                given, stretch.session.true
            )
            kept = off[judged]
            nees.append(float(kept @ np.linalg.solve(found.covariance[np.ix_(judged, judged)], kept)) / len(judged))
            errors.append(off)
            print(
                json.dumps({"drive": f"{scenario} {seed} {draw}", "judged": len(judged), "nees": nees[-1]}), flush=True
            )
    return {
        "drives": count * draws,
        "anees": float(np.mean(nees)),
        "anees_median": float(np.median(nees)),
        **_summary(errors),
    }


def _summary(errors: Sequence[Array]) -> dict[str, Any]:
    table = np.abs(np.array(errors))
    return {
        "p90_error": {str(p): float(np.percentile(table[:, INDEX[p]], 90)) for p in NAMED},
        "worst_error": {str(p): float(table[:, INDEX[p]].max()) for p in NAMED},
    }


def recording(path: Path, wrong: dict[CalibrationParameter, float]) -> dict[str, Any]:
    """Errors and sigmas of what is found in a recording whose own calibration is the truth, given one that is off by `wrong`."""
    theta = np.zeros(len(COLUMNS))
    for name, value in wrong.items():
        theta[INDEX[name]] = value
    with open_recording(path) as source:
        true = source.calibration
        given = with_errors(true, theta) if wrong else true
        begun = time.process_time()
        spoiled = replace(source, calibration=given)
        found = estimate_calibration([spoiled], survey_settings(None, source.sensor_set))
        cpu_s = time.process_time() - begun
    off = np.array([p.estimate for p in found.parameters[: len(COLUMNS)]]) - true_corrections(given, true)
    judged = [p.is_judged for p in found.parameters]
    rows = {
        str(p.name): {"error": float(e), "sigma": p.sigma, "judged": j, "unit": p.unit}
        for p, e, j in zip(found.parameters, off, judged, strict=False)
    }
    return {"recording": path.name, "cpu_s": round(cpu_s, 1), "keyframes": found.keyframes, "parameters": rows}


def judged(stretch: Stretch, given: RigCalibration, draw: int, sensors: dict[str, bool]) -> MeasuredCalibration:
    """What the doctor says of a calibration, without pictures."""
    estimate = estimate_from([measured(stretch, given, draw, **sensors)])
    return MeasuredCalibration(findings_of(estimate, Rectifier(given).camera.focal_px), estimate)


def judged_drives(first_seed: int, count: int) -> Iterator[tuple[str, Stretch]]:
    """Drives of all scenarios in turn, each as the doctor reads it: half a minute."""
    for number in range(count):
        scenario, seed = JUDGED_SCENARIOS[number % len(JUDGED_SCENARIOS)], first_seed + number
        stretch = make_stretch(Order(scenario, seed=seed), 0.0, LONGEST_S, step_s=0.6, per_frame=80)
        yield f"{scenario} {seed}", stretch


def good(first_seed: int, count: int) -> dict[str, Any]:
    """False alarms, and what was not judged, by parameter."""
    alarms, unknown = [], Counter[str]()
    for name, stretch in judged_drives(first_seed, count):
        findings = judged(stretch, stretch.session.true, 0, {}).findings
        loud = [f"{name}: {f.name}: {f.sentence}" for f in findings if f.verdict in LOUD]
        lacking = [f.name for f in findings if f.verdict is Verdict.NOT_JUDGED]
        unknown.update(lacking)
        alarms += [loud] if loud else []
        print(json.dumps({"drive": name, "alarms": loud, "not_judged": lacking}), flush=True)
    return {"drives": count, "false_alarms": len(alarms), "alarms": alarms, "not_judged": dict(unknown)}


def decision(
    stretch: Stretch, given: RigCalibration, sensors: dict[str, bool]
) -> tuple[list[str], str, RigCalibration]:
    """What warns or fails, what a build does, and the calibration that it takes: as `mapserver.drafting.admission` decides."""
    first = judged(stretch, given, 0, sensors)
    loud = [f.name for f in first.findings if f.verdict in LOUD]
    if any(f.verdict is Verdict.FAIL for f in first.findings):
        return loud, "refused", given
    rig, done = corrected(given, first)
    again = [f for f in judged(stretch, rig, 1, sensors).findings if f.verdict in LOUD] if done else []
    settled = [f for f in first.findings if f.name not in done or f.verdict is not Verdict.WARN]
    evidence = rig_evidence("", [*settled, *again])
    if evidence.doubted or evidence.unknown():
        return loud, "held", rig
    return loud, "corrected" if done else "passes", rig


def faults(first_seed: int, count: int, *, is_images_only: bool) -> list[dict[str, Any]]:
    """By fault: in how many drives it was found, what builds do, and the dearest error in cm before, and that goes out without a word."""
    sensors = {"inertial": False, "wheels": False} if is_images_only else {}
    drives_of = [stretch for _, stretch in judged_drives(first_seed, count)]
    table = []
    for fault in standard_faults():
        if is_images_only and fault.needs_imu:
            continue
        found, done, costs, silent_cm = 0, Counter[str](), [], 0.0
        for stretch in drives_of:
            true = stretch.session.true
            given = fault.change(true)
            loud, does, rig = decision(stretch, given, sensors)
            found, costs = found + bool(loud), [*costs, cost_cm(given, true)]
            done[does] += 1
            if does in ("passes", "corrected"):
                silent_cm = max(silent_cm, cost_cm(rig, true))
        row = {"fault": fault.name, "drives": count, "found": found, "build": dict(done)}
        table.append(row | {"cost_cm": round(max(costs), 1), "goes_out_cm": round(silent_cm, 1)})
        print(json.dumps(table[-1]), flush=True)
    return table


def main() -> None:
    """Runs one of the two sections."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("section", choices=("drives", "recordings", "good", "faults"))
    parser.add_argument("paths", nargs="*", type=Path)
    parser.add_argument("--seed", type=int, default=300)
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--images-only", action="store_true")
    for name in WRONG:
        parser.add_argument(f"--{name}", type=float, default=0.0)
    asked = parser.parse_args()
    if asked.section == "drives":
        print(json.dumps(drives(asked.seed, asked.count, asked.draws), indent=1))
        return
    if asked.section == "good":
        print(json.dumps(good(asked.seed, asked.count), indent=1))
        return
    if asked.section == "faults":
        faults(asked.seed, asked.count, is_images_only=asked.images_only)
        return
    wrong = {parameter: getattr(asked, name) for name, parameter in WRONG.items() if getattr(asked, name)}
    for path in asked.paths:
        print(json.dumps(recording(path, wrong), indent=1))


if __name__ == "__main__":
    main()
