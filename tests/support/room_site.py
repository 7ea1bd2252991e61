"""A published map of the box room, a robot's ride in it, and the programs' commands run in this process."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from typer.testing import CliRunner, Result

from fleetmap.geometry import Array
from locclient.cli import app as locclient_app
from mapserver.cli import app as mapserver_app
from support.recordings.recording_samples import START_NS, write_mcap
from support.worlds.box_room import out_and_back, ride_sample

FRAMES, FRAME_S = 50, 0.1
# The rig of such short rides is known: they cannot judge the calibration, and their tests are about something else.
KNOWN_RIG = ("--trust-calibration", "--reason", "the rig is known")


def invoke(app: Any, *arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def run(app: Any, *arguments: object) -> str:
    """The output of a command that must succeed; raises what it raised."""
    result = invoke(app, *arguments)
    if result.exception is not None:
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def process(module: str, *arguments: object) -> list[str]:
    """Arguments of a command as a process of its own."""
    return [sys.executable, "-c", f"from {module} import main; main()", *(str(argument) for argument in arguments)]


class RoomSite:
    """A folder with `survey`, a published map of it in the truth's frame in `store`, and the recording `robot` of another ride."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.store, self.robot = folder, folder / "store", folder / "robot"
        write_mcap(folder / "survey", ride_sample(out_and_back(6.0), 60, FRAME_S))
        ride = out_and_back(5.0, reach_m=2.1, start_m=(-1.0, 0.3, 0.15), yaw_rad=1.45)
        self._ride = ride_sample(ride, FRAMES, FRAME_S, seed=1)
        write_mcap(self.robot, self._ride)
        to_store = ("--site", "lab", "--store", self.store)
        report = folder / "build.json"
        run(mapserver_app, "build", folder / "survey", *to_store, "--frame-from-ground-truth", "--report", report)
        run(mapserver_app, "publish", *to_store, *KNOWN_RIG)
        self.build_report: dict[str, Any] = json.loads(report.read_text())

    def replay(self, out: Path, *options: object, store: Path | None = None) -> dict[str, Any]:
        """The report of a replay that leaves r.json, r.tum and r.png in `out`."""
        files = ["--report", out / "r.json", "--trajectory", out / "r.tum", "--picture", out / "r.png"]
        run(locclient_app, "replay", self.robot, "--site", "lab", "--store", store or self.store, *files, *options)
        report: dict[str, Any] = json.loads((out / "r.json").read_text())
        return report

    def true_positions(self, stamps_s: Array) -> Array:
        """(N, 3) of the robot's ride."""
        number = np.rint((stamps_s - START_NS * 1e-9) / FRAME_S).astype(int)
        return np.array(self._ride.world_from_body)[number, :3, 3]
