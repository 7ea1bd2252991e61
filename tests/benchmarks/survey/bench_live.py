"""Surveys that are mapped while they drive: whether tracking and mapping keep up with frames that come at their own speed.

The draft at the end is that of `build`, to the byte, so that its accuracy is not measured again. On a machine that does nothing else.
"""

import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.common.recorded_runs import Options, Results, benchmark
from mapserver.drafting.draft import BuildOptions, BuildRequest
from mapserver.plugins.live_surveys.drives import RecordedDrive
from mapserver.plugins.live_surveys.live_survey import run_live


def bench(path: Path) -> dict[str, Any]:
    """Figures of a recording, played at its own speed."""
    opened, indices = BuildOptions().opened(path)
    with tempfile.TemporaryDirectory() as folder, opened:
        drive = RecordedDrive(BuildRequest((path,), "live", Path(folder) / "store"), opened, indices, 1.0)
        figures = run_live(drive, [], lambda: False, Console(quiet=True))[0]._asdict()
        state = figures.pop("state")
        told = ("frames", "seconds", "keyframes", "latency_ms", "late_frames", "loops")
        return {name: getattr(state, name) for name in told} | figures | {"parts": len(state.parts)}


@benchmark(several="recordings")
def main(options: Options) -> Results:
    return {Path(path).name: bench(Path(path)) for path in options.recordings}
