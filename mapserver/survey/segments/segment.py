"""One segment of a survey: its frames, what is made of them in any process, and whether its odometry had settled in time."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, se3_inverse
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import CameraFrame, ImuSamples, Stamps, WheelSample, wheel_between
from mapserver.survey.bundle.bundle_rounds import SurveyState, state_of
from mapserver.survey.bundle.odometry_factors import edge_covariance
from mapserver.survey.chain import AdjustedChain, begun_chain
from mapserver.survey.keyframes.keyframes import ImageStore
from mapserver.survey.odometry_pass import OdometryPass
from mapserver.survey.settings import SegmentSettings, SurveySettings
from mapserver.survey.survey_inputs import SurveyInputs, SurveyTools

_MARGIN_NS = 1_000_000_000  # of IMU and wheels behind the last frame


@dataclass(frozen=True, slots=True)
class Segment:
    """Frames begin..last of a survey; its odometry starts at frame `lead`. All but the first begin where the one before has its last."""

    lead: int
    begin: int
    last: int

    @property
    def settled_from(self) -> int:
        """The frame from which on its odometry must be sure of itself."""
        return (self.lead + self.begin) // 2


@dataclass(frozen=True, slots=True)
class SegmentTask:
    """A segment with its frames and the samples of IMU and wheels between them: all that a process needs beside `Rig`.

    images: takes the pictures of its keyframes.
    """

    segment: Segment
    frames: Iterable[CameraFrame]
    imu: ImuSamples
    wheel: tuple[WheelSample, ...]
    keyframes_at: frozenset[int]
    images: ImageStore


@dataclass(frozen=True, slots=True)
class Rig:
    """What all segments of a survey share."""

    calibration: RigCalibration
    rectifier: Rectifier
    settings: SurveySettings


@dataclass(frozen=True, slots=True)
class SegmentSurvey:
    """What became of a segment: odometry of its frames and state of its keyframes, those at both its ends included.

    Keyframes have their frame's number in the survey, and their pictures in the store that the task named, or one of the process that made
    them. matched: pairs of its keyframes. led (4, 4), led_covariance (6, 6): body at `settled_from` from body at `begin` by
    odometry. unsettled, lost: why its beginning, or its end, cannot be joined to a neighbour.
    """

    segment: Segment
    odometry: OdometryPass
    state: SurveyState
    matched: set[tuple[int, int]]
    led: Array
    led_covariance: Array
    unsettled: str | None
    lost: str | None


def planned(stamps_ns: Stamps, settings: SegmentSettings) -> list[Segment]:
    """Segments of equal time, at least as long as the settings say; a single one of what is too short to be cut."""
    if settings.seconds and len(stamps_ns):  # a gap, of days where a clock was set, is not cut into segments
        steps_ns = np.minimum(np.diff(stamps_ns), int(settings.seconds * 1e9))
        stamps_ns = stamps_ns[0] + np.concatenate([[0], np.cumsum(steps_ns)])
    seconds = float(stamps_ns[-1] - stamps_ns[0]) * 1e-9 if len(stamps_ns) else 0.0
    count = int(seconds / settings.seconds) if settings.seconds else 1
    last = len(stamps_ns) - 1
    if count < 2:
        return [Segment(0, 0, last)]
    starts_ns = stamps_ns[0] + (np.arange(count) * (seconds * 1e9 / count)).astype(np.int64)
    begins = np.searchsorted(stamps_ns, starts_ns)
    leads = np.searchsorted(stamps_ns, starts_ns - int(settings.overlap_s * 1e9))
    ends = [*begins[1:].tolist(), last]
    return [Segment(*each) for each in zip(leads.tolist(), begins.tolist(), ends, strict=True)]


def task_of(segment: Segment, inputs: SurveyInputs, images: ImageStore) -> SegmentTask:
    """The segment with its part of the inputs, and with the store of its pictures.

    No sample from before its first frame: what the IMU felt while no picture was there would pass for rest where the robot drove evenly.
    """
    assert inputs.parts is not None
    offset_ns, stamps_ns = int(inputs.rectifier.imu_minus_cam_s * 1e9), inputs.parts.stamps_ns
    since_ns = int(stamps_ns[segment.lead]) + offset_ns if segment.lead else -(2**62)
    until_ns = int(stamps_ns[segment.last]) + offset_ns + _MARGIN_NS
    ends = {segment.begin, segment.last} - {0, len(stamps_ns) - 1}
    return SegmentTask(
        segment,
        inputs.parts.part(segment.lead, segment.last + 1),
        inputs.imu.between(since_ns, until_ns),
        tuple(wheel_between(inputs.wheel, since_ns, until_ns)),
        frozenset(frame - segment.lead for frame in ends),
        images,
    )


def survey_segment(rig: Rig, task: SegmentTask) -> SegmentSurvey | str:
    """The chain of one segment; in words why there is none."""
    try:
        chain = survey_alone(rig, task, SurveyTools(images=task.images))
    except SurveyError as error:
        return str(error)
    return segment_survey(chain, task.segment)


def survey_alone(rig: Rig, task: SegmentTask, tools: SurveyTools) -> AdjustedChain:
    """The chain of one segment from its lead on, frames numbered from there."""
    count = task.segment.last - task.segment.lead + 1
    inputs = SurveyInputs(
        task.frames, count, task.imu, rig.calibration, rig.rectifier, task.wheel, keyframes_at=task.keyframes_at
    )
    return begun_chain(inputs, rig.settings, tools)


def segment_survey(chain: AdjustedChain, segment: Segment) -> SegmentSurvey:
    """What is kept of a segment's chain: nothing of its lead, and of the IMU nothing, which the whole survey has."""
    odometry, lead = chain.odometry, segment.lead
    first, end, settled = segment.begin - lead, segment.last - lead + 1, segment.settled_from - lead
    chosen = np.array([k.frame_index >= first for k in odometry.keyframes])
    number = np.cumsum(chosen) - 1
    matched = {(int(number[i]), int(number[j])) for i, j in chain.matched if chosen[i] and chosen[j]}
    state = state_of(chain.state, chosen)
    odom_from_body, tracks = odometry.odom_from_body, odometry.tracks
    assert tracks is not None
    kept = replace(
        odometry,
        estimates=[replace(e, frame_index=e.frame_index + lead) for e in odometry.estimates[first:end]],
        odom_from_body=odom_from_body[first:end],
        covariances=odometry.covariances[first:end],
        tracked=odometry.tracked[first:end],
        keyframes=[
            replace(k, frame_index=k.frame_index + lead)
            for k, keep in zip(odometry.keyframes, chosen, strict=True)
            if keep
        ],
        tracks=tracks.part(first, end),
    )
    return SegmentSurvey(
        segment,
        kept,
        replace(state, motion=replace(state.motion, imu=ImuSamples.empty())),
        matched,
        se3_inverse(odom_from_body[settled]) @ odom_from_body[first],
        edge_covariance(odometry, settled, first),
        _doubt(chain, slice(settled, first + 1)),
        _doubt(chain, slice(end - 1, end)),
    )


def _doubt(chain: AdjustedChain, frames: slice) -> str | None:
    """Why the odometry is not sure of itself at these frames, counted from the lead; None where it is."""
    if not chain.odometry.tracked[frames].all():
        return "it saw too little there"
    if chain.state.motion.noise is not None and not all(e.inertial for e in chain.odometry.estimates[frames]):
        return "it did not know gravity there"
    return None
