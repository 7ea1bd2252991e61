"""Recordings of the simulator and the map of one of them, kept in a work folder for all benchmarks that replay robots in it."""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from fleetmap.recordings import FrameSelection, open_recording
from fleetmap.sources.replay_source import ReplaySource
from locclient.identity import MapAddress
from locclient.localization.settings import LocalizerSettings
from locclient.maps.map_client import connected
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
            parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=default)
        parser.add_argument("--work", type=Path, default=kept_folder())
        parser.add_argument("--out", type=Path)
        options = parser.parse_args()
        options.only = options.only or list(names)
        options.work.mkdir(parents=True, exist_ok=True)
        write_results(options.out, measure(options))
        return measure

    return run


def kept_folder() -> Path:
    """Where recordings and maps of this code are kept unless another folder is named: other code may make others."""
    root, code = Path(__file__).parents[3], hashlib.sha256()
    for path in sorted(p for room in ("shared", "mapserver") for p in (root / room).rglob("*") if p.suffix in _CODE):
        code.update(path.read_bytes())
    return Path(os.environ.get("FLEETMAP_BENCH_WORK", tempfile.gettempdir())) / "localization" / code.hexdigest()[:12]


def resident_mb() -> dict[str, float]:
    """10^6 bytes of this process in memory, and of those what is not mapped from disk. Linux."""
    wanted = {"VmRSS": "resident", "RssAnon": "anonymous"}
    rows = (line.split() for line in Path("/proc/self/status").read_text().splitlines())
    return {wanted[row[0][:-1]]: float(row[1]) * 1.024e-3 for row in rows if row and row[0][:-1] in wanted}


def write_results(path: Path | None, results: Results) -> None:
    """Print the results as JSON, and write them where a file is asked for."""
    text = json.dumps(results, indent=2) + "\n"
    print(text)
    if path is not None:
        path.write_text(text, encoding="utf-8")


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


def played(
    path: Path, store: Path, settings: LocalizerSettings, frames: str = ":", *, reverse: bool = False
) -> ReplayResult:
    """The recording replayed in the store's map, as `locclient replay` does."""
    address = MapAddress(site=SITE, robot="bench", store=str(store))
    with open_recording(path) as recording, connected(address) as link:
        source = ReplaySource.of(recording, FrameSelection.parse(frames), reverse=reverse)
        return replay(source, link, ReplayOptions(settings))
