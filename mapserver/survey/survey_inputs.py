"""Arguments passed through all stages of a survey: its data, its options, its tools."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from fleetmap.bow.vocabulary import Vocabulary
from fleetmap.geometry import Array, inside_rings
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier
from fleetmap.sensors.samples import CameraFrame, ImuSamples, PositionPrior, Stamps, Trajectory, WheelSample
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.settings import SurveySettings
from mapserver.survey.state import ImageStore, OdometryPass, SurveyState
from mapserver.survey.tracks.mono_depths import MonoDepths

_RELEASED_EVERY = 4096  # steps of a stage: they read far fewer features than a site has
Progress = Callable[[str, int, int], None]  # stage, done, total


class TrackedFrame(NamedTuple):
    """One frame: its number, pictures and estimate; frame_from_body (4, 4) in the continuous frame; True if it becomes a keyframe."""

    number: int
    frame: RectifiedFrame
    estimate: OdometryEstimate
    frame_from_body: Array
    is_keyframe: bool


Watch = Callable[[TrackedFrame], None]


class FrameParts(Protocol):
    """The frames of a recording by their number."""

    @property
    def stamps_ns(self) -> Stamps:
        """(F,) of all frames."""

    def part(self, first: int, end: int) -> Iterable[CameraFrame]:
        """Return those from first to before end, to be iterated once, in any process: it can be pickled."""


@dataclass(frozen=True)
class SurveyInputs:
    """One recording: frames in order, raw or rectified in advance, and their number; IMU, wheels, calibration, position priors.

    initial_trajectory: frame_from_body of every frame by another system, in metres; None to run the odometry. parts: the same frames in
    parts, None if they can be read only once. keyframes_at: frames that always become keyframes. pair_yaw: radians by which
    the right camera of the first pair is turned, too large disparities positive, and their sigma, by an earlier survey of the rig.
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
    pair_yaw: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Zones:
    """Hard zones of a site: named polygons (V, 2) in `map`, metres. Cameras in different ones never see the same.

    A place outside all of them is compatible with every other.
    """

    polygons: dict[str, Array] = field(default_factory=dict)

    def at(self, position_m: Array) -> frozenset[str]:
        """Return the names of the zones that contain a position (x, y, ...)."""
        place = np.asarray(position_m[None, :2])
        return frozenset(name for name, polygon in self.polygons.items() if inside_rings(place, [polygon])[0])

    def compatible(self, a_m: Array, b_m: Array) -> bool:
        """True if two positions may see the same."""
        zones_a, zones_b = self.at(a_m), self.at(b_m)
        return not zones_a or not zones_b or bool(zones_a & zones_b)


@dataclass(frozen=True)
class SurveyConfig:
    """Options common to all recordings of a site."""

    settings: SurveySettings
    vocabulary: Vocabulary
    zones: Zones = field(default_factory=Zones)


@dataclass(frozen=True)
class SurveyTools:
    """Resources that do not change the result. watch: gets every frame that the odometry has tracked, but none of a survey by segments."""

    progress: Progress = field(default=lambda *_: None)
    images: ImageStore = field(default_factory=ImageStore)
    executor: Executor = SERIAL
    watch: Watch = field(default=lambda _: None)

    def at(self, stage: str, done: int, total: int) -> None:
        """Report progress; features of keyframes leave memory periodically, and at the end of the stage."""
        self.progress(stage, done, total)
        if done == total or done % _RELEASED_EVERY == 0:
            self.images.release()


@dataclass(frozen=True)
class AdjustedChain:
    """The keyframes of a survey before loop closure; matched: pairs already matched.

    depths: of one camera's features; None for rigs that measure depth.
    """

    odometry: OdometryPass
    state: SurveyState
    matched: set[tuple[int, int]]
    depths: MonoDepths | None
