"""Recordings of the simulator and the map of one of them, kept in a work folder for all benchmarks that replay robots in it."""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

from fleetmap.recordings import FrameSelection, open_recording
from locclient.connection import connected
from locclient.replay import ReplayResult, replay
from locclient.settings import LocalizerSettings
from locclient.sources import ReplaySource

SITE = "hall"
LIBRARIES = ("numpy", "numba", "opencv-python-headless")


def parsed(description: str | None, names: Iterable[str]) -> argparse.Namespace:
    """The options that these benchmarks share: `only` some of the names, the `work` folder, made where it is not there, and `out`."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--only", action="append", default=[], choices=list(names))
    kept = Path(os.environ.get("FLEETMAP_BENCH_WORK", tempfile.gettempdir())) / "localization"
    parser.add_argument("--work", type=Path, default=kept)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    return arguments


def write_results(path: Path | None, results: dict[str, Any]) -> None:
    """The results as JSON beside machine, versions and command, where a file is asked for."""
    if path is None:
        return
    about = {
        "command": " ".join(sys.argv), "machine": platform.processor() or platform.machine(), "cores": os.cpu_count(),
        "python": platform.python_version(), **{name: version_of(name) for name in LIBRARIES},
    }  # fmt: skip
    path.write_text(json.dumps(about | results, indent=2) + "\n")


def tool(name: str) -> list[str]:
    """The command of this checkout."""
    return [sys.executable, "-c", f"from {name}.cli import main; main()"]


def recorded(work: Path, options: tuple[str, ...], scenario: str = "small-loop") -> Path:
    """The recording of `fleetsim record SCENARIO OPTIONS`, made where it is not there yet."""
    name = "-".join((scenario, *(option.lstrip("-") for option in options))) + ".mcap"
    if not (work / name).exists():
        subprocess.run([*tool("fleetsim"), "record", scenario, *options, "--out", str(work / name)], check=True)
    return work / name


def surveyed(work: Path) -> Path:
    """The store with the survey's map, in the frame of the truth."""
    store = work / "store"
    if not (store / "built").exists():
        to_store = ["--site", SITE, "--store", str(store)]
        survey = recorded(work, ())
        report = ["--report", str(work / "survey.json")]
        subprocess.run(
            [*tool("mapserver"), "build", str(survey), *to_store, "--frame-from-ground-truth", *report], check=True
        )
        subprocess.run([*tool("mapserver"), "publish", *to_store], check=True)
        (store / "built").touch()
    return store


def played(
    path: Path, store: Path, settings: LocalizerSettings, frames: str = ":", *, reverse: bool = False
) -> ReplayResult:
    """The recording replayed in the store's map, as `locclient replay` does."""
    options = {"site": SITE, "store": store, "server": None, "robot": "bench"}
    with open_recording(path) as recording, connected(options) as link:
        source = ReplaySource.of(recording, FrameSelection.parse(frames), reverse=reverse)
        return replay(source, link, settings, None, realtime=False, progress=lambda _: None)
