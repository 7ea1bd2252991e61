"""The initial trajectory that a file of poses gives: the reading that fits the recording, in metres, at every frame."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import RecordingError, UsageError
from fleetmap.geometry import Array, se3_exp, se3_inverse, se3_log
from fleetmap.odometry import OdometryStatus
from fleetmap.recordings import Recording
from fleetmap.recordings.tum import format_stamp
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import SensorSet, Stamps, Trajectory
from mapserver.drafting.trajectory.formats import WrittenPoses, read_poses
from mapserver.drafting.trajectory.readings import (
    FITS_WITHIN,
    FRAMES,
    GAP_NS,
    LEAST_STRETCHES,
    SCALE_WITHIN,
    Followed,
    Judged,
    PoseReading,
    Shown,
    covered,
    judge,
    pose_at,
    read_as,
    readings,
    stretches,
    undecided,
)
from mapserver.survey.odometry_pass import OdometryRun, SampleFeed
from mapserver.survey.settings import SurveySettings

_WINDOWS, _WINDOW_FRAMES = 5, 60
_LEAST_SPAN = 0.5  # of the frames' time
_MARGIN_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class OtherTrajectory:
    """A file of another system's poses: TUM or KITTI text, DROID-SLAM's `poses.npy` or its folder.

    frame: camera (the left one) or body. scale: metres in its unit of length, None where the recording shows it.
    """

    file: Path
    frame: str = "camera"
    scale: float | None = None

    def __post_init__(self) -> None:
        """UsageError for words that mean nothing."""
        if self.frame not in FRAMES:
            raise UsageError(f"--trajectory-frame {self.frame}: it is one of {', '.join(FRAMES)}")
        if self.scale is not None and not 0 < self.scale < np.inf:
            raise UsageError(f"--trajectory-scale {self.scale}: it is the metres in the file's unit of length, above 0")


@dataclass(frozen=True, slots=True)
class GivenPoses:
    """frame_from_body of every selected frame, in metres, and what was found out about the file, in words."""

    trajectory: Trajectory
    words: str


def given_poses(recording: Recording, indices: NDArray[np.int64], other: OtherTrajectory) -> GivenPoses:
    """The poses of the selected frames (F,).

    Frames without poses get them from our own odometry between those that have. UsageError for a single camera, where the scale stays
    open, and where too few frames have poses; RecordingError for a file that cannot be read, is of another convention (with the one that
    fits) or of another recording.
    """
    if recording.sensor_set in (SensorSet.MONO, SensorSet.MONO_INERTIAL):
        raise UsageError(
            f"{recording.path} is {recording.sensor_set}; --trajectory needs stereo or depth, such as DROID's disps.npy beside its poses"
        )
    written = read_poses(other.file)
    stamps_ns = recording.frame_stamps_ns[indices]
    other_trajectory = Trajectory(stamps_on_clock(written, recording, indices, other), written.map_from_it)
    known = covered(other_trajectory.stamps_ns, stamps_ns)
    if known.sum() <= LEAST_STRETCHES:
        raise _foreign_stamps(written, recording, other)
    check_span(stamps_ns, known, recording, other)
    is_sparse = known.sum() < 2 or np.median(np.diff(stamps_ns[known])) > GAP_NS
    whole = is_sparse or len(stamps_ns) <= _WINDOWS * _WINDOW_FRAMES
    followed = _followed(recording, indices, whole=whole)
    shown = Shown(followed, stretches(followed, known), recording.calibration.cameras[0].body_from_cam)
    found, words = _judged(other_trajectory, f"{other.file.name} ({written.kind})", shown, recording, other)
    at_frames = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    at_frames[known] = [pose_at(other_trajectory, int(stamp)) for stamp in stamps_ns[known]]
    at_frames[:, :3, 3] *= found.in_metres
    at_frames = at_frames @ se3_inverse(shown.body_from(found.reading))
    if not known.all():
        if not whole:
            followed = _followed(recording, indices, whole=True)
        at_frames = _bridged(at_frames, known, followed, other)
        words += f"; {int((~known).sum())} of {len(stamps_ns)} frames without a pose are bridged by our own odometry"
    return GivenPoses(Trajectory(stamps_ns, at_frames), words)


def stamps_on_clock(
    rows: WrittenPoses, recording: Recording, indices: NDArray[np.int64], other: OtherTrajectory
) -> Stamps:
    """(N,) nanoseconds on the recording's clock, of stamps in seconds of that clock or since the first frame, or numbers of frames.

    Rows without stamps belong to all frames, or to the selected ones: UsageError where they are as many as neither. RecordingError for
    stamps of another clock.
    """
    # The other system has read, and counted, the frames too that are damaged: of the selected ones those between them, and perhaps
    # those next to them
    frames, damaged = recording.frame_stamps_ns, recording.damaged_ns
    clock, chosen = np.union1d(frames, damaged), frames[indices]
    inner = np.union1d(chosen, damaged[(damaged > chosen[0]) & (damaged < chosen[-1])])
    before_ns, after_ns = (
        frames[frames < chosen[0]].max(initial=-(2**62)),
        frames[frames > chosen[-1]].min(initial=2**62),
    )
    chosen = np.union1d(chosen, damaged[(damaged > before_ns) & (damaged < after_ns)])
    count = len(rows.map_from_it)
    if rows.stamps_ns is None:
        for counted in (clock, chosen, inner):
            if count == len(counted):
                return counted
        raise UsageError(
            f"{other.file} has {count} poses without stamps, {recording.name} has {len(clock)} frames, of which {len(chosen)} are "
            "selected; select those that the poses belong to with --frames, or pass a file with stamps"
        )
    first, last, middle = int(clock[0]), int(clock[-1]), int(np.median(rows.stamps_ns))
    if first - _MARGIN_NS <= middle <= last + _MARGIN_NS:
        return rows.stamps_ns
    numbers, rest = np.divmod(rows.stamps_ns, 1_000_000_000)
    if not rest.any() and numbers.min() >= 0 and numbers.max() < len(clock):
        return clock[numbers]
    if 0 <= middle <= last - first + _MARGIN_NS:
        return first + rows.stamps_ns
    raise _foreign_stamps(rows, recording, other)


def _foreign_stamps(rows: WrittenPoses, recording: Recording, other: OtherTrajectory) -> RecordingError:
    stamps_ns, clock = rows.stamps_ns, recording.frame_stamps_ns
    written, frames = (
        "no stamps" if some is None else " to ".join(format_stamp(int(stamp)) for stamp in (some.min(), some.max()))
        for some in (stamps_ns, clock)
    )
    return RecordingError(
        f"{other.file} belongs to another recording: of its {len(rows.map_from_it)} poses, at {written}, hardly any is at frames, "
        f"{frames} s; pass the recording's own, with stamps in seconds on the cameras' clock or since the first frame, or numbers of frames"
    )


def _followed(recording: Recording, indices: NDArray[np.int64], *, whole: bool) -> Followed:
    """Our own odometry over all frames, or over some windows of them."""
    count = len(indices)
    spans = [(0, count)]
    if not whole:
        starts = np.linspace(0, count - _WINDOW_FRAMES, _WINDOWS).round().astype(int).tolist()
        spans = [(start, start + _WINDOW_FRAMES) for start in starts]
    rig, settings = recording.calibration, SurveySettings()
    rectifier = Rectifier(rig, has_depth=recording.sensor_set is SensorSet.RGBD)
    frame_from_body, piece, pieces = np.tile(np.eye(4), (count, 1, 1)), np.full(count, -1), 0
    for first, end in spans:
        run, feed = (
            OdometryRun(rig, rectifier, settings),
            SampleFeed(recording.imu, recording.wheel, rectifier.imu_minus_cam_s),
        )
        for number in range(first, end):
            frame = rectifier.rectify(recording.read_frame(int(indices[number])))
            estimate = run.handle(frame, *feed.until(frame.stamp_ns)).estimate
            is_lost = estimate.status is OdometryStatus.DEGRADED and not estimate.inertial
            pieces += is_lost or number == first  # without an IMU nothing ties what comes to what was
            piece[number] = pieces
        frame_from_body[first:end] = run.chain.odom_from_body()
    return Followed(recording.frame_stamps_ns[indices], frame_from_body, piece)


def _judged(
    trajectory: Trajectory, name: str, shown: Shown, recording: Recording, other: OtherTrajectory
) -> tuple[Judged, str]:
    """The poses as they are named, and how well they fit in words.

    RecordingError where another convention fits better, with what to do, or none fits; UsageError where the scale stays open.
    """
    is_camera_body = bool(np.abs(shown.body_from_cam - np.eye(4)).max() < 1e-3)
    every = [judge(read_as(trajectory, each), each, shown, other.scale) for each in readings(is_camera_body)]
    best = min(every, key=lambda judged: float(judged.errors.mean()) if len(judged.errors) else 0.0)
    said = PoseReading(FRAMES[1] if is_camera_body else other.frame)
    (found,) = [each for each in every if each.reading == said]
    count = len(shown.pairs)
    if not best.fits:
        raise RecordingError(
            f"{other.file} belongs to another recording: read as {best.reading}, which fits {recording.name} best, it is off by "
            f"{best.figures} in the median of {count} stretches, {100 * FITS_WITHIN:.0f} % is the most; pass the poses of this recording"
        )
    if found is not best and not any(each is found for each in undecided(best, every)):
        raise RecordingError(
            f"{other.file} does not fit {recording.name} as {said}: off by {found.figures} in the median of {count} stretches, and by "
            f"{best.figures} as {best.reading}; {best.reading.instead(other.frame)}"
        )
    if found.scale_within > SCALE_WITHIN:
        raise UsageError(
            f"{recording.name} does not show the unit of {other.file}; say its metres with --trajectory-scale METRES"
        )
    words = f"trajectory {name}: {said}, scale {found.in_metres:.4g}"
    if not found.is_told:
        return found, f"{words}, as said; the recording moves too little to judge it"
    return found, f"{words}: off our own odometry by {found.figures} in the median of {count} stretches"


def check_span(stamps_ns: Stamps, is_placed: NDArray[np.bool_], recording: Recording, other: OtherTrajectory) -> None:
    """UsageError where the frames (F,) that have poses span less than half of the time of all."""
    times = stamps_ns[is_placed]
    if len(times) < 2 or np.ptp(times) < _LEAST_SPAN * np.ptp(stamps_ns):
        missing = [format_stamp(int(stamp)) for stamp in stamps_ns[~is_placed]]
        raise UsageError(
            f"{other.file} has no pose for {len(missing)} of {len(stamps_ns)} frames of {recording.name}: {', '.join(missing[:5])}"
            f"{', ...' if len(missing) > 5 else ''}, and spans less than half of their time; select frames that it covers with --frames"
        )


def _bridged(at_frames: Array, is_placed: NDArray[np.bool_], followed: Followed, other: OtherTrajectory) -> Array:
    """The poses (F, 4, 4) with the missing ones carried on by our odometry from the last one, so that they arrive at the next one."""
    out, own, seconds = at_frames.copy(), followed.frame_from_body, followed.stamps_ns * 1e-9
    numbers = np.flatnonzero(is_placed)
    for number in np.flatnonzero(~is_placed):
        place = int(np.searchsorted(numbers, number))
        before, after = numbers[max(place - 1, 0)], numbers[min(place, len(numbers) - 1)]
        if len({int(followed.piece[k]) for k in (before, number, after)}) > 1:
            raise UsageError(
                f"{other.file} has no pose at {format_stamp(int(followed.stamps_ns[number]))} s, and our own odometry is lost there too; "
                "leave such frames out with --frames"
            )
        carried = at_frames[before] @ se3_inverse(own[before]) @ own[number]
        if place not in (0, len(numbers)):
            end = at_frames[before] @ se3_inverse(own[before]) @ own[after]
            share = (seconds[number] - seconds[before]) / (seconds[after] - seconds[before])
            carried = carried @ se3_exp(share * se3_log(se3_inverse(end) @ at_frames[after]))
        out[number] = carried
    return out
