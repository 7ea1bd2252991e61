"""Four surveys of a site, rendered, built, joined and published: seconds, memory, error of every frame, and loops that are wrong.

    python tests/benchmarks/back_end/bench_drives.py [--recordings FOLDER] [--segments SECONDS] [--scheduler local] [--frames A:B:C]

The site is `fulfilment-wing`: twelve aisles that look alike, driven both ways by surveys of 3 km in all. Recordings that the folder
lacks are made there, in JPEG: half an hour of two cores. The published map is that of `mapserver build` with four recordings and
`mapserver publish`; the report's seconds are wall time from opening the first recording until the map can be stored.
"""

import argparse
import json
import os
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fleetmap.errors import GateRefusedError
from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.samples import SensorSet, Trajectory
from fleetsim.commands import record_order
from fleetsim.recorder import Order
from fleetsim.scene.layout import Layout
from mapserver import Actor, BuildOptions, GateSettings, build_map
from mapserver.config import survey_settings
from mapserver.library import BuiltMap
from mapserver.survey.loops.loops import Loops

SCENARIO, SEED = "fulfilment-wing", 907
ROBOTS = ("survey-south", "survey-north", "survey-south-back", "survey-north-back")
SHARE_LIMIT, PEAK_LIMIT_MB, ATE_LIMIT_M = 1 / 3, 4096.0, 0.05  # of the driving time; of memory; over all frames
# The aisles do look alike, and straight aisles show little of a calibration: what an operator says of such a site.
GATE = GateSettings(max_aliased_share=1.0)
_WRONG_M = 0.5 * Layout.bay_m  # half of the smallest step by which the site repeats


def recordings_in(folder: Path, count: int, seed: int = SEED) -> list[Path]:
    """The first drives; those that are not there are recorded."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{robot}.mcap" for robot in ROBOTS[:count]]
    for robot, path in zip(ROBOTS, paths, strict=False):
        if not path.exists():
            begun = path.with_suffix(".begun")
            record_order(Order(SCENARIO, robot=robot, seed=seed), begun, "mcap", images="jpeg")
            begun.rename(path)
    return paths


def measure(recordings: list[Path], store: Path, options: BuildOptions) -> dict[str, Any]:
    """The build's figures, and what the gate says of its draft."""
    begun = time.perf_counter(), _cpu_s()
    made = build_map(recordings, store, "wing", options)
    built = time.perf_counter(), _cpu_s()
    row = _figures(made) | {
        "wall_s": round(built[0] - begun[0], 1),
        "cpu_s": round(built[1] - begun[1], 1),
        "peak_mb": round(made.report["peak_rss_mb"]),
        "peak_of_a_process_beside_mb": round(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e6),
    }
    try:
        made.publish(gate=GATE, trust_calibration=True, actor=Actor("bench", "a simulated rig"))
        row["gate"] = "published"
    except GateRefusedError as error:
        row["gate"] = str(error)
    return row | {
        "share_of_driving": round(row["wall_s"] / row["driving_s"], 3),
        "publish_s": round(time.perf_counter() - built[0], 1),
    }


def _figures(made: BuiltMap) -> dict[str, Any]:
    report, surveys = made.report, made.built.surveyed
    return {
        "driving_s": round(sum(_seconds(s.survey.map.trajectory) for s in surveys), 1),
        "path_m": round(report["path_m"]),
        "frames": sum(len(s.survey.map.trajectory) for s in surveys),
        "keyframes": report["keyframes"],
        "map_mb": round(report["map_bytes"] / 1e6, 2),
        "ate_mm": round(1e3 * report["ate_rmse_m"], 1),
        "evaluated_share": report["evaluated_share"],
        "joined": [s["joined"] for s in report["sessions"]],
        "reasons": [s["reason"] for s in report["sessions"]],
        "loops": [len(s.survey.loops.edges) for s in surveys],
        "scale_error": report["scale_error"],
        "pair_shift_px": [round(s.survey.stereo_yaw.shift_px, 3) for s in surveys],
        "wrong_loops": [_wrong(s.survey.loops, _true_places(s.survey.odometry.keyframes, s.truth)) for s in surveys],
        "findings": report["findings"],
    }


def _seconds(trajectory: Trajectory) -> float:
    return 1e-9 * float(trajectory.stamps_ns[-1] - trajectory.stamps_ns[0])


def _true_places(keyframes: Any, truth: Trajectory | None) -> Array:
    assert truth is not None
    at = np.searchsorted(truth.stamps_ns, [k.stamp_ns for k in keyframes])
    return truth.frame_from_body[np.minimum(at, len(truth.stamps_ns) - 1)]


def _wrong(loops: Loops, true_map_from_body: Array) -> list[tuple[int, int, list[float]]]:
    """Keyframes i and j of each wrong loop, and by how many metres it is off, in axes of i."""
    found = []
    for edge in loops.edges:
        true_i_from_j = se3_inverse(true_map_from_body[edge.i]) @ true_map_from_body[edge.j]
        off_m = edge.i_from_j[:3, 3] - true_i_from_j[:3, 3]
        if np.linalg.norm(off_m) > _WRONG_M:
            found.append((edge.i, edge.j, off_m.round(2).tolist()))
    return found


def _cpu_s() -> float:
    """Of this process and of those that it waited for."""
    return sum(os.times()[:4])


def main() -> None:
    """Prints one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, default=Path("out/wing"))
    parser.add_argument("--seed", type=int, default=SEED, help="of recordings that the folder lacks")
    parser.add_argument("--drives", type=int, default=len(ROBOTS), help="only the first so many")
    parser.add_argument(
        "--segments", type=float, default=None, help="seconds of a segment, 0 for none, default: the product's"
    )
    parser.add_argument("--scheduler", default=None)
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--frames", default="::")
    parser.add_argument("--report", type=Path, default=None, help="full report of the build")
    given = parser.parse_args()
    settings = survey_settings(None, SensorSet.STEREO_INERTIAL)
    if given.segments is not None:
        segments = msgspec.structs.replace(settings.segments, seconds=given.segments)
        settings = msgspec.structs.replace(settings, segments=segments)
    options = BuildOptions(
        settings=settings, scheduler=given.scheduler, threads=given.threads, frames=given.frames, report=given.report
    )
    paths = recordings_in(given.recordings, given.drives, given.seed)
    with tempfile.TemporaryDirectory(dir=given.recordings) as folder:
        print(json.dumps(measure(paths, Path(folder) / "store", options)))


if __name__ == "__main__":
    main()
