"""What a build makes of recordings with something wrong: one line for each case.

`PYTHONPATH=tests python tests/benchmarks/survey/bench_hard_cases.py SURVEY.mcap OTHER_RUN.mcap [--frames ::2] [--only NAME...]
[--out FILE.json]`,
recordings of `fleetsim record small-loop` and of another robot there. A case is right when it is refused, or when every frame that the
map claims
to know is within 0.10 m of the truth.
"""

import argparse
import json
import platform
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fleetmap.errors import FleetmapError
from fleetmap.recordings import Recording, open_recording
from fleetmap.recordings.mcap.writer import copy_to_mcap
from mapserver.build.build import BuildOptions, BuildRequest, build_draft
from mapserver.config import MapserverConfig
from support.recordings.calibration_faults import IMAGE_FAULTS, camera_imu_turn, pair_turn
from support.recordings.spoiled_recording import (
    with_clock_shift,
    with_darkness,
    with_imu,
    with_lost_frames,
)

LIMIT_M = 0.10
Spoil = Callable[[Recording, Recording], Recording]
CASES: dict[str, Spoil] = {
    "nothing wrong": lambda good, _: good,
    "IMU of another run": lambda good, other: with_imu(good, other.imu),
    "left and right swapped": lambda good, _: IMAGE_FAULTS["swapped"].recording(good),
    "20 % of frames lost": lambda good, _: with_lost_frames(good, 0.2, np.random.default_rng(0)),
    "30 s of darkness": lambda good, _: with_darkness(good, 6.0, 36.0),
    "2 s of darkness": lambda good, _: with_darkness(good, 10.0, 12.0),
    "right camera tilted 1 degree": lambda good, _: pair_turn("pitch", 1.0).recording(good),
    "right camera toed in 1 degree": lambda good, _: pair_turn("yaw", 1.0).recording(good),
    "right camera rolled 1 degree": lambda good, _: pair_turn("roll", 1.0).recording(good),
    "cameras 1 degree off the IMU": lambda good, _: camera_imu_turn("yaw", 1.0).recording(good),
    "clock 20 ms late": lambda good, _: with_clock_shift(good, 0.02),
    "clock 20 ms early": lambda good, _: with_clock_shift(good, -0.02),
}


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a case ended: refused with these words, or a map with its errors over the frames that it claims to know."""

    case: str
    refused: str
    ate_rmse_m: float | None
    ate_max_m: float | None
    evaluated_share: float | None
    remarks: list[str]
    seconds: float

    @property
    def is_right(self) -> bool:
        """Refused, or exact wherever anything is claimed."""
        return bool(self.refused) or (self.ate_max_m is not None and self.ate_max_m < LIMIT_M)


def outcome(case: str, recording: Recording, frames: str) -> Outcome:
    """Builds it, from a file like any other."""
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy_to_mcap(recording, folder / "case.mcap")
        options = BuildOptions(frames, report=folder / "r.json")
        request = BuildRequest((folder / "case.mcap",), "hall", folder / "store", options)
        try:
            build_draft(request, MapserverConfig().survey)
        except FleetmapError as error:
            words = str(error).replace(f"{folder / 'case.mcap'}: ", "")
            return Outcome(case, words, None, None, None, [], round(time.monotonic() - started, 1))
        report: dict[str, Any] = json.loads((folder / "r.json").read_text())
    (remarks,) = report["findings"].values()
    return Outcome(
        case, "", report["ate_rmse_m"], report["ate_max_m"], report["evaluated_share"], remarks,
        round(time.monotonic() - started, 1),
    )  # fmt: skip


def show(found: Sequence[Outcome]) -> None:
    """The table."""
    print(f"{'case':30} {'right':5} {'ATE m':>7} {'max m':>7} {'share':>6}  what was said")
    for o in found:
        figures = " ".join(
            f"{'-' if value is None else format(value, '.4f'):>{width}}"
            for value, width in ((o.ate_rmse_m, 7), (o.ate_max_m, 7), (o.evaluated_share, 6))
        )
        print(f"{o.case:30} {'yes' if o.is_right else 'NO':5} {figures}  {o.refused or '; '.join(o.remarks)}")


def main() -> None:
    """Prints the table; writes JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("survey", type=Path)
    parser.add_argument("other", type=Path)
    parser.add_argument("--frames", default="::2")
    parser.add_argument("--only", action="append", default=[], choices=list(CASES))
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    found = []
    for case in arguments.only or CASES:
        with open_recording(arguments.survey) as good, open_recording(arguments.other) as other:
            found.append(outcome(case, CASES[case](good, other), arguments.frames))
        show(found[-1:])
    show(found)
    if arguments.out is not None:
        machine = {"machine": platform.processor() or platform.machine(), "python": platform.python_version()}
        arguments.out.write_text(json.dumps(machine | {"cases": [asdict(o) for o in found]}, indent=2) + "\n")


if __name__ == "__main__":
    main()
