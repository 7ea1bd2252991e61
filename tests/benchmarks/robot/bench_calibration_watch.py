"""Robots with a wrong calibration in a map: what the watch finds within 30 s, what it costs until then, and false alarms.

A tote robot of a site that no development saw, in the map of its survey. `--good N` starts a good robot at N places of its drive, for 15 s
each, instead of spoiling its calibration; each start is told its place as by a dock.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.recorded_runs import Options, Results, benchmark, recorded, replayed, surveyed
from fleetmap.geometry import se3_inverse
from fleetmap.messages import Status
from fleetmap.recordings import FrameSelection, Recording, open_recording
from fleetmap.sensors.samples import PositionPrior, wheel_between
from fleetmap.sources.source import ReplaySource
from locclient.replay.run_result import ReplayResult
from support.recordings.calibration_faults import AXES, RigFault, mirrored, standard_faults, swapped, unlike_robot

GOOD = "none"
_WATCHED_S, _GOOD_S = 30.0, 15.0
_BEFORE_NS = 100_000_000  # of sensors before the first frame of a start
_DOCK_SIGMA = 0.1  # metres, and radians, of the place that a good robot is told at its start
_SEED, _ROBOT = "300", "tote-1"
_LIMIT_M = 0.03  # an error that may pass without a word, where the good robot has none that is larger
_BOUND = 16.266  # 0.999 of chi-square with 3 degrees of freedom
# What must be named, one of them, by kind of fault; of others any parameter. A delay is corrected, and costs nothing.
_NAMES = {
    "baseline": {"baseline_scale"},
    "focal": {"focal_scale"},
    "focal of cam0": {"focal_scale", "right_focal_scale"},
    "focal of cam1": {"right_focal_scale"},
    "swapped": {"pair order"},
    "mirrored": {"pair order"},
    "delay": {"time_offset_s"},
} | {
    f"{rig} {axis}": {f"{name}_{axis}_deg"}
    for rig, name in (("pair", "pair"), ("camera-imu", "camera"))
    for axis in AXES
}


class Outcome(NamedTuple):
    """One fault. found_s: until the estimate says that the calibration is wrong, None for never; named: the parameters that have drifted
    then, the costliest first, with commas. tracking_max_m: the largest error of frames that were TRACKING. silent_max_m: the largest of
    those whose covariance holds nothing of the calibration, or is too small even so.
    """

    fault: str
    found_s: float | None
    named: str
    tracking_share: float
    tracking_max_m: float | None
    silent_max_m: float

    def is_right(self, good: "Outcome") -> bool:
        """Nothing large went out in silence, and what was named is what is wrong; the good robot was not found fault with."""
        if self.fault == GOOD:
            return self.found_s is None
        names = _NAMES.get(self.fault.rsplit(" ", 2)[0])
        is_named = self.found_s is None or names is None or not names.isdisjoint(self.named.split(","))
        is_lost_in_silence = self.found_s is None and self.tracking_share == 0
        return is_named and not is_lost_in_silence and self.silent_max_m <= max(_LIMIT_M, good.silent_max_m)


def faults(recording: Recording) -> dict[str, Recording]:
    """The recording with each fault, by name."""
    others = unlike_robot(recording.calibration, int(_SEED))
    rig_faults = [*standard_faults(), RigFault("another robot's file", 1.0, "file", lambda _: others)]
    found = {GOOD: recording}
    found |= {fault.name: fault.recording(recording) for fault in rig_faults}
    return found | {"swapped": swapped(recording), "mirrored": mirrored(recording)}


def outcome(fault: str, result: ReplayResult) -> Outcome:
    """What a replay shows of a fault."""
    estimates = result.estimates
    tracking_m, silent_m = list[float](), [0.0]
    for estimate, truth in zip(estimates, result.truths, strict=True):
        if estimate.status is not Status.TRACKING or truth is None:
            continue
        off = estimate.map_from_body[:3, 3] - truth[:3, 3]
        tracking_m.append(float(np.linalg.norm(off)))
        is_beyond = float(off @ np.linalg.solve(estimate.cov_rot_trans[3:, 3:], off)) > _BOUND
        if is_beyond or estimate.calibration.cov_bias_cam is None:
            silent_m.append(tracking_m[-1])
    found = next((e for e in estimates if e.calibration.is_wrong), None)
    drifts = [] if found is None else [d for d in found.calibration.drifts if d.is_drifted]
    drifts.sort(key=lambda d: (-d.bias_m, -abs(d.value) / d.sigma))
    names = ",".join(drift.parameter.figure for drift in drifts)
    return Outcome(
        fault=fault,
        found_s=None if found is None else (found.stamp_ns - estimates[0].stamp_ns) * 1e-9,
        named="" if found is None else names or "pair order",
        tracking_share=float(np.mean([e.status is Status.TRACKING for e in estimates])),
        tracking_max_m=max(tracking_m, default=None),
        silent_max_m=max(silent_m),
    )


def watched(recording: Recording, store: Path, indices: NDArray[np.int64], watched_s: float) -> ReplayResult:
    """So many seconds of a recording's frames from the first of `indices` on."""
    stamps = recording.frame_stamps_ns[indices]
    indices = indices[stamps <= stamps[0] + watched_s * 1e9]
    return replayed(ReplaySource(recording, indices, reverse=False), store)


def good_starts(
    recording: Recording, indices: NDArray[np.int64], count: int
) -> list[tuple[Recording, NDArray[np.int64]]]:
    """Starts at `count` places, evenly spread in time over those that have the whole time, or half of all, before them.

    Each is the recording with the place of the first of its frames as the only position prior, and these frames.
    """
    since_s = (recording.frame_stamps_ns[indices] - recording.frame_stamps_ns[indices[0]]) * 1e-9
    begins = np.searchsorted(since_s, np.linspace(0.0, max(since_s[-1] - _GOOD_S, 0.5 * since_s[-1]), count))
    starts = []
    for begin in np.unique(begins):
        stamp_ns = int(recording.frame_stamps_ns[indices[begin]])
        truth = None if recording.ground_truth is None else recording.ground_truth.at(stamp_ns)
        if truth is not None:
            map_from_base = truth @ se3_inverse(recording.calibration.base_from_body)
            prior = PositionPrior(stamp_ns, map_from_base, np.eye(6) * _DOCK_SIGMA**2)
            since_ns = stamp_ns - _BEFORE_NS
            sensors = recording.imu.between(since_ns, 2**62), wheel_between(recording.wheel, since_ns, 2**62)
            started = replace(recording, priors=(prior,), imu=sensors[0], wheel=sensors[1])
            starts.append((started, indices[begin:]))
    return starts


@benchmark(good=0)
def main(options: Options) -> Results:
    store = surveyed(options.work, int(_SEED))
    path = recorded(options.work, ("--seed", _SEED, "--robot", _ROBOT, "--frames", "450"))
    told: list[dict[str, Any]] = []
    good: Outcome | None = None
    with open_recording(path) as recording:
        indices = FrameSelection.parse(":").apply(recording)
        if options.good:
            runs = [(GOOD, *start, _GOOD_S) for start in good_starts(recording, indices, options.good)]
        else:
            every = faults(recording).items()
            runs = [(name, spoiled, indices, _WATCHED_S) for name, spoiled in every]
        for name, drive, chosen, watched_s in runs:
            found = outcome(name, watched(drive, store, chosen, watched_s))
            good = good or found
            told.append(found._asdict() | {"is_right": found.is_right(good), "begin": int(chosen[0])})
            print(json.dumps(told[-1]), flush=True)
    return {"good" if options.good else "faults": told}
