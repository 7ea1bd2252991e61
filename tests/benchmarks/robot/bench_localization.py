"""A robot in the map of another day: every figure that the project promises for it.

Recordings of `fleetsim record small-loop` and the map made of its survey stay in the work folder (FLEETMAP_BENCH_WORK, else the temporary
folder) and serve again. CPU times are the process's, as they are and as the machine would take that the limits are for (yardstick.py).
"""

import json
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import psutil

from benchmarks.common.recorded_runs import SITE, Options, Results, benchmark, played, recorded, resident_mb, surveyed
from benchmarks.common.yardstick import at_reference, mean_of, slowness
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.free_memory import give_back_free_memory
from fleetmap.messages import Status, robot_key
from locclient.localization.place import boxminus
from locclient.localization.protection import ProtectionMonitor
from locclient.replay import run_metrics
from locclient.replay.run_metrics import FrameRecord
from locclient.replay.run_result import ReplayResult
from support.recordings.hashes import hashed, tiles_of

# Options of `fleetsim record small-loop` for the robot's recording.
CASES: dict[str, tuple[str, ...]] = {
    "next day": ("--robot", "runner-1", "--day", "1"),
    "night, stock three days on": ("--robot", "runner-1", "--day", "3", "--light", "night"),
    "camera 0.5 m lower": ("--robot", "tote-1", "--day", "1"),
    "opposite direction": ("--robot", "opposite-1", "--day", "1"),
    "another site": ("--robot", "runner-1", "--day", "1", "--seed", "1"),
}
_GOOD_M, _LEVEL_PAIRS = 0.1, 5
_UNSURE = (Status.LOST, Status.AMBIGUOUS)


def run_figures(frames: Sequence[FrameRecord]) -> dict[str, Any]:
    """What a run was worth, flat."""
    errors, angles, cpu = run_metrics.error_m(frames), run_metrics.error_deg(frames), run_metrics.frame_ms(frames)
    outside = [run_metrics.is_outside_its_bound(frame) for frame in frames if frame.error_map_m is not None]
    unsure = [1e3 * frame.cpu_s for frame in frames[run_metrics.WARM_UP_FRAMES :] if frame.status in _UNSURE]
    return {
        "frames": len(frames),
        "first_fix_frame": run_metrics.first_fix(frames),
        "localised_share_of_all": run_metrics.localised_share_of_all(frames),
        "localised_share": run_metrics.localised_share(frames),
        "median_mm": None if errors is None else 1e3 * errors["median"],
        "p99_mm": None if errors is None else 1e3 * errors["p99"],
        "max_mm": None if errors is None else 1e3 * errors["max"],
        "heading_p99_deg": None if angles is None else angles["p99"],
        "silent_failures": run_metrics.silent_failures(frames),
        "position_failures": run_metrics.position_failures(frames),
        "truth_outside_share": float(np.mean(outside)) if outside else None,
        "cpu_mean_ms": None if cpu is None else cpu["mean"],
        "cpu_p99_ms": None if cpu is None else cpu["p99"],
        "unsure_p99_ms": float(np.percentile(unsure, 99)) if unsure else None,
        "rss_mb": resident_mb(),
        "stage_ms": run_metrics.stage_ms(frames),
        "status_share": run_metrics.status_share(frames),
    }


def consistency(run: ReplayResult) -> dict[str, float]:
    """How well covariances tell the errors of poses while TRACKING, 1.0 if exactly, and the share of good fixes that the gate refused."""
    squared, looks, refused = list[list[float]](), 0, 0
    for estimate, truth in zip(run.estimates, run.truths, strict=True):
        map_from_body = estimate.map_from_body
        if map_from_body is None or truth is None:
            continue
        error, covariance = boxminus(map_from_body, truth), estimate.cov_rot_trans
        if estimate.status is Status.TRACKING:
            parts = slice(3), slice(3, 6)
            squared.append([error[a] @ np.linalg.solve(covariance[a, a], error[a]) / 3 for a in parts])
        if estimate.innovation_m is not None:  # with the pose's error, the most that the fix is off
            looks += 1
            refused += estimate.fix is None and estimate.innovation_m + np.linalg.norm(error[3:]) < _GOOD_M
    rotation, position = np.mean(squared, axis=0).tolist()
    found = {"rotation_nees_per_dof": rotation, "position_nees_per_dof": position}
    return found | {"good_fixes_refused_share": float(refused / looks)}


