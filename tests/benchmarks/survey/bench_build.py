"""How fast a survey is built, and how much memory a long one takes.

The speed is that of the five aisles, recorded into the work folder, after a build of a short piece that loads the libraries. The long
recording is the same drive again and again, left and entered where place, heading and velocity agree, stamps going on. So every lap is a
revisit of all laps before: the worst case for whatever grows with revisits.
"""

import json
import os
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.laps import repeated
from benchmarks.common.recorded_runs import Options, Results, benchmark, recorded, tool
from benchmarks.common.yardstick import at_reference, slowness
from fleetmap.recordings import open_recording
from fleetmap.recordings.mcap.writer import copy_to_mcap


def build(recording: Path, folder: Path, frames: str) -> dict[str, Any]:
    """The report of a build in a process of its own, its figures beside it."""
    report = folder / f"{recording.stem}.json"
    slow, begin_s = [slowness()], sum(os.times()[2:4])
    to_store = ["--site", recording.stem, "--store", str(folder / "store"), "--report", str(report), "--frames", frames]
    subprocess.run([*tool("mapserver"), "build", str(recording), *to_store], stdout=subprocess.DEVNULL, check=True)
    cpu_s = sum(os.times()[2:4]) - begin_s  # of children
    slow.append(slowness())
    found: dict[str, Any] = json.loads(report.read_text("utf-8"))
    keys = ("frames", "keyframes", "duration_s", "seconds", "realtime_factor", "ate_rmse_m", "peak_rss_mb")
    return {key: found[key] for key in keys} | {"cpu_s_at_reference": at_reference(cpu_s, slow)}


def measure(source: Path, minutes: int) -> dict[str, Any]:
    """Figures of the five aisles, and of the same for so many minutes (0 for none)."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        for name in ("warm", "short"):  # links, as a site bears its recording's name
            (folder / f"{name}.mcap").symlink_to(source.resolve())
        build(folder / "warm.mcap", folder, ":100")
        rows = {"five aisles": build(folder / "short.mcap", folder, "::")}
        if minutes > 0:
            with open_recording(source) as opened:
                laps = int(np.ceil(60.0 * minutes / rows["five aisles"]["duration_s"]))
                end_ns = int(opened.frame_stamps_ns[0] + 60e9 * minutes)
                while (whole := repeated(opened, laps)).frame_stamps_ns[-1] < end_ns:  # a lap is shorter than the drive
                    laps += 1
                copy_to_mcap(whole, folder / "long.mcap")
                enough = np.searchsorted(whole.frame_stamps_ns, end_ns)
            rows[f"{minutes} minutes"] = build(folder / "long.mcap", folder, f":{enough}")
    return rows


@benchmark(minutes=10)
def main(given: Options) -> Results:
    return measure(recorded(given.work, ("--seed", "1"), "five-aisles"), given.minutes)
