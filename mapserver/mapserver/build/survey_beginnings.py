"""Surveys that a build's examination begins, and finishes while it goes on."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import FleetmapError
from fleetmap.recordings import Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, ImuSamples, Stamps, Trajectory
from mapserver.build.draft_evidence import HeldOut, likely_held_out, read_held_out
from mapserver.build.worker import read_ahead
from mapserver.calibration import CalibrationEstimate, estimate_from
from mapserver.calibration.problem import CalibrationData
from mapserver.calibration.recordings import LONGEST_S, Follow, stretch_of_chain
from mapserver.doctor import Verdict
from mapserver.doctor.calibration import findings_of
from mapserver.survey.chain import AdjustedChain
from mapserver.survey.executor import Executor, Work
from mapserver.survey.pipeline import Survey, begin_survey, finish_survey
from mapserver.survey.survey_inputs import SurveyConfig, SurveyInputs, SurveyTools

_SHARED_STRETCHES = 3  # of which a calibration takes one


@dataclass(frozen=True, slots=True)
class RecordedParts:
    """The selected frames (F,) of a recording as FrameParts: each part reads files of its own, and carries nothing of the others."""

    recording: Recording
    indices: NDArray[np.int64]

    @property
    def stamps_ns(self) -> Stamps:
        return self.recording.frame_stamps_ns[self.indices]

    def part(self, first: int, end: int) -> Iterable[CameraFrame]:
        part = self.recording.part(self.indices[first:end])
        return _Frames(replace(part, imu=ImuSamples.empty(), wheel=(), priors=(), ground_truth=None, issues=()))


@dataclass(frozen=True, slots=True)
class _Frames:
    recording: Recording

    def __iter__(self) -> Iterator[CameraFrame]:
        with self.recording as recording:
            for index in range(len(recording)):
                yield recording.read_frame(index)


@dataclass(frozen=True, slots=True)
class BegunSurvey:
    """A survey up to its loops, with the calibration and the rectifier that it was made with.

    done: all of it, if that far. held_out: frames that it is likely to hold out.
    """

    rig: RigCalibration
    rectifier: Rectifier
    chain: AdjustedChain
    done: Survey | None = None
    held_out: Work[list[HeldOut]] | None = None

    def finished(self, config: SurveyConfig, tools: SurveyTools) -> Survey:
        """All of it."""
        return self.done or finish_survey(self.chain, config, tools)


class _InVainError(Exception):
    """A survey is not finished, as its calibration is wrong."""


class SurveyBeginnings:
    """Begins surveys of recordings as a build's examination needs them; the last one goes on where its calibration is taken.

    Where the calibration can be estimated beside it, the survey goes on meanwhile. A recording that is much longer than the stretch
    from which its calibration is measured is not worth a survey that may be refused.
    """

    def __init__(self, config: SurveyConfig | None, tools: SurveyTools) -> None:
        """config: None where no survey may begin, and calibrations are measured by passes of their own."""
        self._config, self._tools = config, tools
        self.last: BegunSurvey | None = None

    @property
    def executor(self) -> Executor:
        return self._tools.executor

    def follow(self, recording: Recording, indices: NDArray[np.int64], *, is_given: bool) -> Follow | None:
        """How the calibration of these frames is to be estimated; None where that takes a pass of its own, as with given poses."""
        self.last = None
        config, tools = self._config, self._tools
        seconds = np.ptp(recording.frame_stamps_ns[indices]) * 1e-9 if len(indices) else 0.0
        if config is None or is_given or seconds > _SHARED_STRETCHES * LONGEST_S:
            return None

        def followed(given: Recording) -> Work[CalibrationEstimate]:
            self.last, rig = None, given.calibration
            inputs = survey_inputs_of(given, indices, Rectifier(rig), None)
            chain = begin_survey(inputs, config.settings, tools)
            stretch = stretch_of_chain(chain, given, (rig, inputs.rectifier))
            beside = tools.executor.beside(estimate_from, [stretch])
            self.last = BegunSurvey(rig, inputs.rectifier, chain)
            if beside is None:
                return _Estimating(stretch)
            numbers = likely_held_out(chain.odometry)
            part = replace(recording.part(indices[numbers]), imu=ImuSamples.empty(), wheel=())
            held_out = tools.executor.beside(read_held_out, part, numbers, inputs.rectifier, config.settings.orb)
            self.last = replace(self.last, held_out=held_out)
            return _EstimatingBeside(self, self.last, beside, config, tools)

        return followed


@dataclass(frozen=True, slots=True)
class _Estimating:
    """The estimate of a calibration, made when it is asked for."""

    stretch: CalibrationData

    def done(self) -> bool:
        return False

    def result(self) -> CalibrationEstimate:
        return estimate_from([self.stretch])


@dataclass
class _EstimatingBeside:
    """The same beside the survey, which goes on until the estimate says that its calibration is wrong."""

    beginnings: SurveyBeginnings
    begun: BegunSurvey
    estimate: Work[CalibrationEstimate]
    config: SurveyConfig
    tools: SurveyTools
    is_good: bool = False

    def done(self) -> bool:
        return self.estimate.done()

    def result(self) -> CalibrationEstimate:
        tools = replace(self.tools, progress=self._progress)
        # What cannot be finished says so when the examination is over.
        with suppress(FleetmapError, _InVainError):
            done = finish_survey(self.begun.chain, self.config, tools)
            self.beginnings.last = replace(self.begun, done=done)
        self.tools.progress("examination", 0, 1)
        return self.estimate.result()

    def _progress(self, stage: str, done: int, total: int) -> None:
        if not self.is_good and self.estimate.done():
            found = findings_of(self.estimate.result(), self.begun.rectifier.camera.focal_px)
            if any(finding.verdict in (Verdict.WARN, Verdict.FAIL) for finding in found):
                raise _InVainError
            self.is_good = True
        self.tools.progress(stage, done, total)


def survey_inputs_of(
    recording: Recording, indices: NDArray[np.int64], rectifier: Rectifier, given: Trajectory | None
) -> SurveyInputs:
    """The selected frames (F,) of a recording, read ahead, and its samples."""
    frames = read_ahead(rectifier.rectify(recording.read_frame(int(index))) for index in indices)
    samples = recording.imu, recording.calibration, rectifier, recording.wheel
    parts = RecordedParts(recording, indices)
    return SurveyInputs(frames, len(indices), *samples, given, parts, priors=recording.priors)
