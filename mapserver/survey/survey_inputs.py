"""Arguments that travel through all stages of a survey: its data, its options, its tools."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from fleetmap.bow import Vocabulary
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import CameraFrame, ImuSamples, PositionPrior, Stamps, Trajectory, WheelSample
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.loops.zones import Zones
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import ImageStore, OdometryPass, SurveyState
from mapserver.survey.tracks.mono_depths import MonoDepths

_RELEASED_EVERY = 4096  # steps of a stage: the features that these have read are far fewer than a site's
Progress = Callable[[str, int, int], None]  # stage, done, total


def no_progress(stage: str, done: int, total: int) -> None:
    """Reports nothing."""


class FrameParts(Protocol):
    """The frames of a recording by their number."""

    @property
    def stamps_ns(self) -> Stamps:
        """(F,) of all."""

    def part(self, first: int, end: int) -> Iterable[CameraFrame]:
        """Those from first to before end, to be gone through once, in any process: it can be pickled."""


@dataclass(frozen=True)
class SurveyInputs:
    """One recording: frames in order, raw or rectified ahead of the survey, and how many; IMU, wheels, calibration, position priors.

    initial_trajectory: frame_from_body of every frame by another system, in metres; None to run the odometry. parts: the same frames in
    parts, None where they come only once. keyframes_at: frames that become keyframes whatever they show.
    """

    frames: Iterable[CameraFrame | RectifiedFrame]
    frame_count: int
    imu: ImuSamples
    calibration: RigCalibration
    rectifier: Rectifier
    wheel: Sequence[WheelSample] = ()
    initial_trajectory: Trajectory | None = None
    parts: FrameParts | None = None
    keyframes_at: frozenset[int] = frozenset()
    priors: Sequence[PositionPrior] = ()


@dataclass(frozen=True)
class SurveyConfig:
    """Choices that are the same for all recordings of a site."""

    settings: SurveySettings
    vocabulary: Vocabulary
    zones: Zones = field(default_factory=Zones)


@dataclass(frozen=True)
class SurveyTools:
    """Resources that do not change the result. images: in memory for None."""

    progress: Progress = no_progress
    images: ImageStore | None = None
    executor: Executor = SERIAL

    def at(self, stage: str, done: int, total: int) -> None:
        """Reports progress; what is found in keyframes leaves memory now and then, and when the stage is over."""
        self.progress(stage, done, total)
        if done == total or done % _RELEASED_EVERY == 0:
            self.release()

    def release(self) -> None:
        """What was found in keyframes may leave memory until it is read again."""
        if self.images is not None:
            self.images.release()


@dataclass(frozen=True)
class AdjustedChain:
    """The keyframes of a survey before its loops are closed: matched holds the pairs that were matched already.

    depths: of one camera's features; None for rigs that measure depth.
    """

    odometry: OdometryPass
    state: SurveyState
    matched: set[tuple[int, int]]
    depths: MonoDepths | None
