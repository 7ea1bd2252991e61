"""How a survey's back end would run on many cores: its stages by the processes of a dask cluster, in CPU seconds of each process.

Wall time of a busy machine says little. What is measured is the CPU that each process takes, stage by stage. Had each a core of its own,
matching would take what its busiest process takes, since batches are sent ahead; elsewhere the survey's own process and the
busiest worker are taken to wait for each other. Besides: tasks, bytes that travel, and the fit of

    T(n) = serial + parallel / n + overhead of having a cluster at all

with no part below nothing, over the numbers of processes, from which larger ones are extrapolated, and a site of 13,000 keyframes by its
length. Pictures are missing as in `bench_site.py`, so that the odometry and sub-pixel alignment are in none of the figures.

    PYTHONPATH=tests python tests/benchmarks/back_end/bench_scaling.py --drive FILE [--keyframes 250] [--workers 1,2,4]
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse
import json
import pickle
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from scipy.optimize import nnls

from benchmarks.back_end.bench_site import SETTINGS, digest
from benchmarks.common.simulated_survey import SimulatedSurvey, drawn_alignment
from fleetmap.bow.shipped_vocabulary import default_vocabulary
from mapserver.build import worker
from mapserver.build.image_spill import ImageSpill
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.pipeline import survey_from
from mapserver.survey.survey_inputs import SurveyConfig, SurveyTools

SPEED_UP_LIMIT, SITE_LIMIT_MIN = 2.0, 30.0  # of matching by 4 processes over 1; of a site's survey on 16 cores
WORKERS = (0, 1, 2, 4)  # 0: the survey's own process alone
_SITE_KEYFRAMES = 13_000
_WARM_KEYFRAMES = 120  # whose adjustment takes every solver
_CORES = (2, 4, 8, 16, 32)
_AHEAD = ("matching", "matching again")  # stages whose work goes to the executor, several batches ahead


class Traffic:
    """Pickles of the executor: how many left this process, and bytes both ways."""

    def __init__(self) -> None:
        self.tasks, self.sent, self.received = 0, 0, 0

    def dumps(self, value: object, protocol: int) -> bytes:
        data = pickle.dumps(value, protocol=protocol)
        self.tasks, self.sent = self.tasks + 1, self.sent + len(data)
        return data

    def loads(self, data: bytes) -> Any:
        self.received += len(data)
        return pickle.loads(data)


class _Clocks:
    """CPU seconds of this process and of each worker, by stage."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._stage, self._last = "start", self._now()
        self.stages: dict[str, list[float]] = {}

    def __call__(self, stage: str, done: int, total: int) -> None:
        stage = stage if done < total else f"after {stage}"  # what follows it without a name of its own
        if stage != self._stage:
            now = self._now()
            spent = [b - a for a, b in zip(self._last, now, strict=True)]
            before = self.stages.get(self._stage, [0.0] * len(now))
            self.stages[self._stage] = [a + b for a, b in zip(before, spent, strict=True)]
            self._stage, self._last = stage, self._now()  # asking costs too

    def _now(self) -> list[float]:
        workers = {} if self._client is None else self._client.run(time.process_time)
        return [time.process_time(), *(workers[name] for name in sorted(workers))]


def measure(drive: Path, keyframes: int, workers: int) -> dict[str, Any]:
    """One survey by so many processes, by this one alone for 0."""
    if workers == 0:
        _measure(drive, _WARM_KEYFRAMES, SERIAL, None)  # kernels are loaded before the clocks start
        return _measure(drive, keyframes, SERIAL, None)
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        _measure(drive, _WARM_KEYFRAMES, worker.Cluster(client), None)
        return _measure(drive, keyframes, worker.Cluster(client), client)


def _measure(drive: Path, keyframes: int, executor: Executor, client: Any) -> dict[str, Any]:
    traffic, options = Traffic(), SurveyConfig(SETTINGS, default_vocabulary())
    counted = SimpleNamespace(dumps=traffic.dumps, loads=traffic.loads)
    with ImageSpill(drive.parent) as store:
        survey = SimulatedSurvey.read(drive, keyframes, store)
        clocks = _Clocks(client)
        with drawn_alignment(survey), patch.object(worker, "pickle", counted):
            made = survey_from(survey.odometry, survey.inputs, options, SurveyTools(clocks, store, executor))
        clocks("end", 0, 0)
    stages = {name: [round(each, 2) for each in spent] for name, spent in clocks.stages.items()}
    seconds = {
        name: max(spent) if name in _AHEAD else spent[0] + max(spent[1:], default=0.0)
        for name, spent in clocks.stages.items()
    }
    return {
        "workers": len(next(iter(stages.values()))) - 1,
        "keyframes": len(survey.odometry.keyframes),
        "digest": digest(made),
        "stages_cpu_s": stages,
        "seconds": round(sum(seconds.values()), 2),
        "matching_s": round(sum(seconds.get(name, 0.0) for name in _AHEAD), 2),
        "tasks": traffic.tasks,
        "sent_mb": round(traffic.sent / 1e6, 1),
        "received_mb": round(traffic.received / 1e6, 1),
    }


def fit(rows: Sequence[dict[str, Any]], key: str) -> dict[str, Any]:
    """Serial, parallel and overhead seconds that fit the rows' `key`, and what they make of more cores."""
    counts = np.array([max(row["workers"], 1) for row in rows], float)
    shares = np.column_stack([np.ones(len(rows)), 1.0 / counts, [float(row["workers"] > 0) for row in rows]])
    (serial, parallel, overhead), left_over_s = nnls(shares, np.array([row[key] for row in rows]))
    alone = next(row[key] for row in rows if row["workers"] == 0)
    tasks = max(row["tasks"] for row in rows)
    predicted = {n: round(float(serial + parallel / n + overhead), 2) for n in _CORES}
    return {
        "of": key,
        "serial_s": round(float(serial), 2),
        "parallel_s": round(float(parallel), 2),
        "overhead_s": round(float(overhead), 2),
        "overhead_ms_per_task": round(1e3 * float(overhead) / max(tasks, 1), 1),
        "not_explained_s": round(float(left_over_s), 2),
        "serial_share": round(float(serial / (serial + parallel)), 3),
        "predicted_s": predicted,
        "speed_up": {n: round(alone / each, 2) for n, each in predicted.items()},
        "site_min": {
            n: round(each * _SITE_KEYFRAMES / rows[0]["keyframes"] / 60.0, 1) for n, each in predicted.items()
        },
    }


def matching_speed_up(rows: Sequence[dict[str, Any]], workers: int) -> float:
    """Of so many processes over one, in the stages that batches are sent ahead in."""
    taken = {row["workers"]: row["matching_s"] for row in rows}
    return float(taken[1] / taken[workers])


def main() -> None:
    """Prints one line of JSON for each number of processes, then the fits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drive", type=Path, required=True, help="as `bench_site.py` writes it")
    parser.add_argument("--keyframes", type=int, default=250)
    parser.add_argument("--workers", default=",".join(map(str, WORKERS)), help="numbers of processes, comma separated")
    given = parser.parse_args()
    rows = []
    for workers in sorted(int(n) for n in given.workers.split(",")):
        rows.append(measure(given.drive, given.keyframes, workers))
        print(json.dumps(rows[-1]), flush=True)
    assert len({row["digest"] for row in rows}) == 1, "the result depends on the executor"
    for key in ("seconds", "matching_s"):
        print(json.dumps(fit(rows, key)))
    print(json.dumps({"matching_speed_up": matching_speed_up(rows, max(row["workers"] for row in rows))}))


if __name__ == "__main__":
    main()
