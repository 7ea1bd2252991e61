"""Odometry over Monte-Carlo runs of the simulator without pictures: errors beside their covariance, and drift.

`PYTHONPATH=tests python tests/benchmarks/back_end/bench_consistency.py [--runs N] [--first SEED] [--frames N] [--out FILE.json]`;
about five minutes of one core
for 100 runs of 17 s, 15 s of them driving. Seeds 1000 to 1099 and 5000 to 5099 served to choose settings, those from 6000 were
looked at on the way; figures to report begin at 7000.
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse
import json
import platform
import time
from pathlib import Path

import numpy as np

from benchmarks.common import consistency

REPORTED_FROM = 7000


def summary(runs: list[consistency.Figures]) -> dict[str, float]:
    """Means over runs, the middle 90 % of the normalised errors, and the drift as a share of the way."""
    rotation, position = (np.array([getattr(r, f"{name}_nees") for r in runs]) for name in ("rotation", "position"))
    return {
        "rotation_nees_per_dof": float(rotation.mean()),
        "position_nees_per_dof": float(position.mean()),
        "rotation_nees_p5": float(np.percentile(rotation, 5)),
        "rotation_nees_p95": float(np.percentile(rotation, 95)),
        "position_nees_p5": float(np.percentile(position, 5)),
        "position_nees_p95": float(np.percentile(position, 95)),
        "rotation_rms_mrad": 1e3 * float(np.mean([r.rotation_rms_rad for r in runs])),
        "position_rms_mm": 1e3 * float(np.mean([r.position_rms_m for r in runs])),
        "final_share_of_way": float(np.mean([r.final_m / r.way_m for r in runs])),
        "final_share_of_way_worst": float(np.max([r.final_m / r.way_m for r in runs])),
        "inlier_share": float(np.mean([r.inlier_share for r in runs])),
    }


def main() -> None:
    """Prints a table of both sensor sets; writes it as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--first", type=int, default=REPORTED_FROM)
    parser.add_argument("--frames", type=int, default=255)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    begun_s, site = time.process_time(), consistency.Site()
    runs: dict[str, list[consistency.Figures]] = {"stereo-inertial": [], "stereo": []}
    for seed in range(options.first, options.first + options.runs):
        session = site.session(seed)
        for name, done in runs.items():
            done.append(consistency.run(session, name == "stereo-inertial", options.frames)[0])
    found = {name: summary(done) for name, done in runs.items()}
    print(f"{options.runs} runs from seed {options.first}, {options.frames} frames")
    print(f"{'':26s}" + "".join(f"{name:>18s}" for name in found))
    for figure in next(iter(found.values())):
        print(f"{figure:26s}" + "".join(f"{values[figure]:18.4f}" for values in found.values()))
    if options.out is not None:
        about = {
            "machine": f"{platform.machine()}, {platform.processor() or platform.system()}",
            "python": platform.python_version(), "numpy": np.__version__,
            "command": f"bench_consistency.py --runs {options.runs} --first {options.first} --frames {options.frames}",
            "cpu_s": time.process_time() - begun_s,
        }  # fmt: skip
        options.out.write_text(json.dumps({"about": about, "results": found}, indent=2) + "\n")


if __name__ == "__main__":
    main()
