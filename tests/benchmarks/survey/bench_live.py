"""Surveys that are mapped while they drive: whether tracking and mapping keep up with frames that come at their own speed.

    PYTHONPATH=tests python tests/benchmarks/survey/bench_live.py RECORDING... [--frames 0:400] [--out FILE.json]

The draft at the end is that of `build`, to the byte, so that its accuracy is not measured again. On a machine that does nothing else.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from fleetmap.live_survey import LiveSurveyState
from mapserver.config import survey_settings
from mapserver.drafting.draft import BuildOptions
from mapserver.drafting.survey_recordings import RecordingOptions
from mapserver.live import LiveRequest, RecordedDrive, run_live


def bench(recordings: Sequence[Path], frames: str = "::") -> Iterator[dict[str, Any]]:
    """A row for each recording, played at its own speed."""
    for path in recordings:
        told: list[tuple[float, LiveSurveyState]] = []
        with tempfile.TemporaryDirectory() as folder, RecordingOptions(frames).open(path) as (opened, indices):
            settings = survey_settings(None, opened.sensor_set)
            drive = RecordedDrive(path, opened, indices, frames, 1.0)
            request = LiveRequest("live", Path(folder) / "store", settings, BuildOptions(frames=frames))
            hear = partial(_hear, told)
            result = run_live(request, drive, hear, lambda: False, Console(quiet=True))
        assert result.built is not None
        row = {"recording": path.name, "states": len(told), "ate_rmse_m": result.built.report.get("ate_rmse_m")}
        row |= {"load": os.getloadavg()[0], "loop_visible_s": loop_visible_s(told)} | result.figures._asdict()
        yield row


def _hear(told: list[tuple[float, LiveSurveyState]], state: LiveSurveyState) -> None:
    told.append((time.monotonic(), state))


def loop_visible_s(told: Sequence[tuple[float, LiveSurveyState]]) -> float | None:
    """Longest time from a revisit's frame to the first state that shows it as believed; None without a revisit."""
    driving = [(heard_s, state) for heard_s, state in told if state.phase == "tracking" and state.frames]
    if not driving:
        return None
    begin_s = min(heard_s - state.seconds for heard_s, state in driving)
    first: dict[float, float] = {}
    for heard_s, state in driving:
        for revisit in state.revisits:
            if revisit.verdict == "accepted":
                first.setdefault(revisit.at_s, heard_s)
    return max((heard_s - begin_s - at_s for at_s, heard_s in first.items()), default=None)


def main() -> None:
    """Prints a line for each recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--frames", default="::")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = {}
    for row in bench(options.recordings, options.frames):
        rows[row["recording"]] = row
        print(json.dumps(row), flush=True)
    if options.out is not None:
        options.out.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
