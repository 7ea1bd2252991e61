"""Recordings of the simulator and the map of one of them, kept in a work folder for all benchmarks that replay robots in it."""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import psutil

from fleetmap.recordings import FrameSelection, open_recording
from fleetmap.sources.source import ReplaySource
from fleetsim.recorder import Order, record_order
from fleetsim.scenarios import SCENARIOS, Scenario
from locclient.identity import MapAddress
from locclient.localization.settings import LocalizerSettings
from locclient.maps.map_client import connected
from locclient.maps.map_source import MapSource
from locclient.replay.replay import ReplayOptions, replay
from locclient.replay.run_result import ReplayResult

Options, Results = argparse.Namespace, dict[str, Any]
Measure = Callable[[Options], Results]

SITE = "hall"
_CODE = {".py", ".cpp", ".h", ".fmvb"}


def benchmark(names: Iterable[str] = (), several: str = "", **numbers: int) -> Callable[[Measure], Measure]:
    """Runs a function with these options where its file is the program, prints its results as JSON, and writes them to `--out`.

    `--only`: some of the names, all by default; numbers with these defaults; the `--work` folder, made if missing; `several`: one and
    more of what is called so.
    """

    def run(measure: Measure) -> Measure:
        if measure.__module__ != "__main__":
            return measure
        description = sys.modules["__main__"].__doc__
        parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
        if several:
            parser.add_argument(several, nargs="+")
        parser.add_argument("--only", action="append", choices=list(names))
        for name, default in numbers.items():
            parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=default, help=f"{default} by default")
        parser.add_argument("--work", type=Path, default=kept_folder())
        parser.add_argument("--out", type=Path)
        options = parser.parse_args()
        options.only = options.only or list(names)
        options.work.mkdir(parents=True, exist_ok=True)
        text = json.dumps(measure(options), indent=2) + "\n"
        print(text)
        if options.out is not None:
            options.out.write_text(text, encoding="utf-8")
        return measure

    return run


def kept_folder() -> Path:
    """Where recordings and maps of this code are kept unless another folder is named: other code may make others."""
    root, code = Path(__file__).parents[3], hashlib.sha256()
    for path in sorted(p for room in ("shared", "mapserver") for p in (root / room).rglob("*") if p.suffix in _CODE):
        code.update(path.read_bytes())
    return Path(os.environ.get("FLEETMAP_BENCH_WORK", tempfile.gettempdir())) / "localization" / code.hexdigest()[:12]


def resident_mb(pid: int | None = None) -> float:
    """10^6 bytes of a process in memory, of this one by default."""
    return psutil.Process(pid).memory_info().rss / 1e6


def tool(name: str) -> list[str]:
    """The command of this checkout, as users have it: without pandas, which sqlite-utils imports where development's extra brings it."""
    return [sys.executable, "-c", f"import sys; sys.modules['pandas'] = None; from {name}.cli import main; main()"]


def recorded(work: Path, options: tuple[str, ...], scenario: str = "small-loop") -> Path:
    """The recording of `fleetsim record SCENARIO OPTIONS`, made where it is not there yet."""
    name = "-".join((scenario, *(option.lstrip("-") for option in options))) + ".mcap"
    if not (work / name).exists():
        subprocess.run([*tool("fleetsim"), "record", scenario, *options, "--out", str(work / name)], check=True)
    return work / name


def rendered(path: Path, order: Order, scenario: Scenario) -> Path:
    """The recording of a run of this scenario, made where it is not there yet."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with patch.dict(SCENARIOS, {order.scenario: lambda: scenario}):
            record_order(order, path.with_suffix(".part"))
        path.with_suffix(".part").rename(path)
    return path


def surveyed(work: Path, seed: int | None = None, scenario: str = "small-loop") -> Path:
    """The store with the map of the survey of a site; the simulator's first site without a seed."""
    options, name = ((), "") if seed is None else (("--seed", str(seed)), f"-{seed}")
    if scenario != "small-loop":
        name = f"-{scenario}{name}"
    return mapped(work / f"store{name}", recorded(work, options, scenario), work / f"survey{name}.json")


def mapped(
    store: Path, recording: Path, report: Path, *, frames: str = ":", accepted: Sequence[str] = (), site: str = SITE
) -> Path:
    """A store with the map of a recording's frames in the frame of the truth, made where it is not there yet; the build's report.

    accepted: options of `mapserver publish`.
    """
    built = store / ("built" if site == SITE else f"built-{site}")
    if not built.exists():
        store.parent.mkdir(parents=True, exist_ok=True)
        to_store = ["--site", site, "--store", str(store)]
        options = ["--frames", frames, "--frame-from-ground-truth", "--report", str(report)]
        subprocess.run([*tool("mapserver"), "build", str(recording), *to_store, *options], check=True)
        subprocess.run([*tool("mapserver"), "publish", *to_store, *accepted], check=True)
        built.touch()
    return store


def robot_in(store: Path) -> AbstractContextManager[MapSource]:
    """A robot's way to the store's map."""
    return connected(MapAddress(site=SITE, robot="bench", store=str(store)))


def replayed(source: ReplaySource, store: Path, settings: LocalizerSettings | None = None) -> ReplayResult:
    """A source's frames in the store's map, as `locclient replay` does."""
    with robot_in(store) as link:
        return replay(source, link, ReplayOptions(settings or LocalizerSettings()))


def played(path: Path, store: Path, frames: str = ":", *, reverse: bool = False) -> ReplayResult:
    """A recording's frames in the store's map."""
    with open_recording(path) as recording:
        return replayed(ReplaySource.of(recording, FrameSelection.parse(frames), reverse=reverse), store)
