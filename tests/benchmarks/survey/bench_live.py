"""Surveys that are mapped while they drive: whether tracking and mapping keep up with frames that come at their own speed.

    PYTHONPATH=tests python tests/benchmarks/survey/bench_live.py RECORDING... [--out FILE.json]

The draft at the end is that of `build`, to the byte, so that its accuracy is not measured again. On a machine that does nothing else.
"""

import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.common.recorded_runs import Options, Results, benchmark
from mapserver.config import survey_settings
from mapserver.drafting.draft import BuildOptions
from mapserver.drafting.survey_recordings import RecordingOptions
from mapserver.plugins.live_surveys.drives import RecordedDrive
from mapserver.plugins.live_surveys.live_survey import LiveRequest, run_live


def bench(path: Path) -> dict[str, Any]:
    """Figures of a recording, played at its own speed."""
    opened, indices = RecordingOptions().opened(path)
    with tempfile.TemporaryDirectory() as folder, opened:
        settings = survey_settings(None, opened.sensor_set)
        drive = RecordedDrive(path, opened, indices, "::", 1.0)
        request = LiveRequest("live", Path(folder) / "store", settings, BuildOptions())
        return run_live(request, drive, lambda _: None, lambda: False, Console(quiet=True))[0]._asdict()


@benchmark(several="recordings")
def main(options: Options) -> Results:
    return {Path(path).name: bench(Path(path)) for path in options.recordings}
