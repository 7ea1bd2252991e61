"""Rendered, truly identical aisles: 118 m through three of them with one true revisit, built with the gate and without it.

`python tests/benchmarks/back_end/bench_loops.py [--recording FILE.mcap] [--out FILE.json]` prints both builds; a recording that does
not exist yet is made there (minutes), in a temporary folder where none is named.
"""

import benchmarks.common.one_core  # noqa: F401 -- first of all, before numpy

# isort: split
import argparse
import json
import platform
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from unittest.mock import patch

import msgspec
import numpy as np

from fleetmap.bow.shipped_vocabulary import default_vocabulary
from fleetmap.geometry import se3_inverse
from fleetmap.recordings import OpenOptions, Recording, open_recording
from fleetmap.sensors.rectification import Rectifier
from fleetsim.commands import record_order
from fleetsim.motion.routes import Route
from fleetsim.recorder import Order
from fleetsim.scenarios import SCENARIOS, Run, Scenario
from fleetsim.scene.layout import Layout
from mapserver.build.report import accuracy
from mapserver.survey.loops.loops import LoopVerdict
from mapserver.survey.pipeline import survey
from mapserver.survey.settings import LoopSettings, SurveySettings
from mapserver.survey.survey_inputs import SurveyConfig, SurveyInputs

NAME = "identical-aisles-118m"
MAX_ATE_M = 0.025
# A loop that is off by more than half of the smallest step by which the site repeats takes one place for another. Below that it
# sees the right thing, from as far as six metres along an aisle with sigmas of a quarter of a metre.
TRUE_EDGE_M = 0.5 * Layout.bay_m
UNGATED = LoopSettings(max_innovation=np.inf, view_range_depths=1e9, rotation_sigma_limit_rad=0.0)


@dataclass(frozen=True, slots=True)
class Closed:
    """One build against the truth.

    right, wrong: accepted loops that measure where the old keyframe truly is, and others. revisits: keyframes that come by a
    place seen long before, facing the same way; closed: those of them with a right loop.
    """

    ate_m: float
    path_m: float
    keyframes: int
    candidates: int
    right: int
    wrong: int
    ambiguous: int
    revisits: int
    closed: int
    seconds: float

    @property
    def precision(self) -> float:
        """Share of the accepted loops that are right; 1 where none is accepted."""
        return self.right / max(self.right + self.wrong, 1) if self.right + self.wrong else 1.0

    @property
    def recall(self) -> float:
        """Share of the revisiting keyframes that are closed."""
        return self.closed / max(self.revisits, 1)


def three_aisles() -> Scenario:
    """Up the first aisle, down the second, up the third, and into the second again as before."""
    layout = Layout(aisles=4, bays=8, has_landmarks=False, are_aisles_identical=True)
    y = [layout.aisle_y_m(aisle) for aisle in range(3)]
    left, right = 2.7, layout.length_m - 2.7
    ways = ((left, y[0]), (right, y[0]), (right, y[1]), (left, y[1]), (left, y[2]), (right, y[2]), (right, y[1]))
    route = Route((*ways, (right - 16.0, y[1])))
    return Scenario("three of four identical aisles", layout, {"survey": Run("surveyor", (route,), is_sharp=True)})


def record(path: Path) -> None:
    """Records the drive unless it is there already."""
    if not path.exists():
        with patch.dict(SCENARIOS, {NAME: three_aisles}):
            print(record_order(Order(NAME), path, "mcap"), flush=True)


def build(recording: Recording, settings: SurveySettings) -> Closed:
    """One survey, judged."""
    begun = time.perf_counter()
    rectifier, count = Rectifier(recording.calibration), len(recording.frame_stamps_ns)
    frames = (recording.read_frame(index) for index in range(count))
    inputs = SurveyInputs(frames, count, recording.imu, recording.calibration, rectifier)
    done = survey(inputs, SurveyConfig(settings, default_vocabulary()))
    seconds = time.perf_counter() - begun
    truth = recording.ground_truth
    assert truth is not None
    found = accuracy(done.map, truth).rigid
    assert found is not None
    at = np.searchsorted(truth.stamps_ns, [k.stamp_ns for k in done.odometry.keyframes])
    true_map_from_body = truth.frame_from_body[np.minimum(at, len(truth.stamps_ns) - 1)]
    places = true_map_from_body[:, :3, 3]
    off = [e.i_from_j @ se3_inverse(true_map_from_body[e.j]) @ true_map_from_body[e.i] for e in done.loops.edges]
    right = [bool(np.linalg.norm(error[:3, 3]) < TRUE_EDGE_M) for error in off]
    revisits = _revisits(true_map_from_body, settings.loops.min_gap_keyframes)
    closed = {edge.i for edge, good in zip(done.loops.edges, right, strict=True) if good}
    return Closed(
        found.rmse_m, float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()), len(places), len(done.loops.records),
        sum(right), len(right) - sum(right), sum(r.verdict is LoopVerdict.AMBIGUOUS for r in done.loops.records),
        len(revisits), len(closed & revisits), seconds,
    )  # fmt: skip


def _revisits(map_from_body: np.ndarray, min_gap: int) -> set[int]:
    """Keyframes within half a metre and 20 degrees of one that lies a drive of ten metres back."""
    places, ahead = map_from_body[:, :3, 3], map_from_body[:, :3, 0]
    driven = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    found = set()
    for i in range(min_gap, len(places)):
        before = np.flatnonzero(driven[: i - min_gap + 1] < driven[i] - 10.0)
        near = np.linalg.norm(places[before] - places[i], axis=1) < 0.5
        if (near & (ahead[before] @ ahead[i] > np.cos(np.radians(20.0)))).any():
            found.add(i)
    return found


def bench(recording_path: Path) -> dict[str, Closed]:
    """Both builds."""
    record(recording_path)
    settings = SurveySettings()
    ungated = msgspec.structs.replace(settings, loops=UNGATED)
    with open_recording(recording_path, OpenOptions()) as recording:
        return {"gate": build(recording, settings), "no gate": build(recording, ungated)}


def show(found: dict[str, Closed]) -> None:
    """Prints the table."""
    print(f"\n{'':8s}   ATE m  loops right wrong ambiguous  precision  recall (revisits)  seconds")
    for name, row in found.items():
        print(
            f"{name:8s} {row.ate_m:7.4f} {row.candidates:6d} {row.right:5d} {row.wrong:5d} {row.ambiguous:9d} "
            f"{row.precision:10.3f} {row.recall:7.3f} ({row.revisits:4d})      {row.seconds:7.1f}"
        )


def main() -> None:
    """Prints the table; writes it as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = bench(options.recording or Path(folder) / "identical.mcap")
    show(found)
    if options.out is not None:
        rows = {name: asdict(row) | {"precision": row.precision, "recall": row.recall} for name, row in found.items()}
        head = {"machine": platform.machine(), "python": platform.python_version()}
        options.out.write_text(json.dumps(head | rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
