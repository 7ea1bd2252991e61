"""How fast a survey is built, and how much memory a long one takes.

    PYTHONPATH=tests python tests/benchmarks/survey/bench_build.py [--recording FILE] [--minutes M] [--threads N] [--out FILE.json]

The speed is that of the five aisles, recorded on the way unless --recording names them, after a build of a short piece that loads
the libraries. It is told for 20 frames a second whatever the recording's rate is: frames / 20 Hz / seconds, which is less than
what the recording itself would give, as half of a build goes by keyframes. The long recording is the same drive again and again,
left and entered where place, heading and velocity agree, stamps going on. So every lap is a revisit of all laps before: the worst case
for whatever grows with revisits.
"""

import argparse
import json
import os
import platform
import sys
import tempfile
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.laps import repeated
from benchmarks.common.yardstick import at_reference, slowness
from benchmarks.survey import bench_survey
from fleetmap.recordings import open_recording
from fleetmap.recordings.mcap.writer import copy_to_mcap

_RATE_HZ = 20.0
FIVE_AISLES = next(case for case in bench_survey.CASES if case.name == "five-aisles")


def build(recording: Path, folder: Path, frames: str, threads: int) -> dict[str, Any]:
    """The report of a build in a process of its own, its figures beside it."""
    report = folder / f"{recording.stem}.json"
    slow, begin_s = [slowness()], _children_cpu_s()
    bench_survey.run(
        "mapserver.cli", "build", recording, "--site", recording.stem, "--store", folder / "store", "--report", report,
        "--frames", frames, "--threads", str(threads),
    )  # fmt: skip
    cpu_ms = 1e3 * (_children_cpu_s() - begin_s)
    slow.append(slowness())
    found: dict[str, Any] = json.loads(report.read_text("utf-8"))
    keys = ("frames", "keyframes", "duration_s", "seconds", "realtime_factor", "ate_rmse_m", "peak_rss_mb", "stage_s")
    at_reference_ms = at_reference(cpu_ms, slow)
    return {key: found[key] for key in keys} | {
        "times_20_hz": found["frames"] / _RATE_HZ / found["seconds"],
        "cpu_s_at_reference": None if at_reference_ms is None else 1e-3 * at_reference_ms,
    }


def _children_cpu_s() -> float:
    times = os.times()
    return times.children_user + times.children_system


def measure(recording: Path | None, minutes: float, threads: int) -> dict[str, Any]:
    """Figures of the five aisles, and of the same for so many minutes (0 for none)."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        source = recording or bench_survey.recording_of(FIVE_AISLES, folder)
        assert source is not None
        for name in ("warm", "short"):  # links, as a site bears its recording's name
            (folder / f"{name}.mcap").symlink_to(source.resolve())
        build(folder / "warm.mcap", folder, ":100", threads)
        rows = {"five aisles": build(folder / "short.mcap", folder, "::", threads)}
        if minutes > 0:
            with open_recording(source) as opened:
                laps = int(np.ceil(60.0 * minutes / rows["five aisles"]["duration_s"]))
                end_ns = int(opened.frame_stamps_ns[0] + 60e9 * minutes)
                while (whole := repeated(opened, laps)).frame_stamps_ns[-1] < end_ns:  # a lap is shorter than the drive
                    laps += 1
                copy_to_mcap(whole, folder / "long.mcap")
                enough = np.searchsorted(whole.frame_stamps_ns, end_ns)
            rows[f"{minutes:g} minutes"] = build(folder / "long.mcap", folder, f":{enough}", threads)
    return rows


def show(rows: dict[str, Any], threads: int) -> None:
    """Table and JSON."""
    print(f"{'recording':14} {'frames':>6} {'keyframes':>9} {'seconds':>8} {'x time':>7} {'x 20 Hz':>8} {'MB':>6}")
    for name, row in rows.items():
        print(
            f"{name:14} {row['frames']:6} {row['keyframes']:9} {row['seconds']:8.1f} {row['realtime_factor']:7.2f} "
            f"{row['times_20_hz']:8.2f} {row['peak_rss_mb']:6.0f}"
        )
        print("  " + ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in row["stage_s"].items()))
    machine = {
        "machine": platform.processor() or platform.machine(), "cores": os.cpu_count(), "load": os.getloadavg()[0],
        "threads": threads, "versions": {name: metadata.version(name) for name in bench_survey.LIBRARIES},
        "command": " ".join(sys.argv),
    }  # fmt: skip
    print(json.dumps(machine | {"builds": rows}))


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    rows = measure(given.recording, given.minutes, given.threads)
    show(rows, given.threads)
    if given.out is not None:
        given.out.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
