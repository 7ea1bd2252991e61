"""The rim around surveys: opens recordings one after the other and surveys each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from fleetmap.bow import Vocabulary
from fleetmap.errors import RecordingError, SurveyError
from fleetmap.geometry import Array
from fleetmap.mapformat import RecordingEntry
from fleetmap.recordings import FrameSelection, OpenOptions, Recording, open_recording
from fleetmap.sensors.rectification import Rectifier, StereoCamera
from fleetmap.sensors.samples import DataIssue, PositionPrior, SensorSet, Trajectory
from mapserver.build.admission import checked, with_clock
from mapserver.build.draft_evidence import HeldOut, held_out_of
from mapserver.build.report import check_truth
from mapserver.build.sensor_subset import reduced
from mapserver.build.worker import read_ahead
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.finish.dock_alignment import aligned_by_priors, map_from_survey
from mapserver.survey.finish.map_transform import scaled, scaled_state
from mapserver.survey.keyframes.keyframes import ImageStore
from mapserver.survey.loops.zones import Zones
from mapserver.survey.pipeline import Progress, Survey, survey
from mapserver.survey.settings import SurveySettings


@dataclass(frozen=True)
class Surveyed:
    """One recording and its survey. placed: map_from_survey (4, 4) by its position priors, None without any.
    findings: what the doctor remarked. held_out: frames that the survey did not use.
    """

    entry: RecordingEntry
    format: str
    sensor_set: SensorSet
    issues: tuple[DataIssue, ...]
    truth: Trajectory | None
    survey: Survey
    placed: Array | None
    findings: tuple[str, ...]
    held_out: list[HeldOut]

    def remarks(self) -> list[str]:
        """What was wanting in the recording, what was corrected and what was left out, in words."""
        return [*self.findings, *(part.remark() for part in self.survey.parts if not part.kept)]


@dataclass(frozen=True, slots=True)
class Admission:
    """A recording that may be surveyed: its issues and the doctor's remarks, in words; the correction of its clocks."""

    remarks: tuple[str, ...]
    correction_s: float


def admit_recordings(
    paths: Sequence[Path], frames: str, calibration: Path | None, use: SensorSet | None, console: Console, *,
    needs_truth: bool, unusable: dict[Path, str] | None = None, worker: Executor = SERIAL,
) -> dict[Path, Admission]:  # fmt: skip
    """Examines all of them, and refuses before the work what could not end well.

    unusable: takes those that are refused, with the reason; without it, or where all are, that is an error.
    """
    admitted: dict[Path, Admission] = {}
    for path in paths:
        try:
            admitted[path] = _admission(path, frames, calibration, use, console, needs_truth, worker)
        except RecordingError as error:
            if unusable is None:
                raise
            unusable[path] = str(error)
    if not admitted:
        raise RecordingError(f"none of {len(paths)} recordings can be used: {'; '.join((unusable or {}).values())}")
    return admitted


def _admission(
    path: Path,
    frames: str,
    calibration: Path | None,
    use: SensorSet | None,
    console: Console,
    needs_truth: bool,
    worker: Executor,
) -> Admission:
    with open_recording(path, OpenOptions(calibration_file=calibration)) as opened:
        recording = reduced(opened, use)
        for issue in recording.issues:
            console.print(f"issue: {issue.what}: {issue.detail}", markup=False)
        _check(recording, FrameSelection.parse(frames).apply(recording), needs_truth)
        examined = checked(recording, worker=worker)
        for remark in examined.remarks():
            console.print(f"{recording.name}: {remark}", markup=False)
        return Admission(tuple(examined.remarks()), examined.correction_s)


def _check(recording: Recording, indices: NDArray[np.int64], needs_truth: bool) -> None:
    if needs_truth:
        check_truth(str(recording.path), recording.frame_stamps_ns[indices], recording.ground_truth)


def survey_recording(
    path: Path, admission: Admission, frames: str, calibration: Path | None, use: SensorSet | None, pinhole: StereoCamera | None,
    vocabulary: Vocabulary, settings: SurveySettings, zones: Zones, progress: Progress, shelf: ImageStore,
    worker: Executor = SERIAL,
) -> Surveyed:  # fmt: skip
    """Surveys one recording by the sensors of `use` (or all it has), as if `pinhole` (or what suits it) had seen it."""
    with open_recording(path, OpenOptions(calibration_file=calibration)) as opened:
        recording = with_clock(reduced(opened, use), admission.correction_s)
        indices = FrameSelection.parse(frames).apply(recording)
        rectifier = Rectifier(recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD, pinhole=pinhole)
        done = survey(
            read_ahead(rectifier.rectify(recording.read_frame(int(index))) for index in indices), len(indices), recording.imu,
            recording.calibration, rectifier, vocabulary, settings, zones, progress, shelf, recording.wheel, worker,
        )  # fmt: skip
        done, placed = _placed(done, recording.priors, recording.calibration.base_from_body)
        entry = RecordingEntry(name=recording.name, sha256=recording.content_hash(), frames=len(indices))
        held_out = held_out_of(recording, indices.tolist(), rectifier, done)
        return Surveyed(
            entry,
            recording.format,
            recording.sensor_set,
            recording.issues,
            recording.ground_truth,
            done,
            placed,
            admission.remarks,
            held_out,
        )


def _placed(done: Survey, priors: Sequence[PositionPrior], base_from_body: Array) -> tuple[Survey, Array | None]:
    """The survey, in metres where its priors give a scale that was unknown, and map_from_survey (4, 4) by them, None without any."""
    if done.map.scale_known:
        return done, map_from_survey(done.map, priors, base_from_body)
    anchoring = aligned_by_priors(done.map, priors, base_from_body)
    if anchoring is None:
        return done, None
    in_metres = replace(done, map=scaled(done.map, anchoring.scale), state=scaled_state(done.state, anchoring.scale))
    return in_metres, anchoring.map_from_survey


def survey_all(
    paths: Sequence[Path],
    survey_one: Callable[[Path, StereoCamera | None, Vocabulary], Surveyed],
    pinhole: StereoCamera | None,
    vocabulary: Vocabulary,
    unusable: dict[Path, str] | None = None,
) -> list[Surveyed]:
    """Surveys of all recordings through one camera and with one vocabulary.

    unusable: takes those that cannot be surveyed, with the reason; without it, or where none can be, that is an error.
    """
    done: list[Surveyed] = []
    for path in paths:
        try:
            done.append(survey_one(path, pinhole, vocabulary))
        except (RecordingError, SurveyError) as error:
            if unusable is None:
                raise
            unusable[path] = str(error)
            continue
        pinhole = pinhole or done[0].survey.state.camera
    if not done:
        raise SurveyError(f"none of {len(paths)} recordings can be surveyed: {'; '.join((unusable or {}).values())}")
    return done
