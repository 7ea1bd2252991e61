"""Replays of failures: injected faults in a painted room, each failure's recording re-run, and what keeping it costs a robot.

    PYTHONPATH=tests python tests/benchmarks/fleet/bench_failure_replay.py [--failures 50] [--seed 0] [--out FILE.json]

A fault (dark, overexposed, covered or stuck images for 8 s, or a robot that is carried) begins at a frame that the seed chooses. The robot
runs on; what it said of every frame that its recording holds is compared with what the replay says. CPU: of the thread, in the ring's own
share of every frame, state and pictures included. Memory: arrays and objects that the ring holds when a recording is complete, each once.
"""

import argparse
import json
import platform
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fleetmap.sensors.samples import CameraFrame
from fleetmap.sources.sensor_bundle import SensorBundle
from locclient.delivery.failure_file import failure_file, read_failure_file
from locclient.maps.map_source import LocalMapSource
from locclient.replay.failure_replay import compare_failure
from locclient.replay.replay import load_map
from locclient.robot.failure_report import failure_report
from locclient.robot.robot import Robot
from mapserver.store import MapStore
from support.fleet.failed_robot import profile
from support.recordings.recording_samples import calibration
from support.worlds import robot_world

FAULTS = ("dark", "overexposed", "covered", "stuck", "carried")
_FAULT_FRAMES, _AFTER_FRAMES = 80, 60


def ride(fault: str, at: int) -> Iterator[SensorBundle]:
    """The room's ride with a fault from frame `at` on."""
    if fault == "carried":
        yield from robot_world.carried(at + _AFTER_FRAMES, at)
        return
    last = None
    for number, bundle in enumerate(robot_world.bundles(at + _FAULT_FRAMES + _AFTER_FRAMES)):
        frame = bundle.frame
        if at <= number < at + _FAULT_FRAMES:
            left, right = _spoiled(fault, last if last is not None else frame, number)
            yield SensorBundle(CameraFrame(frame.stamp_ns, left, right), bundle.imu)
        else:
            last = frame
            yield bundle


def _spoiled(fault: str, last: CameraFrame, number: int) -> tuple[np.ndarray, np.ndarray]:
    if fault == "stuck":
        return last.left, last.right
    level = {"dark": 0, "overexposed": 255, "covered": 60}[fault]
    noise = np.random.default_rng(number).integers(-1, 2, last.left.shape)
    image = np.clip(level + noise * (fault == "covered"), 0, 255).astype(np.uint8)
    return image, image.copy()


class TimedRing:
    """Measures the CPU of a robot's ring: its own part of `follow`, and `handle`."""

    def __init__(self, robot: Robot) -> None:
        ring = robot.ring
        assert ring is not None
        self.frames_ms: list[float] = []
        self._inner_s = self._own_s = 0.0
        inner_follow, follow, handle = ring._inner.follow, ring.follow, ring.handle

        def timed_inner(*given: Any) -> Any:
            begun_s = time.thread_time()
            found = inner_follow(*given)
            self._inner_s = time.thread_time() - begun_s
            return found

        def timed_follow(*given: Any) -> Any:
            begun_s = time.thread_time()
            found = follow(*given)
            self._own_s = time.thread_time() - begun_s - self._inner_s
            return found

        def timed_handle(*given: Any) -> None:
            begun_s = time.thread_time()
            handle(*given)
            self.frames_ms.append((self._own_s + time.thread_time() - begun_s) * 1e3)

        ring._inner.follow, ring.follow, ring.handle = timed_inner, timed_follow, timed_handle  # type: ignore[method-assign]


def held_bytes(value: object, seen: set[int]) -> int:
    """Of a value and all that it refers to, each once; arrays with their memory, also where they are views."""
    if id(value) in seen or isinstance(value, type) or callable(value):
        return 0
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        base = value if value.base is None or not isinstance(value.base, np.ndarray) else value.base
        known = id(base) in seen and base is not value
        seen.add(id(base))
        return sys.getsizeof(value) + (0 if known or value.base is None else base.nbytes)
    size = sys.getsizeof(value)
    if isinstance(value, dict):
        return size + sum(held_bytes(key, seen) + held_bytes(item, seen) for key, item in value.items())
    if isinstance(value, list | tuple | set | frozenset) or hasattr(value, "popleft"):
        return size + sum(held_bytes(item, seen) for item in value)  # type: ignore[attr-defined]
    names = list(getattr(value, "__struct_fields__", getattr(value, "__dict__", ())))
    if is_dataclass(value):
        names = [each.name for each in fields(value)]
    return size + sum(held_bytes(getattr(value, name), seen) for name in names)


