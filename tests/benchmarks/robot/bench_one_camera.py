"""One camera in maps that a pair made: real drives by their left camera with the IMU, the simulator's robot with wheels, and starts.

Real drives are met in the map of all their own frames. Each of 20 starts is that of a robot that knows nothing, in the midst of a drive.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.recorded_runs import Options, Results, benchmark, recorded, replayed, surveyed
from benchmarks.robot.bench_localization import run_figures
from benchmarks.robot.bench_real_robots import robots_map
from fleetmap.messages import Status
from fleetmap.recordings import open_recording
from fleetmap.recordings.sensor_subset import reduced
from fleetmap.sensors.samples import SensorSet
from fleetmap.sources.source import ReplaySource
from locclient.replay import run_metrics
from locclient.replay.run_metrics import FrameRecord
from support.recordings.realdata import DATA

_STARTS, _START_S = 20, 3.0
_NEAR_M, _NEAR_DEG, _SIGMAS = 0.05, 1.0, 3.37  # 3 sigmas of one dimension: 0.9973, of three
CASES = {
    "euroc_mh01_start": (SensorSet.MONO_INERTIAL, False),
    "euroc_v101_keyframes": (SensorSet.MONO_INERTIAL, False),
    "small-loop, by its wheels": (SensorSet.MONO, True),
    "small-loop, by its IMU": (SensorSet.MONO_INERTIAL, False),
}


def _is_near(frame: FrameRecord) -> bool:
    error_m, error_rad = frame.error_m, frame.error_rad
    return error_m is not None and error_rad is not None and error_m < _NEAR_M and np.degrees(error_rad) < _NEAR_DEG


def _is_beyond(frame: FrameRecord) -> bool:
    error_m, covariance = frame.error_map_m, frame.cov_rot_trans
    if frame.status is not Status.TRACKING or error_m is None or covariance is None:
        return False
    return bool(error_m @ np.linalg.solve(covariance[3:, 3:], error_m) > _SIGMAS**2)


def figures(path: Path, store: Path, use: SensorSet, *, has_wheels: bool) -> dict[str, Any]:
    """The whole drive, and the starts."""
    with open_recording(path) as opened:
        kept = reduced(replace(opened, wheel=opened.wheel if has_wheels else (), priors=()), use)
        stamps_ns = kept.frame_stamps_ns
        last = int(np.searchsorted(stamps_ns, stamps_ns[-1] - int(_START_S * 1e9)))
        begins = np.unique(np.linspace(0, max(last - 1, 0), _STARTS).round().astype(int)).tolist()
        ends = [max(int(np.searchsorted(stamps_ns, stamps_ns[n] + int(_START_S * 1e9))), n + 3) for n in begins]
        whole, *starts = (
            replayed(ReplaySource(kept, np.arange(a, min(b, len(stamps_ns))), reverse=False), store).frames
            for a, b in [(0, len(stamps_ns)), *zip(begins, ends, strict=True)]
        )
    return run_figures(whole) | {
        "near_share": float(np.mean([_is_near(frame) for frame in whole])),
        "tracking_beyond_3_sigma": sum(map(_is_beyond, whole)),
        "starts": {
            "count": len(starts),
            "tracking_share": float(np.mean([f.status is Status.TRACKING for start in starts for f in start])),
            "silent_failures": sum(run_metrics.silent_failures(start) or 0 for start in starts),
            "tracking_beyond_3_sigma": sum(_is_beyond(frame) for start in starts for frame in start),
        },
    }


@benchmark(CASES)
def main(arguments: Options) -> Results:
    found = {}
    for name in arguments.only:
        use, has_wheels = CASES[name]
        if name.startswith("euroc"):
            path = DATA / name
            store = robots_map(arguments.work, path, "0::1")
        else:
            path, store = recorded(arguments.work, ("--robot", "tote-1", "--day", "1")), surveyed(arguments.work)
        found[name] = figures(path, store, use, has_wheels=has_wheels)
    return {"cases": found}
