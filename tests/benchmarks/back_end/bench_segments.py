"""Segments of a rendered survey in the processes of a dask cluster: CPU of each process, bytes that travel, the same result.

    PYTHONPATH=tests python tests/benchmarks/back_end/bench_segments.py --recording FILE [--segments 120] [--workers 1,4]

The stage is `begin_survey`: images decoded, followed, described, matched and adjusted within each segment, then joined. Wall time of a
machine with fewer cores than processes says nothing. Had each process a core of its own, the stage would take what the survey's own
process and the busiest worker take one after the other; a model of so many segments on so many cores follows from the segments' own times.
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse
import hashlib
import json
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import msgspec
import numpy as np

from benchmarks.back_end.bench_scaling import Traffic
from fleetmap.recordings import open_recording
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import SensorSet
from mapserver.build import worker
from mapserver.build.image_spill import ImageSpill
from mapserver.build.survey_beginnings import survey_inputs_of
from mapserver.config import survey_settings
from mapserver.survey.pipeline import begin_survey
from mapserver.survey.survey_inputs import SurveyTools

SPEED_UP_LIMIT = 2.0  # of 4 processes over 1
_WARM_FRAMES = 200  # compiled kernels are loaded before the clocks start


def measure(recording: Path, seconds: float, workers: int, frames: int | None = None) -> dict[str, Any]:
    """The stage by so many dask processes. frames: only the first so many."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        executor = worker.Cluster(client)
        _begun(recording, 5.0, executor, _WARM_FRAMES)
        traffic = Traffic()
        counted = SimpleNamespace(dumps=traffic.dumps, loads=traffic.loads)
        before, begun = _clocks(client), time.perf_counter()
        with patch.object(worker, "pickle", counted):
            digest = _begun(recording, seconds, executor, frames)
        wall_s = time.perf_counter() - begun
        spent = [round(b - a, 2) for a, b in zip(before, _clocks(client), strict=True)]
    return {
        "workers": workers,
        "own_cpu_s": spent[0],
        "workers_cpu_s": spent[1:],
        "critical_s": round(spent[0] + max(spent[1:]), 2),
        "wall_s": round(wall_s, 1),
        "tasks": traffic.tasks,
        "sent_mb": round(traffic.sent / 1e6, 2),
        "received_mb": round(traffic.received / 1e6, 1),
        "digest": digest,
    }


def _begun(recording: Path, seconds: float, executor: worker.Cluster, frames: int | None) -> str:
    settings = survey_settings(None, SensorSet.STEREO_INERTIAL)
    overlap_s = min(settings.segments.overlap_s, seconds / 2)
    segments = msgspec.structs.replace(settings.segments, seconds=seconds, overlap_s=overlap_s)
    settings = msgspec.structs.replace(settings, segments=segments)
    with open_recording(recording) as opened, ImageSpill(recording.parent) as images:
        chosen = np.arange(len(opened.frame_stamps_ns), dtype=np.int64)[:frames]
        inputs = survey_inputs_of(opened, chosen, Rectifier(opened.calibration), None)
        chain = begin_survey(inputs, settings, SurveyTools(images=images, executor=executor))
    found = hashlib.sha256(np.ascontiguousarray(chain.state.map_from_body))
    found.update(np.ascontiguousarray(chain.state.landmarks.points_map))
    return found.hexdigest()[:16]


def _clocks(client: Any) -> list[float]:
    workers = client.run(time.process_time)
    return [time.process_time(), *(workers[name] for name in sorted(workers))]


def speed_up(rows: Sequence[dict[str, Any]]) -> float:
    """Of the most processes over one."""
    taken = {row["workers"]: row["critical_s"] for row in rows}
    return float(taken[1] / taken[max(taken)])


def main() -> None:
    """Prints a line of JSON for each number of processes, then the speed-up."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path, required=True)
    parser.add_argument("--segments", type=float, default=120.0)
    parser.add_argument("--workers", default="1,4")
    parser.add_argument("--frames", type=int, default=None)
    given = parser.parse_args()
    rows = []
    for workers in (int(n) for n in given.workers.split(",")):
        rows.append(measure(given.recording, given.segments, workers, given.frames))
        print(json.dumps(rows[-1]), flush=True)
    print(json.dumps({"speed_up": round(speed_up(rows), 2), "same": len({row["digest"] for row in rows}) == 1}))


if __name__ == "__main__":
    main()