def fail(fault: str, at: int, store: Path, folder: Path) -> dict[str, Any] | None:
    """One failure: whether its replay says the same, its bytes, the ring's memory and CPU; None where the robot did not fail."""
    source = LocalMapSource(store, "room")
    settings = (calibration(), robot_world.rectifier(), robot_world.SETTINGS, robot_world.TRIAL)
    robot = Robot(*settings, keeps_replay=True)
    timed = TimedRing(robot)
    robot.use(load_map(source)[0])
    context, said = None, {}
    for bundle in ride(fault, at):
        outcome = robot.handle(bundle)
        assert outcome is not None
        said[outcome.estimate.stamp_ns] = outcome.estimate.status.value
        context = context or outcome.failure
        if context is not None and context.cut is not None and context.cut.frames is not None:
            break
    if context is None or context.cut is None or robot.ring is None:
        return None
    robot.ring.finish()
    kept = held_bytes(list(robot.ring._frames), set())
    report = failure_report(context, profile(robot), report_id="f1", wall_ns=10**18)
    path = folder / "failure.mcap"
    path.write_bytes(failure_file(context.cut, report, profile(robot), "full"))
    found = compare_failure(read_failure_file(path), source)
    stamps = [moment.stamp_ns for moment in found.summary.moments]
    return {
        "fault": fault,
        "at": at,
        "cause": str(report.cause),
        "kind": str(report.kind),
        "has_same_statuses": [moment.status for moment in found.now] == [said[stamp_ns] for stamp_ns in stamps],
        "is_same": found.first_difference_ns is None,
        "apart_mm": 1e3 * found.apart_m,
        "statuses": len({said[stamp_ns] for stamp_ns in stamps}),
        "bytes": path.stat().st_size,
        "ring_bytes": kept,
        "frames_ms": timed.frames_ms,
    }


def measure(failures: int, seed: int) -> dict[str, Any]:
    """The figures of so many failures."""
    rng = np.random.default_rng(seed)
    runs, silent = [], []
    with TemporaryDirectory() as name:
        folder = Path(name)
        with MapStore.open(folder / "store", create=True) as store:
            robot_world.save(store)
        while len(runs) < failures and len(silent) < failures:
            fault = FAULTS[(len(runs) + len(silent)) % len(FAULTS)]
            # A robot is lifted while it stands: in the pause at the beginning of the second cycle.
            at = int(rng.integers(72, 79) if fault == "carried" else rng.integers(60, 120))
            run = fail(fault, at, folder / "store", folder)
            if run is None:
                silent.append(f"{fault} at {at}")
            else:
                runs.append(run)
                print(json.dumps({key: value for key, value in run.items() if key != "frames_ms"}), flush=True)
    frames_ms = np.concatenate([run.pop("frames_ms") for run in runs])
    sizes = np.array([run["bytes"] for run in runs])
    return {
        "seed": seed,
        "failures": len(runs),
        "different": len({(run["fault"], run["at"]) for run in runs}),
        "without_failure": silent,
        "same_statuses": sum(run["has_same_statuses"] for run in runs),
        "same": sum(run["is_same"] for run in runs),
        "apart_mm_max": max(run["apart_mm"] for run in runs),
        "causes": dict(Counter(run["cause"] for run in runs)),
        "bytes_median": int(np.median(sizes)),
        "bytes_max": int(sizes.max()),
        "ring_mb_max": max(run["ring_bytes"] for run in runs) / 1e6,
        "ring_ms_mean": float(frames_ms.mean()),
        "ring_ms_p99": float(np.quantile(frames_ms, 0.99)),
        "machine": platform.processor() or platform.machine(),
    }


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--failures", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    figures = measure(options.failures, options.seed)
    print(json.dumps(figures, indent=1))
    if options.out is not None:
        options.out.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
