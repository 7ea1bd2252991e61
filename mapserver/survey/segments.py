"""Long surveys in overlapping segments: each is tracked and adjusted in parallel, and joined to the previous one. Pure.

Two neighbours share a keyframe, the last of one and the first of the other: it gives their exact relative pose, so that
every edge between neighbouring keyframes was measured and adjusted in some segment. Segments that cannot be joined are processed as one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fleetmap.errors import SurveyError
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, so3_log, transport_cov, turned_cov
from fleetmap.sensors.samples import ImuSamples, Stamps, wheel_between
from mapserver.survey.keyframes.keyframes import set_aside
from mapserver.survey.odometry_pass import initial_state
from mapserver.survey.pose_graph.odometry_factors import blackout_factors, edge_covariance
from mapserver.survey.settings import SegmentSettings, SurveySettings
from mapserver.survey.state import Cut, FrameTracks, ImageStore, Keyframe, Landmarks, OdometryPass, SurveyState
from mapserver.survey.survey_inputs import AdjustedChain, SurveyInputs, SurveyTools

_MARGIN_NS = 1_000_000_000  # of IMU and wheels after the last frame
_GATE = 22.46  # 0.999 of chi-square with 6 degrees of freedom
Begin = Callable[[SurveyInputs, SurveySettings, SurveyTools], AdjustedChain]
_How = tuple[Begin, SurveySettings]  # computes the chain of one piece


@dataclass(frozen=True, slots=True)
class Segment:
    """Frames begin..last of a survey; its odometry starts at frame `lead`. All but the first begin at the previous one's last frame."""

    lead: int
    begin: int
    last: int

    @property
    def settled_from(self) -> int:
        """The frame from which on its odometry must be reliable."""
        return (self.lead + self.begin) // 2


@dataclass(frozen=True, slots=True)
class SegmentSurvey:
    """Odometry of a segment's frames and state of its keyframes, including those at both ends.

    Keyframes have their frame's number in the survey, and their pictures in the store named by the task, or one of the process that
    made them. matched: pairs of its keyframes. led (4, 4), led_covariance (6, 6): body at `settled_from` from body at `begin` by
    odometry. unsettled, lost: why its start, or its end, cannot be joined to a neighbour.
    """

    segment: Segment
    odometry: OdometryPass
    state: SurveyState
    matched: set[tuple[int, int]]
    led: Array
    led_covariance: Array
    unsettled: str | None
    lost: str | None


_Made = tuple[Segment, SegmentSurvey | str]  # text of the reason if there is none


def in_segments(begin: Begin, inputs: SurveyInputs, settings: SurveySettings, tools: SurveyTools) -> AdjustedChain:
    """As `begin`; a survey that is long enough, with odometry of known scale, is cut. The cuts depend only on its frames.

    The odometry of a segment starts in the overlap and may fail to initialise there. Then the previous segment is continued
    instead, as without the cut, and `cuts` of the odometry record this.
    """
    if inputs.parts is None or inputs.initial_trajectory is not None or inputs.rectifier.camera.baseline_m == 0:
        return begin(inputs, settings, tools)
    stamps_ns = inputs.parts.stamps_ns
    segments = planned(stamps_ns, settings.segments)
    if len(segments) == 1:
        return begin(inputs, settings, tools)
    how = begin, settings
    tasks = ((segment, _part(segment, inputs), tools.images) for segment in segments)
    made, surveys = list[_Made](), tools.executor.map(_survey_segment, how, tasks)
    for segment in segments:
        survey = next(surveys)  # by zip, which holds what it gave last, it would stay until the next one came
        tools.at("odometry", segment.last + 1, inputs.frame_count)
        tools.images.release()
        made.append((segment, survey if isinstance(survey, str) else _stored(survey, tools.images)))
        del survey  # with its pictures, which are in the survey's own store now
    refused: dict[int, str] = {}
    unwatched = replace(tools, watch=lambda _: None)  # who watches wants the whole drive
    while wrong := _refusals(made):
        refused |= wrong
        made = [
            # In this process: it may be long, and the survey's own store keeps its pictures out of memory.
            known or (whole, _survey_segment(how, (whole, _part(whole, inputs), tools.images), unwatched))
            for whole, known in _regrouped(made, refused)
        ]
    cuts = tuple(
        Cut(s.begin, float(stamps_ns[s.begin] - stamps_ns[0]) * 1e-9, refused.get(s.begin)) for s in segments[1:]
    )
    if not made:
        chain = begin(inputs, settings, tools)
        return replace(chain, odometry=replace(chain.odometry, cuts=cuts))
    return _joined([survey for _, survey in made if isinstance(survey, SegmentSurvey)], cuts, inputs)


