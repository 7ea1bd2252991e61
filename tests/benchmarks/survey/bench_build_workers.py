"""How long a build takes with one thread, with several, and with processes of a dask cluster; the maps must be the same.

    python tests/benchmarks/survey/bench_build_workers.py RECORDING [--frames A:B:C] [--threads N] [--out FILE.json]

The first build of a short piece is not counted: it loads the compiled kernels.
"""

import argparse
import hashlib
import os
import platform
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path

import msgspec

from mapserver.build.build import BuildOptions, BuildRequest, build_draft
from mapserver.store import MapStore
from mapserver.survey.settings import SurveySettings


def measure(recording: Path, frames: str, threads: int, store: Path) -> list[dict[str, object]]:
    """One row for each worker."""
    ways = (("one thread", 1, None), (f"{threads} threads", threads, None), (f"{threads} processes", threads, "local"))
    build_draft(BuildRequest((recording,), "warm", store, BuildOptions(":60", threads=1)), SurveySettings())
    rows: list[dict[str, object]] = []
    for number, (name, count, scheduler) in enumerate(ways):
        site, report = f"site{number}", store / "report.json"
        begun_s, cpu_s = time.perf_counter(), time.process_time()
        options = BuildOptions(frames, report=report, threads=count, scheduler=scheduler)
        draft, _ = build_draft(BuildRequest((recording,), site, store, options), SurveySettings())
        rows.append(
            {
                "worker": name,
                "seconds": round(time.perf_counter() - begun_s, 2),
                "own_cpu_s": round(time.process_time() - cpu_s, 2),
                "realtime_factor": draft.report["realtime_factor"],
                "map_sha256": _map_of(store, site),
                "stage_s": msgspec.json.decode(report.read_bytes())["stage_s"],
            }
        )
        print(
            f"{name:14s} {rows[-1]['seconds']:8} s  own cpu {rows[-1]['own_cpu_s']:8} s  {rows[-1]['realtime_factor']} x recorded"
        )
    assert len({row["map_sha256"] for row in rows}) == 1, "the maps differ"
    return rows


def _map_of(store: Path, site: str) -> str:
    """One hash over the archive and all tiles."""
    with MapStore.open(store) as maps:
        archive, tiles = maps.archive(site, 1), maps.manifest(site, 1).tiles
    assert archive is not None
    return hashlib.sha256(archive + "".join(tile.sha256 for tile in tiles).encode()).hexdigest()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--frames", default="::")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(options.recording, options.frames, options.threads, Path(folder))
    found = {
        "machine": {"processor": platform.machine(), "cores": os.cpu_count(), "load": os.getloadavg()[0]},
        "versions": {name: metadata.version(name) for name in ("numpy", "numba", "distributed")},
        "command": " ".join(sys.argv),
        "results": rows,
    }
    text = msgspec.json.format(msgspec.json.encode(found), indent=2).decode()
    print(text)
    if options.out is not None:
        options.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