def process_figures(recording: Path, store: Path) -> dict[str, float | None]:
    """Of `locclient run` at the recording's own pace: CPU s at the reference until it publishes an estimate, the most MB in memory."""
    first_s, rss_mb = list[float](), list[float]()
    with tempfile.TemporaryDirectory() as folder, Bus("tcp/127.0.0.1:0", is_server=True).open() as bus:
        config = Path(folder) / "robot.toml"
        config.write_text(
            f'[run]\nstore = "{store}"\nsite = "{SITE}"\nrobot = "bench"\ncache = "{folder}"\noutbox = "{folder}/spool.sqlite3"\n'
            f'[source]\nkind = "recording"\nrecording = "{recording}"\nspeed = 1.0\n[output]\nendpoint = "{bus.endpoint}"\n'
        )
        with psutil.Popen([sys.executable, "-m", "locclient.cli", "run", "--config", config]) as process:
            bus.subscribe(robot_key(SITE, "bench", "estimate"), lambda *_: first_s.append(sum(process.cpu_times()[:2])))
            while process.poll() is None:
                rss_mb.append(process.memory_info().rss / 1e6)
                time.sleep(0.5)
    return {"first_estimate_cpu_s": at_reference(first_s[0], [slowness()]), "rss_mb": max(rss_mb)}


def level_figures(recording: Path, store: Path) -> dict[str, float | None]:
    """What the protection level adds to a frame's mean CPU ms: the median over pairs of replays, one with it and one without."""
    without = patch.multiple(ProtectionMonitor, handle=lambda *_: None, judged=lambda _, estimate: estimate)

    def mean_ms(*, is_judged: bool) -> float:
        with nullcontext() if is_judged else without:
            return 1e3 * float(
                np.mean([f.cpu_s for f in played(recording, store).frames[run_metrics.WARM_UP_FRAMES :]])
            )

    mean_ms(is_judged=True)  # loads what computes
    slow, more_ms = [slowness()], []
    for pair in range(_LEVEL_PAIRS):
        taken = {is_judged: mean_ms(is_judged=is_judged) for is_judged in (pair % 2 == 0, pair % 2 == 1)}
        more_ms.append(taken[True] - taken[False])
    slow.append(slowness())
    median_ms = float(np.median(more_ms))
    return {"more_ms": median_ms, "more_ms_at_reference": at_reference(median_ms, slow), "slowness": mean_of(slow)}


@benchmark([*CASES, "process", "level"], seed=0)
def main(arguments: Options) -> Results:
    seed, found = arguments.seed, {}
    store = surveyed(arguments.work, seed or None)
    if "process" in arguments.only:
        arguments.only.remove("process")
        found["process"] = process_figures(recorded(arguments.work, CASES["next day"]), store)
    if "level" in arguments.only:
        arguments.only.remove("level")
        found["level"] = level_figures(recorded(arguments.work, CASES["next day"]), store)
    for name in arguments.only:
        recording = recorded(arguments.work, (("--seed", str(seed)) if seed else ()) + CASES[name])
        played(recording, store, ":60")
        give_back_free_memory()
        slow = [slowness()]
        run = played(recording, store)
        found[name] = run_figures(run.frames) | consistency(run) | {"sha256": hashed(run.estimates)["estimates"]}
        slow.append(slowness())
        found[name] |= {
            "slowness": mean_of(slow),
            "cpu_mean_ms_at_reference": at_reference(found[name]["cpu_mean_ms"], slow),
            "cpu_p99_ms_at_reference": at_reference(found[name]["cpu_p99_ms"], slow),
        }
    survey = json.loads((arguments.work / f"survey{f'-{seed}' if seed else ''}.json").read_text("utf-8"))
    figures = {"ate_rmse_m": survey["ate_rmse_m"], "map_bytes_per_m": survey["map_bytes"] / survey["path_m"]}
    return {"cases": found, "map": tiles_of(store)} | figures
