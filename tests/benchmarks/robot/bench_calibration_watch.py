"""Robots with a wrong calibration in a map: what the watch finds within 30 s, what it costs until then, and false alarms.

`PYTHONPATH=tests python tests/benchmarks/robot/bench_calibration_watch.py [--only FAULT...] [--recording FILE --store FOLDER --site NAME
--frames SLICE] [--work FOLDER] [--out FILE.json]`. Without a recording: a tote robot of a site that no development saw, in the map of
its survey. With one: that recording in that map, for real cameras.
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.recorded_runs import SITE, kept_folder, recorded, surveyed, write_results
from fleetmap.messages import Cause, Status
from fleetmap.recordings import FrameSelection, Recording, open_recording
from locclient.localization.settings import LocalizerSettings
from locclient.maps.connection import connected
from locclient.replay.replay import ReplayOptions, replay
from locclient.replay.run_result import ReplayResult
from locclient.sensors.replay_source import ReplaySource
from support.recordings.calibration_faults import IMAGE_FAULTS, another_robots_file, standard_faults, unlike_robot

GOOD = "none"
_WATCHED_S = 30.0
_SEED, _ROBOT = "300", "tote-1"
_LIMIT_M = 0.03  # an error beyond that of the good robot that may pass without a word


@dataclass(frozen=True, slots=True)
class Outcome:
    """One fault. found_s: until the estimate says that the calibration is wrong, None for never; named: the parameter that costs most.

    silent_median_m, silent_max_m: errors of frames that were TRACKING. outside_share: of the frames with a pose after it was found,
    how many have an error beyond the 99.9 % bound of their covariance.
    """

    fault: str
    found_s: float | None
    named: str
    value: float | None
    tracking_share: float
    silent_median_m: float | None
    silent_max_m: float | None
    outside_share: float | None

    def is_right(self, good: "Outcome") -> bool:
        """Found, or not worth a word; the good robot not found fault with."""
        if self.fault == GOOD:
            return self.found_s is None
        if self.found_s is not None:
            return True
        costs_m = (self.silent_median_m or 0.0) - (good.silent_median_m or 0.0)
        return self.tracking_share > 0 and costs_m <= _LIMIT_M


def faults(recording: Recording) -> dict[str, Recording]:
    """The recording with each fault, by name."""
    rig = recording.calibration
    rig_faults = [*standard_faults(), another_robots_file(unlike_robot(rig, int(_SEED)))]
    found = {GOOD: recording}
    found |= {fault.name: fault.recording(recording) for fault in rig_faults if fault.applies_to(recording)}
    return found | {name: IMAGE_FAULTS[name].recording(recording) for name in ("swapped", "mirrored")}


def outcome(fault: str, result: ReplayResult) -> Outcome:
    """What a replay shows of a fault."""
    estimates, errors_m, outside = result.estimates, [], []
    found = next((e for e in estimates if e.calibration.is_wrong), None)
    for estimate, truth in zip(estimates, result.truths, strict=True):
        if truth is None or estimate.map_from_body is None or estimate.cov_rot_trans is None:
            continue
        off = estimate.map_from_body[:3, 3] - truth[:3, 3]
        if estimate.status is Status.TRACKING:
            errors_m.append(float(np.linalg.norm(off)))
        if estimate.cause is Cause.CALIBRATION:
            outside.append(float(off @ np.linalg.solve(estimate.cov_rot_trans[3:, 3:], off)) > 16.266)
    last = next((e for e in reversed(estimates) if e.calibration.is_wrong), None)
    drifts = [] if last is None else [d for d in last.calibration.drifts if d.is_drifted]
    worst = max(drifts, key=lambda d: (d.bias_m, abs(d.value) / d.sigma), default=None)
    return Outcome(
        fault=fault,
        found_s=None if found is None else (found.stamp_ns - estimates[0].stamp_ns) * 1e-9,
        named="" if found is None else "pair order" if worst is None else worst.parameter.figure,
        value=None if worst is None else worst.value * worst.parameter.per_unit,
        tracking_share=float(np.mean([e.status is Status.TRACKING for e in estimates])),
        silent_median_m=float(np.median(errors_m)) if errors_m else None,
        silent_max_m=max(errors_m, default=None),
        outside_share=float(np.mean(outside)) if outside else None,
    )


def played(recording: Recording, store: Path, site: str, frames: str) -> ReplayResult:
    """The first 30 s of a recording, as `locclient replay` does."""
    indices = FrameSelection.parse(frames).apply(recording)
    stamps = recording.frame_stamps_ns[indices]
    indices = indices[stamps <= stamps[0] + _WATCHED_S * 1e9]
    with connected({"site": site, "store": store, "server": None, "robot": "bench"}) as link:
        return replay(ReplaySource(recording, indices, reverse=False), link, ReplayOptions(LocalizerSettings()))


def held_out(work: Path) -> tuple[Path, Path]:
    """A robot's recording of a site with a held-out seed, and the store with the map of that site's survey."""
    store = surveyed(work, int(_SEED))
    return recorded(work, ("--seed", _SEED, "--robot", _ROBOT, "--frames", "450")), store


def main() -> None:
    """Prints the table; writes it as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", action="append", default=[])
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
        for name, spoilt in faults(recording).items():
            if name != GOOD and options.only and name not in options.only:
                continue
            found = outcome(name, played(spoilt, store, options.site, options.frames))
            good = good or found
            told.append(asdict(found) | {"is_right": found.is_right(good)})
            shown = "-" if found.found_s is None else f"{found.found_s:.1f} s"
            size = "" if found.value is None else f"{found.named} {found.value:+.4f}"
            errors = [None if e is None else round(100 * e, 1) for e in (found.silent_median_m, found.silent_max_m)]
            text = f"{name:34} found {shown:>7}  {size or found.named:32} TRACKING {found.tracking_share:.2f}, errors {errors} cm"
            print(f"{text}, outside {found.outside_share} {'' if told[-1]['is_right'] else 'MISSED'}", flush=True)
    write_results(options.out, {"faults": told})


if __name__ == "__main__":
    main()
