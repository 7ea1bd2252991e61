"""Four rendered drives of one hall joined into one map, and two halves of each real recording.

Each drive maps three of nine aisles and shares the last with the next drive. The halves of a real recording are its even and its odd pairs.
Joined as in one night: all sessions are adjusted together. Joined to a published map: the first session is published, the others extend it.
Errors are those of all frames after rigid alignment; moved: the distance by which the map's earlier keyframes leave their place.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import msgspec
import numpy as np
from rich.console import Console

from benchmarks.common.recorded_runs import Options, Results, benchmark, rendered
from fleetmap.bow.vocabulary import default_vocabulary
from fleetmap.geometry import Array
from fleetmap.sensors.rectification import StereoCamera
from fleetmap.sensors.samples import Trajectory
from fleetsim.motion import Route
from fleetsim.recorder import Order
from fleetsim.scenarios import Run, Scenario
from fleetsim.scene.layout import Layout
from mapserver.config import survey_settings
from mapserver.drafting import survey_recordings
from mapserver.evaluation.trajectory_error import absolute_trajectory_error
from mapserver.survey.merge import multi_session
from mapserver.survey.merge.base_map import BaseMap
from mapserver.survey.merge.changes import SurveyLimits
from mapserver.survey.merge.joint_adjustment import JointSolution
from mapserver.survey.merge.multi_session import MapMerger, MergedMap, Session
from mapserver.survey.survey_inputs import SurveyConfig, SurveyTools
from mapserver.survey.survey_map import SurveyMap
from support.recordings.realdata import DATA

DRIVES, _RATE_HZ, _END_M = 4, 7.5, 2.7
_SHORT_M = 10.0  # a session moves three metres at least, and some more back and forth
REAL = "euroc_mh01_start", "euroc_v101_keyframes"


def blocks() -> Scenario:
    """A hall of nine aisles, and a drive for each block of three."""
    layout = Layout(aisles=2 * DRIVES + 1, bays=6)
    left, right = _END_M, layout.length_m - _END_M
    runs = {}
    for n in range(DRIVES):
        a, b, c = (layout.aisle_y_m(2 * n + k) for k in range(3))
        aside = left + 0.6
        ends = [(left, a), (left, c), (aside, c), (aside, a)]
        aisles = [(right, a), (right, b), (left, b), (left, c), (right, c)]
        runs[f"drive-{n}"] = Run("surveyor", (Route((*ends, *aisles)),), rate_hz=_RATE_HZ, is_sharp=True)
    return Scenario("nine aisles in four drives", layout, runs)


def surveyed(path: Path, frames: str, pinhole: StereoCamera | None) -> survey_recordings.RecordingSurvey:
    """The survey of a recording's frames, without a store."""
    reading = survey_recordings.OpenRecordings(survey_recordings.RecordingOptions(frames), path.parent)
    admitted = survey_recordings.admit_recordings([path], reading, Console(quiet=True), needs_truth=True)
    with reading.open(path) as (recording, _):
        settings = survey_settings(None, recording.sensor_set)
    config = SurveyConfig(settings, default_vocabulary())
    return survey_recordings.survey_recording(path, admitted[path], reading, pinhole, config, SurveyTools())[0]


def ate_m(trajectories: Sequence[Trajectory], surveys: Sequence[survey_recordings.RecordingSurvey]) -> float:
    """Of all estimated frames, after one alignment."""
    found, true = list[Array](), list[Array]()
    for trajectory, survey in zip(trajectories, surveys, strict=True):
        for n in np.flatnonzero(survey.survey.map.trajectory_estimated).tolist():
            place = survey.truth.at(int(trajectory.stamps_ns[n]))
            if place is not None:
                found.append(trajectory.frame_from_body[n])
                true.append(place)
    stamps_ns = np.arange(len(true), dtype=np.int64)
    return absolute_trajectory_error(
        Trajectory(stamps_ns, np.array(found)), Trajectory(stamps_ns, np.array(true))
    ).rmse_m


