"""What `prepare` takes with an empty cache and with a full one, and which kernels a build and a replay still compile after it.

    PYTHONPATH=tests python tests/benchmarks/survey/bench_prepare.py [--recording PATH] [--out results.json]

Without a recording: a ride through a textured room that is not the one of `prepare`. Kernels are told by their files in the cache.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.common.recorded_runs import tool
from support.recordings.recording_samples import write_euroc
from support.worlds.box_room import out_and_back, ride_sample

FRAMES, FRAME_S = 100, 0.06


def measured(recording: Path | None) -> dict[str, Any]:
    """Seconds of processor and clock by command, and the names of kernel files that appeared after `prepare`."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder, cache = Path(name), Path(name) / "cache"
        if recording is None:
            recording = write_euroc(folder / "ride", ride_sample(out_and_back(FRAMES * FRAME_S), FRAMES, FRAME_S))
        for program in ("locclient", "mapserver"):
            found[f"{program} prepare"] = _timed([*tool(program), "prepare"], cache)
        prepared = _files(cache)
        for program in ("locclient", "mapserver"):
            found[f"{program} prepare again"] = _timed([*tool(program), "prepare"], cache)
        to_store = ["--store", str(folder / "store"), "--site", "ride"]
        found["build"] = _timed([*tool("mapserver"), "build", str(recording), *to_store], cache)
        publish = ["publish", *to_store, "--force", "--actor", "bench", "--reason", "a short ride"]
        found["publish"] = _timed([*tool("mapserver"), *publish], cache)
        found["replay"] = _timed([*tool("locclient"), "replay", str(recording), *to_store], cache)
        found["kernels"] = len(prepared)
        found["left out"] = sorted(_files(cache) - prepared)
    return found


def _timed(command: Sequence[str], cache: Path) -> dict[str, float]:
    """Seconds that the command took, of processor and of clock."""
    before, begun_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, stdout=sys.stderr, env=os.environ | {"NUMBA_CACHE_DIR": str(cache)})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"cpu_s": round(cpu_s, 1), "wall_s": round(time.perf_counter() - begun_s, 1)}


def _files(cache: Path) -> set[str]:
    """Compiled kernels: one file for each kind of arguments."""
    return {f"{file.parent.name}/{file.name}" for file in cache.rglob("*.nbc")}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    results = measured(arguments.recording)
    text = json.dumps(results, indent=2)
    print(text)
    if arguments.out is not None:
        arguments.out.write_text(text + "\n", encoding="utf-8")
