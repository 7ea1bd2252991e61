"""Odometry over Monte-Carlo runs of the simulator without pictures: errors beside their covariance, and drift.

About five minutes of one core for 100 runs of 17 s, 15 s of them driving. Seeds 1000 to 1099 and 5000 to 5099 served to choose settings,
those from 6000 were looked at on the way; figures to report begin at 7000.
"""

import numpy as np

from benchmarks.common import consistency
from benchmarks.common.recorded_runs import Options, Results, benchmark

REPORTED_FROM, _FRAMES = 7000, 255


def summary(runs: list[consistency.Figures]) -> dict[str, float]:
    """Means over runs, and the drift as a share of the way."""
    rotation, position = (np.array([getattr(r, f"{name}_nees") for r in runs]) for name in ("rotation", "position"))
    return {
        "rotation_nees_per_dof": float(rotation.mean()),
        "position_nees_per_dof": float(position.mean()),
        "rotation_rms_mrad": 1e3 * float(np.mean([r.rotation_rms_rad for r in runs])),
        "position_rms_mm": 1e3 * float(np.mean([r.position_rms_m for r in runs])),
        "final_share_of_way": float(np.mean([r.final_m / r.way_m for r in runs])),
        "final_share_of_way_worst": float(np.max([r.final_m / r.way_m for r in runs])),
        "inlier_share": float(np.mean([r.inlier_share for r in runs])),
    }


@benchmark(runs=100, seed=REPORTED_FROM)
def main(options: Options) -> Results:
    site = consistency.Site()
    runs: dict[str, list[consistency.Figures]] = {"stereo-inertial": [], "stereo": []}
    for seed in range(options.seed, options.seed + options.runs):
        session = site.session(seed)
        for name, done in runs.items():
            done.append(consistency.run(session, name == "stereo-inertial", _FRAMES)[0])
    return {"results": {name: summary(done) for name, done in runs.items()}}