def added(base: SurveyMap | None, surveys: Sequence[survey_recordings.RecordingSurvey]) -> MergedMap:
    """The map with these sessions; RuntimeError if one is not joined."""
    settings = survey_settings(None, surveys[0].sensor_set)
    way_m = np.diff(surveys[0].survey.map.trajectory.positions_m, axis=0)
    if np.linalg.norm(way_m, axis=1).sum() < _SHORT_M:  # whether such halves belong together is no question here
        settings = msgspec.structs.replace(settings, sessions=msgspec.structs.replace(settings.sessions, min_places=1))
    joining = MapMerger(base, settings, SurveyLimits())
    for each in surveys:
        joining.add(Session(each.survey, each.map_from_survey))
    found = joining.finish()
    for outcome in found.outcomes:
        if not outcome.joined:
            raise RuntimeError(f"session {outcome.number}: {outcome.reason}")
    return found


@contextmanager
def noted_moves() -> Iterator[list[Array]]:
    """The distances (B,) by which each adjustment moves the map's keyframes; a published map itself keeps them where that is in doubt."""
    moves = list[Array]()
    adjust = multi_session.adjust_jointly

    def noting(base: BaseMap, *rest: Any, finely: bool) -> JointSolution:
        solution = adjust(base, *rest, finely=finely)
        if finely:
            before = base.map_from_body[solution.base_keyframes]
            moves.append(np.linalg.norm((solution.base_from_body - before)[:, :3, 3], axis=1))
        return solution

    with patch.object(multi_session, "adjust_jointly", noting):
        yield moves


def joined(surveys: Sequence[survey_recordings.RecordingSurvey]) -> dict[str, Any]:
    """Errors alone, joined in one night, and joined one by one to a published map."""
    alone = [ate_m([each.survey.map.trajectory], [each]) for each in surveys]
    shares = [float(each.survey.map.trajectory_estimated.mean()) for each in surveys]
    row: dict[str, Any] = {"alone_m": alone, "mean_alone_m": float(np.mean(alone)), "estimated_share": shares}
    night = added(None, surveys)
    published = added(None, surveys[:1]).map
    trajectories, changed = [published.trajectory], 0
    with noted_moves() as moves:
        for each in surveys[1:]:
            found = added(published, [each])
            published, trajectories = found.map, [*trajectories, *found.trajectories]
            changed += sum(o.counts.keyframes_moved for o in found.outcomes if o.counts is not None)
    for name, places in (("night", night.trajectories), ("published", trajectories)):
        each_m = [ate_m([place], [survey]) for place, survey in zip(places, surveys, strict=True)]
        whole_m, ratio = ate_m(places, surveys), float(np.mean(each_m) / np.mean(alone))
        row[name] = {"each_m": each_m, "each_to_alone": ratio, "ate_m": whole_m, "to_alone": whole_m / np.mean(alone)}
    row["published"] |= {
        "keyframes_changed": changed,
        "moved_max_m": [float(move.max()) for move in moves],
        "moved_rms_m": [float(np.sqrt(np.square(move).mean())) for move in moves],
    }
    return row


@benchmark(("drives", *REAL), seed=60817)
def main(given: Options) -> Results:
    figures = {}
    for name in given.only:
        surveys = list[survey_recordings.RecordingSurvey]()
        parts = [(DATA / name, f"{half}::2") for half in range(2)]
        if name == "drives":
            orders = [Order("blocks", given.seed, robot=f"drive-{n}") for n in range(DRIVES)]
            parts = [(rendered(given.work / f"blocks-{o.seed}-{o.robot}.mcap", o, blocks()), "::") for o in orders]
        for path, frames in parts:
            surveys.append(surveyed(path, frames, surveys[0].survey.state.rig.camera if surveys else None))
        figures[name] = joined(surveys)
    return figures
