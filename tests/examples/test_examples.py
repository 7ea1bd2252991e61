"""Every example and notebook runs, on one small simulated recording and the map that an example makes of it."""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from fleetmap import open_recording, read_tum
from fleetmap.recordings import format_calibration
from fleetsim import Order, record_order
from mapserver import open_store
from mapserver.fleet_statistics.kpis import Counters, hour_of
from mapserver.store.fleet_queries import FleetBatch

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def run(name: str, folder: Path, *arguments: str | Path) -> str:
    """What an example prints; it must succeed."""
    command = [sys.executable, EXAMPLES / f"{name}.py", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{name}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def run_notebook(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The names that a notebook's code cells leave, run in order in one namespace."""
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.chdir(folder)
    namespace: dict[str, Any] = {}
    cells = json.loads((EXAMPLES / f"{name}.ipynb").read_text("utf-8"))["cells"]
    for number, cell in enumerate(cells, start=1):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{name}, cell {number}", "exec"), namespace)
    return namespace


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with survey.mcap and, made by `build_a_map.py`, the published map of the site `lab` in `maps`."""
    folder = tmp_path_factory.mktemp("examples")
    record_order(Order("clip", frames=45), folder / "survey.mcap")
    said = run("build_a_map", folder, "survey.mcap", "maps", "lab", "map.png", "known-rig")
    assert "45 frames over" in said
    assert "version 1: " in said
    assert (folder / "map.png").read_bytes().startswith(b"\x89PNG")
    return folder


def test_odometry_alone(site: Path, tmp_path: Path) -> None:
    said = run("odometry_alone", site, "survey.mcap", tmp_path / "odometry.tum")
    assert len(read_tum(tmp_path / "odometry.tum")) == 45
    assert "absolute trajectory error: 0.0" in said
    assert (tmp_path / "odometry.png").exists()


def test_new_recording_format(site: Path, tmp_path: Path) -> None:
    with open_recording(site / "survey.mcap") as recording:
        (tmp_path / "calibration.yaml").write_text(format_calibration(recording.calibration))
        for index in range(3):
            frame = recording.stored_frame(index)
            (tmp_path / f"{index:03}_left.png").write_bytes(frame.left.data)
            (tmp_path / f"{index:03}_right.png").write_bytes(frame.right.data)
    assert run("new_recording_format", tmp_path, tmp_path).startswith("numbered-pairs: 3 frames of stereo, ")


def test_localize_in_it(site: Path, tmp_path: Path) -> None:
    said = run("localize_in_it", site, "survey.mcap", "maps", "lab", tmp_path / "out.tum", tmp_path / "out.png")
    assert "TRACKING: " in said
    assert len(read_tum(tmp_path / "out.tum")) > 20
    assert (tmp_path / "out.png").exists()


def test_fleet_figures(site: Path, tmp_path: Path) -> None:
    shutil.copytree(site / "maps", tmp_path / "maps")
    with open_store(tmp_path / "maps") as maps:
        batch, hour = FleetBatch(), hour_of(time.time_ns())
        for axis, key in (("site", ""), ("robot", "tug-7"), ("version", "1")):
            batch.add("lab", axis, key, hour, Counters(driving_ms=57_600_000, observed_ms=60_000_000, failures=2))
        maps.fleet.add(batch)
    said = run("fleet_figures", tmp_path, "maps", "lab")
    assert "lab, version 1, last 24 h:    16.0 h, 2.00 failures a day" in said
    assert "robot    tug-7" in said


def test_first_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run_notebook("first_map", tmp_path, monkeypatch)
    assert names["draft"].version == 1
    assert names["result"].report["localised_share"] > 0.5


def test_reading_a_map(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(run_notebook("reading_a_map", site, monkeypatch)["seen"]) > 3
