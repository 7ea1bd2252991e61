"""How exact and how fast surveys and replays of the real recordings are; `make bench` prints the figures."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import bench_build, bench_survey
from realdata import real_data

REPOSITORY = Path(__file__).resolve().parents[2]
SOURCES = os.pathsep.join(str(REPOSITORY / folder) for folder in ("shared", "mapserver", "locclient"))

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


def run(module: str, *arguments: str | Path) -> None:
    """One command of the project, which must succeed."""
    command = [sys.executable, "-c", f"from {module} import main; main()", *arguments]
    environment = os.environ | {"PYTHONPATH": SOURCES}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


def build(recording: Path, folder: Path, frames: str = "::") -> dict[str, Any]:
    """The report of a build into `folder / "store"`, site bench."""
    run(
        "mapserver.cli", "build", recording, "--site", "bench", "--store", folder / "store", "--frames", frames,
        "--report", folder / "build.json", "--frame-from-ground-truth",
    )  # fmt: skip
    report: dict[str, Any] = json.loads((folder / "build.json").read_text("utf-8"))
    return report


def show(name: str, report: dict[str, Any], *keys: str) -> None:
    """One line of figures."""
    print(f"\n{name}: " + ", ".join(f"{key} {report[key]}" for key in keys))


@pytest.mark.parametrize("case", bench_survey.CASES, ids=lambda case: case.name)
def test_survey(case: bench_survey.Case) -> None:
    """Against what the best known system reaches on the recording; a miss fails here and stays visible."""
    rows = bench_survey.bench([case.name])
    if not rows:
        pytest.skip(f"REAL DATA MISSING: {case.name} is not there, this test proves nothing without it")
    bench_survey.show(rows)
    assert rows[0]["evaluated_share"] >= 0.98
    assert rows[0]["ate_rmse_m"] <= case.limit_m


def test_held_out_frames_are_localised(tmp_path: Path) -> None:
    recording = real_data("euroc_v101_keyframes")
    build(recording, tmp_path, "0::2")
    run("mapserver.cli", "publish", "--site", "bench", "--store", tmp_path / "store")
    run(
        "locclient.cli", "replay", recording, "--store", tmp_path / "store", "--site", "bench", "--frames", "1::2",
        "--report", tmp_path / "replay.json",
    )  # fmt: skip
    report = json.loads((tmp_path / "replay.json").read_text("utf-8"))
    show("euroc_v101_keyframes, held out", report, "localised_share", "error_m", "error_deg", "frame_ms", "peak_rss_mb")
    assert report["localised_share"] >= 0.9
    assert report["error_m"]["median"] <= 0.05
    assert report["error_m"]["p95"] <= 0.15
    assert report["silent_failures"] == 0


@pytest.mark.timeout(3600)
def test_build_speed_and_memory() -> None:
    """Three times faster than recorded at 20 Hz, and ten minutes in less than 2 GB."""
    rows = bench_build.measure(None, 10.0, len(os.sched_getaffinity(0)))
    bench_build.show(rows, len(os.sched_getaffinity(0)))
    assert rows["10 minutes"]["peak_rss_mb"] <= bench_build.MEMORY_LIMIT_MB
    assert rows["five aisles"]["times_20_hz"] >= bench_build.SPEED_LIMIT
