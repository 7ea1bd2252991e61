"""Robots in maps of real recordings: frames that did not make the map, backwards, and starts from nothing.

The map is made of the recording's even frames; robots see the odd ones, so with the survey's light and camera. Maps stay in the work
folder. CPU times are the process's.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.recorded_runs import Options, Results, benchmark, mapped, played
from benchmarks.common.yardstick import at_reference, mean_of, slowness
from benchmarks.robot.bench_localization import run_figures
from fleetmap.recordings import open_recording
from locclient.replay import run_metrics
from support.recordings.realdata import DATA
from support.room_site import KNOWN_RIG

MAPPED, UNSEEN = "0::2", "1::2"
_STARTS = 20


def drive(path: Path, store: Path, *, reverse: bool) -> dict[str, Any]:
    """All odd frames in a row."""
    frames = played(path, store, UNSEEN, reverse=reverse).frames
    return run_figures(frames) | {"localised": sum(run_metrics.localised(frames))}


def start_anywhere(path: Path, store: Path) -> dict[str, Any]:
    """The robot is switched on at one odd frame after another, spread over the recording, knowing nothing: the first frame's fix."""
    with open_recording(path) as recording:
        odd = np.arange(1, len(recording.frame_stamps_ns), 2)
    fixed, cpu_ms, errors_mm, slow = 0, [], [], []
    played(path, store, ":40")  # loads what computes
    for number in odd[np.linspace(0, len(odd) - 1, _STARTS).astype(int)].tolist():
        (frame,) = played(path, store, f"{number}:{number + 1}").frames
        fixed += frame.has_fix
        slow.append(slowness())
        cpu_ms.append(at_reference(1e3 * frame.cpu_s, slow[-1:]) or np.inf)
        if frame.has_fix and frame.error_m is not None:
            errors_mm.append(1e3 * frame.error_m)
    return {
        "starts": _STARTS,
        "fixed_on_first_frame": fixed,
        "slowness": mean_of(slow),
        "ready_in_60_ms_at_reference": sum(ms <= 60 for ms in cpu_ms),
        "cpu_median_ms_at_reference": float(np.median(cpu_ms)),
        "cpu_max_ms_at_reference": max(cpu_ms),
        "error_max_mm": max(errors_mm, default=None),
    }


# How the odd frames of a recording are met.
CASES: dict[str, Callable[[Path, Path], dict[str, Any]]] = {
    "euroc_v101_keyframes, held out": partial(drive, reverse=False),
    "euroc_mh01_start, held out, backwards": partial(drive, reverse=True),
    "euroc_mh01_start, first fix from nothing": start_anywhere,
}


def robots_map(work: Path, path: Path, frames: str = MAPPED) -> Path:
    """A store with the map of some frames, the even ones unless others are named."""
    store = work / path.stem / ("store" if frames == MAPPED else f"store-{frames.replace(':', '-')}")
    return mapped(store, path, work / f"{path.stem}.json", frames=frames, accepted=KNOWN_RIG)


@benchmark(CASES)
def main(arguments: Options) -> Results:
    found = {}
    for name in arguments.only:
        folder = DATA / name.partition(",")[0]
        found[name] = CASES[name](folder, robots_map(arguments.work, folder))
    return {"cases": found}
