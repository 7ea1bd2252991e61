"""What a robot is promised to do, on the simulator and on real recordings; `make bench` prints the figures.

Every benchmark is a process of its own, as a robot is: its memory and its one core are part of what is measured. Recordings and maps
are made once and serve all of them.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.common.recorded_runs import misses
from benchmarks.robot import (
    bench_aliased_starts,
    bench_faults,
    bench_localization,
    bench_real_robots,
    bench_robot_memory,
    bench_standing_starts,
)
from support.recordings.realdata import real_data

HERE = Path(__file__).resolve().parent
SOURCES = os.pathsep.join(str(HERE.parents[1] / folder) for folder in ("shared", "mapserver", "locclient", "tests"))

pytestmark = [pytest.mark.slow, pytest.mark.timeout(7200)]


@pytest.fixture(scope="session")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where recordings and maps are kept: of this run, or of all runs where FLEETMAP_BENCH_WORK names a folder."""
    kept = os.environ.get("FLEETMAP_BENCH_WORK")
    return Path(kept) / "localization" if kept else tmp_path_factory.mktemp("robots")


def results(folder: Path, bench: str, *options: str | Path) -> dict[str, Any]:
    """The results of a benchmark, whose table is printed."""
    out = folder / "results.json"
    command = [sys.executable, str(HERE / "robot" / bench), *map(str, options), "--out", str(out)]
    subprocess.run(command, env=os.environ | {"PYTHONPATH": SOURCES}, check=True)
    found: dict[str, Any] = json.loads(out.read_text("utf-8"))
    print(json.dumps({key: value for key, value in found.items() if key != "starts"}))
    return found


@pytest.mark.parametrize("name", bench_localization.CASES)
def test_in_the_map_of_another_day(name: str, work: Path, tmp_path: Path) -> None:
    found = results(tmp_path, "bench_localization.py", "--only", name, "--work", work)["cases"][name]
    assert not misses(found, bench_localization.CASES[name].promises)


@pytest.mark.parametrize("name", bench_faults.EXPECTED)
def test_fault(name: str, work: Path, tmp_path: Path) -> None:
    (found,) = results(tmp_path, "bench_faults.py", "--only", name, "--work", work)["faults"]
    assert bench_faults.Outcome(**found).is_right


@pytest.mark.parametrize("name", bench_real_robots.CASES)
def test_real_recording(name: str, work: Path, tmp_path: Path) -> None:
    real_data(bench_real_robots.CASES[name].recording)
    found = results(tmp_path, "bench_real_robots.py", "--only", name, "--work", work)["cases"][name]
    assert not misses(found, bench_real_robots.CASES[name].promises)


def test_memory_of_half_an_hour(work: Path, tmp_path: Path) -> None:
    found = results(tmp_path, "bench_robot_memory.py", "--work", work)["memory"]
    assert not misses(found, bench_robot_memory.PROMISES)


@pytest.mark.parametrize("name", bench_aliased_starts.PROMISES)
def test_starts_among_identical_aisles(name: str, tmp_path: Path) -> None:
    found = results(tmp_path, "bench_aliased_starts.py", "--only", name)["figures"][name]
    assert not misses(found, bench_aliased_starts.PROMISES[name])


@pytest.mark.parametrize("name", bench_standing_starts.PROMISES)
def test_standing_starts_by_night(name: str, work: Path, tmp_path: Path) -> None:
    """On a site that no development saw; also where the map lacks all around."""
    found = results(tmp_path, "bench_standing_starts.py", "--pipeline", name, "--work", work)["figures"][name]
    assert not misses(found, bench_standing_starts.PROMISES[name])


def test_wrong_calibrations(work: Path, tmp_path: Path) -> None:
    """Nothing beyond 3 cm goes out as TRACKING unless the covariance says so, and what is named is what is wrong."""
    found = results(tmp_path, "bench_calibration_watch.py", "--work", work)["faults"]
    assert [fault["fault"] for fault in found if not fault["is_right"]] == []


def test_good_calibrations(work: Path, tmp_path: Path) -> None:
    starts = results(tmp_path, "bench_calibration_watch.py", "--good", "12", "--work", work)["good"]
    assert [start["begin"] for start in starts if not start["is_right"]] == []
