"""Surveys that are mapped while they drive: whether tracking and mapping keep up with frames that come at their own speed.

    PYTHONPATH=tests python tests/benchmarks/survey/bench_live.py RECORDING... [--frames 0:400]

The draft at the end is that of `build`, to the byte, so that its accuracy is not measured again. On a machine that does nothing else.
"""

import argparse
import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from fleetmap.live_survey import LiveSurveyState
from mapserver.build.build import BuildOptions
from mapserver.build.survey_recordings import RecordingOptions
from mapserver.config import survey_settings
from mapserver.live import LiveRequest, RecordedDrive, run_live

LATENCY_LIMIT_MS = 33.0  # of 0.99 of the frames
LAG_LIMIT_S = 2.0  # from a keyframe to the map that shows it


def bench(recordings: Sequence[Path], frames: str = "::") -> Iterator[dict[str, Any]]:
    """A row for each recording, played at its own speed."""
    for path in recordings:
        told: list[LiveSurveyState] = []
        with tempfile.TemporaryDirectory() as folder, RecordingOptions(frames).open(path) as (opened, indices):
            settings = survey_settings(None, opened.sensor_set)
            drive = RecordedDrive(path, opened, indices, frames, 1.0)
            request = LiveRequest("live", Path(folder) / "store", settings, BuildOptions(frames=frames))
            result = run_live(request, drive, told.append, lambda: False, Console(quiet=True))
        report = result.built.report
        row = {"recording": path.name, "states": len(told), "ate_rmse_m": report.get("ate_rmse_m")}
        yield row | result.figures._asdict()


def main() -> None:
    """Prints a line for each recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--frames", default="::")
    options = parser.parse_args()
    for row in bench(options.recordings, options.frames):
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