def planned(stamps_ns: Stamps, settings: SegmentSettings) -> list[Segment]:
    """Return segments of equal time, at least as long as configured; a single one if too short to be cut."""
    if settings.seconds and len(stamps_ns):  # a gap (of days if a clock was set) is not cut into segments
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


def _stored(survey: SegmentSurvey, images: ImageStore) -> SegmentSurvey:
    """Return the survey with its pictures, which a process may have sent, in the survey's own store."""
    numbers = dict[int, int]()  # of pictures that images share: black ones
    keyframes = [_kept(keyframe, images, numbers) for keyframe in survey.odometry.keyframes]
    return replace(survey, odometry=replace(survey.odometry, keyframes=keyframes))


def _kept(keyframe: Keyframe, images: ImageStore, numbers: dict[int, int]) -> Keyframe:
    if keyframe.images is images:
        return keyframe
    others = tuple(_kept(other, images, numbers) for other in keyframe.others)
    number = numbers.get(keyframe.image_number)
    if number is None:
        number = numbers[keyframe.image_number] = images.put(keyframe.pictures)
    kept = replace(keyframe, images=images, image_number=number, others=others)
    return set_aside(kept, images)


def _part(segment: Segment, inputs: SurveyInputs) -> SurveyInputs:
    """Return a segment's part of the inputs.

    Samples before its first frame are excluded: IMU data without a picture would look like rest during constant motion.
    """
    assert inputs.parts is not None
    offset_ns, stamps_ns = int(inputs.rectifier.imu_minus_cam_s * 1e9), inputs.parts.stamps_ns
    since_ns = int(stamps_ns[segment.lead]) + offset_ns if segment.lead else -(2**62)
    until_ns = int(stamps_ns[segment.last]) + offset_ns + _MARGIN_NS
    ends = {segment.begin, segment.last} - {0, len(stamps_ns) - 1}
    return replace(
        inputs,
        frames=inputs.parts.part(segment.lead, segment.last + 1),
        frame_count=segment.last - segment.lead + 1,
        imu=inputs.imu.between(since_ns, until_ns),
        wheel=tuple(wheel_between(inputs.wheel, since_ns, until_ns)),
        parts=None,
        keyframes_at=frozenset(frame - segment.lead for frame in ends),
    )


def _survey_segment(
    how: _How, task: tuple[Segment, SurveyInputs, ImageStore], tools: SurveyTools | None = None
) -> SegmentSurvey | str:
    """Return the survey of one segment in any process, or the text of the reason if there is none.

    task: the segment with its part of the inputs, and a store for the pictures of its keyframes.
    """
    (begin, settings), (segment, inputs, images) = how, task
    try:
        chain = begin(inputs, settings, tools or SurveyTools(images=images))
    except SurveyError as error:
        return str(error)
    return _without_lead(chain, segment)


def _without_lead(chain: AdjustedChain, segment: Segment) -> SegmentSurvey:
    """Return a segment's chain from `begin` on; without IMU data, which the whole survey has."""
    odometry, lead = chain.odometry, segment.lead
    first, end, settled = segment.begin - lead, segment.last - lead + 1, segment.settled_from - lead
    chosen = np.array([frame >= first for frame in odometry.keyframe_frames])
    number = np.cumsum(chosen) - 1
    keyframes = [k for k, keep in zip(odometry.keyframes, chosen, strict=True) if keep]
    state, odom_from_body = chain.state.of(chosen), odometry.odom_from_body
    kept = replace(
        odometry,
        estimates=[replace(e, frame_index=e.frame_index + lead) for e in odometry.estimates[first:end]],
        odom_from_body=odom_from_body[first:end],
        covariances=odometry.covariances[first:end],
        tracked=odometry.tracked[first:end],
        keyframes=[k.numbered(k.frame_index + lead) for k in keyframes],
        tracks=odometry.tracks.part(first, end),
    )
    return SegmentSurvey(
        segment,
        kept,
        replace(state, motion=replace(state.motion, imu=ImuSamples.empty())),
        {(int(number[i]), int(number[j])) for i, j in chain.matched if chosen[i] and chosen[j]},
        se3_inverse(odom_from_body[settled]) @ odom_from_body[first],
        edge_covariance(odometry, settled, first),
        _doubt(chain, slice(settled, first + 1)),
        _doubt(chain, slice(end - 1, end)),
    )


