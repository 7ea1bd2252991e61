"""Robots with a wrong calibration in a map: what the watch finds within 30 s, what it costs until then, and false alarms.

`PYTHONPATH=tests python tests/benchmarks/robot/bench_calibration_watch.py [--only FAULT...] [--good N] [--recording FILE --store FOLDER
--site NAME --frames SLICE] [--work FOLDER] [--out FILE.json]`. Without a recording: a tote robot of a site that no development saw, in
the map of its survey. With one: that recording in that map, for real cameras. `--good N` starts a good robot at N places of the
recording, for 15 s each, instead of spoiling its calibration; each start is told its place as by a dock.
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.recorded_runs import SITE, kept_folder, recorded, surveyed, write_results
from fleetmap.geometry import se3_inverse
from fleetmap.messages import Cause, Status
from fleetmap.recordings import FrameSelection, Recording, open_recording
from fleetmap.sensors.samples import PositionPrior, wheel_between
from fleetmap.sources.replay_source import ReplaySource
from locclient.identity import MapAddress
from locclient.localization.settings import LocalizerSettings
from locclient.maps.connection import connected
from locclient.replay.replay import ReplayOptions, replay
from locclient.replay.run_result import ReplayResult
from support.recordings.calibration_faults import AXES, IMAGE_FAULTS, another_robots_file, standard_faults, unlike_robot

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


@dataclass(frozen=True, slots=True)
class Outcome:
    """One fault. found_s: until the estimate says that the calibration is wrong, None for never; named: the parameters that have drifted
    then, the costliest first, with commas; value: of the first, at the end.

    tracking_median_m, tracking_max_m: errors of frames that were TRACKING. silent_max_m: the largest of those whose covariance holds
    nothing of the calibration, or is too small even so. widened_share: of all frames, those that are TRACKING with a covariance that
    holds what the calibration may cost. outside_share: of the frames with a pose after it was found, how many have an error beyond the
    99.9 % bound of their covariance.
    """

    fault: str
    found_s: float | None
    named: str
    value: float | None
    tracking_share: float
    tracking_median_m: float | None
    tracking_max_m: float | None
    silent_max_m: float
    widened_share: float
    outside_share: float | None

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
    rig = recording.calibration
    rig_faults = [*standard_faults(), another_robots_file(unlike_robot(rig, int(_SEED)))]
    found = {GOOD: recording}
    found |= {fault.name: fault.recording(recording) for fault in rig_faults if fault.applies_to(recording)}
    return found | {name: IMAGE_FAULTS[name].recording(recording) for name in ("swapped", "mirrored")}


def outcome(fault: str, result: ReplayResult) -> Outcome:
    """What a replay shows of a fault."""
    estimates = result.estimates
    tracking_m, outside, silent_m, widened = [], [], [0.0], 0
    for estimate, truth in zip(estimates, result.truths, strict=True):
        if truth is None or estimate.map_from_body is None or estimate.cov_rot_trans is None:
            continue
        off = estimate.map_from_body[:3, 3] - truth[:3, 3]
        off_m, is_beyond = (
            float(np.linalg.norm(off)),
            float(off @ np.linalg.solve(estimate.cov_rot_trans[3:, 3:], off)) > _BOUND,
        )
        if estimate.status is Status.TRACKING:
            tracking_m.append(off_m)
            is_widened = estimate.calibration.cov_bias_cam is not None
            widened += is_widened
            silent_m += [] if is_widened and not is_beyond else [off_m]
        if estimate.cause is Cause.CALIBRATION:
            outside.append(is_beyond)
    found = next((e for e in estimates if e.calibration.is_wrong), None)
    drifts = [] if found is None else [d for d in found.calibration.drifts if d.is_drifted]
    drifts.sort(key=lambda d: (-d.bias_m, -abs(d.value) / d.sigma))
    worst = drifts[0] if drifts else None
    names = ",".join(drift.parameter.figure for drift in drifts)
    last = () if worst is None else estimates[-1].calibration.drifts
    return Outcome(
        fault=fault,
        found_s=None if found is None else (found.stamp_ns - estimates[0].stamp_ns) * 1e-9,
        named="" if found is None else names or "pair order",
        value=next((d.value * d.parameter.per_unit for d in last if worst and d.parameter == worst.parameter), None),
        tracking_share=float(np.mean([e.status is Status.TRACKING for e in estimates])),
        tracking_median_m=float(np.median(tracking_m)) if tracking_m else None,
        tracking_max_m=max(tracking_m, default=None),
        silent_max_m=max(silent_m),
        widened_share=widened / len(estimates),
        outside_share=float(np.mean(outside)) if outside else None,
    )


def played(recording: Recording, store: Path, site: str, indices: NDArray[np.int64], watched_s: float) -> ReplayResult:
    """So many seconds of a recording's frames from the first of `indices` on, as `locclient replay` does."""
    stamps = recording.frame_stamps_ns[indices]
    indices = indices[stamps <= stamps[0] + watched_s * 1e9]
    with connected(MapAddress(site=site, robot="bench", store=str(store))) as link:
        return replay(ReplaySource(recording, indices, reverse=False), link, ReplayOptions(LocalizerSettings()))


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


def held_out(work: Path) -> tuple[Path, Path]:
    """A robot's recording of a site with a held-out seed, and the store with the map of that site's survey."""
    store = surveyed(work, int(_SEED))
    return recorded(work, ("--seed", _SEED, "--robot", _ROBOT, "--frames", "450")), store


def shown(found: Outcome) -> str:
    """An outcome as a line."""
    seconds = "-" if found.found_s is None else f"{found.found_s:.1f} s"
    size = found.named if found.value is None else f"{found.named} {found.value:+.4f}"
    errors = (found.tracking_median_m, found.tracking_max_m, found.silent_max_m)
    in_cm = ", ".join("-" if metres is None else f"{100 * metres:.1f}" for metres in errors)
    text = f"{found.fault:34} found {seconds:>7}  {size:32} TRACKING {found.tracking_share:.2f}: median, largest, silent {in_cm} cm"
    return f"{text}, widened {found.widened_share:.2f}, outside {found.outside_share}"


def main() -> None:
    """Prints the table; writes it as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", action="append", default=[])
    parser.add_argument("--good", type=int, default=0)
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--store", type=Path)
    parser.add_argument("--site", default=SITE)
    parser.add_argument("--frames", default=":")
    parser.add_argument("--work", type=Path, default=kept_folder())
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    path, store = (options.recording, options.store) if options.recording else held_out(options.work)
    told: list[dict[str, Any]] = []
    good: Outcome | None = None
    with open_recording(path) as recording:
        indices = FrameSelection.parse(options.frames).apply(recording)
        if options.good:
            for started, chosen in good_starts(recording, indices, options.good):
                good = outcome(GOOD, played(started, store, options.site, chosen, _GOOD_S))
                told.append(asdict(good) | {"is_right": good.is_right(good), "begin": int(chosen[0])})
                print(f"{shown(good)}, from frame {chosen[0]}", flush=True)
            print(f"{sum(not start['is_right'] for start in told)} false alarms in {len(told)} starts")
            write_results(options.out, {"good": told})
            return
        for name, spoilt in faults(recording).items():
            if name != GOOD and options.only and name not in options.only:
                continue
            found = outcome(name, played(spoilt, store, options.site, indices, _WATCHED_S))
            good = good or found
            told.append(asdict(found) | {"is_right": found.is_right(good)})
            print(f"{shown(found)} {'' if told[-1]['is_right'] else 'MISSED'}", flush=True)
    write_results(options.out, {"faults": told})


if __name__ == "__main__":
    main()
