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
from fleetmap.sources.replay_source import ReplaySource
from locclient.identity import MapAddress
from locclient.localization.settings import LocalizerSettings
from locclient.maps.connection import connected
from locclient.replay.replay import ReplayOptions, replay
from locclient.replay.run_result import ReplayResult

SITE = "hall"
LIBRARIES = ("numpy", "opencv-python-headless")


def parsed(description: str | None, names: Iterable[str]) -> argparse.Namespace:
    """The options that these benchmarks share: `only` some of the names, the `work` folder, made where it is not there, and `out`."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--only", action="append", default=[], choices=list(names))
    parser.add_argument("--work", type=Path, default=kept_folder())
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    return arguments


def kept_folder() -> Path:
    """Where recordings and map are kept unless another folder is named."""
    return Path(os.environ.get("FLEETMAP_BENCH_WORK", tempfile.gettempdir())) / "localization"


def resident_mb() -> dict[str, float]:
    """10^6 bytes of this process in memory, and of those what is not mapped from disk. Linux."""
    wanted = {"VmRSS": "resident", "RssAnon": "anonymous"}
    rows = (line.split() for line in Path("/proc/self/status").read_text().splitlines())
    return {wanted[row[0][:-1]]: float(row[1]) * 1.024e-3 for row in rows if row and row[0][:-1] in wanted}


def show(name: str, figures: dict[str, Any]) -> None:
    """A table of figures."""
    print(f"\n{name}")
    for key, value in figures.items():
        if isinstance(value, dict):
            shown = "  ".join(f"{k} {v:.3g}" for k, v in value.items())
        else:
            shown = "-" if value is None else f"{value:.4g}"
        print(f"  {key:22} {shown:>12}", flush=True)


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


def surveyed(work: Path, seed: int | None = None, scenario: str = "small-loop") -> Path:
    """The store with the map of the survey of a site, in the frame of the truth; the simulator's first site without a seed."""
    options, name = ((), "") if seed is None else (("--seed", str(seed)), f"-{seed}")
    if scenario != "small-loop":
        name = f"-{scenario}{name}"
    store = work / f"store{name}"
    if not (store / "built").exists():
        to_store = ["--site", SITE, "--store", str(store)]
        survey = recorded(work, options, scenario)
        report = ["--report", str(work / f"survey{name}.json")]
        subprocess.run(
            [*tool("mapserver"), "build", str(survey), *to_store, "--frame-from-ground-truth", *report], check=True
        )
        subprocess.run([*tool("mapserver"), "publish", *to_store], check=True)
        (store / "built").touch()
    return store


def warmed_up(path: Path, store: Path) -> None:
    """Kernels are compiled and kept by another process: who compiles takes twice a robot's memory."""
    short = ["--store", str(store), "--site", SITE, "--frames", ":60"]
    subprocess.run([*tool("locclient"), "replay", str(path), *short], check=True, stdout=subprocess.DEVNULL)


def played(
    path: Path, store: Path, settings: LocalizerSettings, frames: str = ":", *, reverse: bool = False
) -> ReplayResult:
    """The recording replayed in the store's map, as `locclient replay` does."""
    address = MapAddress(site=SITE, robot="bench", store=str(store))
    with open_recording(path) as recording, connected(address) as link:
        source = ReplaySource.of(recording, FrameSelection.parse(frames), reverse=reverse)
        return replay(source, link, ReplayOptions(settings))