def _doubt(chain: AdjustedChain, frames: slice) -> str | None:
    """Return why the odometry is unreliable at these frames, counted from the lead; None if it is reliable."""
    if not chain.odometry.tracked[frames].all():
        return "it saw too little there"
    if chain.state.motion.noise is not None and not all(e.inertial for e in chain.odometry.estimates[frames]):
        return "gravity was unknown there"
    return None


def _refusals(made: Sequence[_Made]) -> dict[int, str]:
    """Return why neighbours cannot be joined, by the frame between them."""
    reasons = {after[0].begin: _refusal(before[1], after[1]) for before, after in pairwise(made)}
    return {frame: reason for frame, reason in reasons.items() if reason is not None}


def _refusal(before: SegmentSurvey | str, after: SegmentSurvey | str) -> str | None:
    """Return why two neighbours cannot be joined, None if they can: both were reliable, and agree on the motion there."""
    if isinstance(before, str):
        return before
    if isinstance(after, str):
        return after
    if before.lost is not None:
        return f"the odometry before it was in doubt: {before.lost}"
    if after.unsettled is not None:
        return f"the odometry that started before it was in doubt: {after.unsettled}"
    start = before.segment.begin
    led = [frame - start for frame in (after.segment.settled_from, after.segment.begin)]
    if led[0] < 0:
        return "its overlap is longer than the segment before it"
    a, b = before.odometry.odom_from_body[led]
    off = se3_inverse(se3_inverse(a) @ b) @ after.led
    error = np.concatenate([so3_log(off[:3, :3]), off[:3, 3]])
    covariance = edge_covariance(before.odometry, led[0], led[1]) + after.led_covariance
    covariance = turned_cov(covariance, after.led[:3, :3].T)  # they are in the axes of the first body
    if float(error @ np.linalg.solve(covariance, error)) > _GATE:
        metres, degrees = np.linalg.norm(error[3:]), np.degrees(np.linalg.norm(error[:3]))
        return (
            f"the odometry before it and the one that started there differ by {metres:.2f} m and {degrees:.1f} degrees"
        )
    return None


def _regrouped(made: Sequence[_Made], refused: dict[int, str]) -> list[tuple[Segment, _Made | None]]:
    """Return segments with their results, and merged neighbours that could not be joined as one segment without any.

    None if that is the whole survey, which needs no segments.
    """
    groups: list[tuple[Segment, _Made | None]] = []
    for each in made:
        if groups and each[0].begin in refused:
            groups[-1] = replace(groups[-1][0], last=each[0].last), None
        else:
            groups.append((each[0], each))
    return groups if len(groups) > 1 else []


@dataclass(frozen=True, slots=True)
class _Placed:
    """A segment in the common frame: joined_from_odom and joined_from_map (4, 4), its first keyframe's number, its tracks' first."""

    made: SegmentSurvey
    joined_from_odom: Array
    joined_from_map: Array
    first_keyframe: int
    first_track: int


def _joined(segments: Sequence[SegmentSurvey], cuts: tuple[Cut, ...], inputs: SurveyInputs) -> AdjustedChain:
    """Join segments into one chain, in the frame of the first one."""
    level = inputs.calibration.imu is not None
    placed = [_Placed(segments[0], np.eye(4), np.eye(4), 0, 0)]
    for before, after in pairwise(segments):
        last = placed[-1]
        odom_from_body, map_from_body = before.odometry.odom_from_body, before.state.map_from_body
        placed.append(
            _Placed(
                after,
                _laid_on(last.joined_from_odom @ odom_from_body[-1], after.odometry.odom_from_body[0], level),
                _laid_on(last.joined_from_map @ map_from_body[-1], after.state.map_from_body[0], level),
                last.first_keyframe + len(before.odometry.keyframes) - 1,
                last.first_track + int(before.odometry.tracks.ids.max(initial=-1)) + 1,
            )
        )
    odometry = replace(_joined_odometry(placed), cuts=cuts)
    matched = {(i + each.first_keyframe, j + each.first_keyframe) for each in placed for i, j in each.made.matched}
    return AdjustedChain(odometry, _joined_state(placed, odometry, inputs), matched, None)


def _laid_on(joined_from_body: Array, segment_from_body: Array, level: bool) -> Array:
    """Return joined_from_segment (4, 4) by one body in both. level: both know gravity, so only a rotation about z is used.

    So no segment adds its error of tilt to later ones.
    """
    if not level:
        return np.asarray(joined_from_body @ se3_inverse(segment_from_body))
    turn = joined_from_body[:3, :3] @ segment_from_body[:3, :3].T
    yaw = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    rotation = so3_exp(np.array([0.0, 0.0, yaw]))
    return se3(rotation, joined_from_body[:3, 3] - rotation @ segment_from_body[:3, 3])


def _joined_odometry(placed: Sequence[_Placed]) -> OdometryPass:
    """Assign every frame to the segment that begins with it or before it; a shared frame has the tracks of both."""
    covariances, reached = list[Array](), placed[0].made.odometry.covariances[0]
    starts, ids, pixels, size = [np.zeros(1, np.int64)], [], [], 0
    for each in placed:
        odometry, turn = each.made.odometry, each.joined_from_odom[:3, :3]
        own = turned_cov(odometry.covariances, turn)
        gained = reached - own[0]
        levers_m = (odometry.odom_from_body[:, :3, 3] - odometry.odom_from_body[0, :3, 3]) @ turn.T
        covariances.append(own + np.array([transport_cov(gained, lever_m) for lever_m in levers_m]))
        reached = covariances[-1][-1]
        tracks = odometry.tracks
        # A shared frame ends after its rows of the later segment.
        starts[-1] = starts[-1][:-1] if size else starts[-1]
        starts.append(size + tracks.starts[1:])
        ids.append(tracks.ids + np.int32(each.first_track))
        pixels.append(tracks.pixels)
        size += len(tracks.ids)
    passes = [each.made.odometry for each in placed]
    return replace(
        passes[-1],
        estimates=[e for own in passes[:-1] for e in own.estimates[:-1]] + passes[-1].estimates,
        odom_from_body=_in_turn([each.joined_from_odom @ each.made.odometry.odom_from_body for each in placed]),
        covariances=_in_turn(covariances),
        tracked=_in_turn([own.tracked for own in passes]),
        keyframes=[k for own in passes[:-1] for k in own.keyframes[:-1]] + passes[-1].keyframes,
        tracks=FrameTracks(np.concatenate(starts), np.concatenate(ids), np.concatenate(pixels)),
    )


def _in_turn(parts: Sequence[Array]) -> Array:
    """Concatenate rows of all, each without its last, which is the next one's first."""
    return np.concatenate([*(part[:-1] for part in parts[:-1]), parts[-1]])


def _joined_state(placed: Sequence[_Placed], odometry: OdometryPass, inputs: SurveyInputs) -> SurveyState:
    """Return landmarks of all segments; one seen in two is two landmarks, until landmarks are built again."""
    motions, places, points, marks, number = [], [], [], [], 0
    for each in placed:
        own, turn = each.made.state, each.joined_from_map
        velocities, biases = np.split(own.motion.motions, [3], axis=1)
        motions.append(np.column_stack([velocities @ turn[:3, :3].T, biases]))
        places.append(turn @ own.map_from_body)
        points.append(own.landmarks.points_map @ turn[:3, :3].T + turn[:3, 3])
        seen_by = own.landmarks.obs_keyframe + np.int32(each.first_keyframe)
        owners = (own.landmarks.obs_landmark + number).astype(np.int32)
        marks.append(replace(own.landmarks, obs_keyframe=seen_by, obs_landmark=owners))
        number += len(points[-1])
    state = initial_state(odometry, inputs)
    motion = replace(state.motion, motions=_in_turn(motions))
    landmarks = Landmarks.concatenated(np.concatenate(points), marks)
    state = replace(state, map_from_body=_in_turn(places), motion=motion, landmarks=landmarks)
    if odometry.inertial:
        state = replace(state, motion=replace(motion, relative=blackout_factors(odometry, state)))
    return state
