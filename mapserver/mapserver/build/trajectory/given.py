"""The initial trajectory that a file of poses gives: the reading that fits the recording, in metres, at every frame."""

from collections.abc import Iterable
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
from mapserver.build.trajectory.formats import TRAJECTORY_FORMATS, PoseRows
from mapserver.build.trajectory.readings import (
    DIRECTIONS,
    FITS_WITHIN,
    FRAMES,
    GAP_NS,
    LEAST_STRETCHES,
    QUATERNIONS,
    SCALE_WITHIN,
    STAMPS,
    Followed,
    Judged,
    Shown,
    covered,
    judge,
    pose_at,
    possible_units,
    read_as,
    readings,
    stamps_of,
    stretches,
    undecided,
)
from mapserver.survey.odometry_pass import OdometryRun, SampleFeed
from mapserver.survey.settings import SurveySettings, for_depths

CHOICES = {"frame": FRAMES, "direction": DIRECTIONS, "quaternion": QUATERNIONS, "stamps": STAMPS}
_WINDOWS, _WINDOW_FRAMES = 5, 60
_LEAST_SPAN = 0.5  # of the frames' time


@dataclass(frozen=True, slots=True)
class OtherTrajectory:
    """A file of another system's poses, its format, and what is known of it; what is None is found out or asked for.

    frame: camera or body. direction: map-from-pose or pose-from-map. quaternion: xyzw or wxyz. stamps: s, ms, us, ns, elapsed-s (since
    the first frame) or frames (numbers of frames). scale: metres in its unit of length.
    """

    file: Path
    format: str
    frame: str | None = None
    direction: str | None = None
    quaternion: str | None = None
    stamps: str | None = None
    scale: float | None = None

    def __post_init__(self) -> None:
        """UsageError for words that mean nothing."""
        if self.format not in TRAJECTORY_FORMATS:
            raise UsageError(f"--trajectory-format {self.format}: the formats are {', '.join(TRAJECTORY_FORMATS)}")
        for name, said in self.said().items():
            if said is not None and said not in CHOICES[name]:
                raise UsageError(f"--trajectory-{name} {said}: it is one of {', '.join(CHOICES[name])}")
        if self.scale is not None and not 0 < self.scale < np.inf:
            raise UsageError(f"--trajectory-scale {self.scale}: it is the metres in the file's unit of length, above 0")

    def said(self) -> dict[str, str | None]:
        """The items of a reading that are known."""
        return {name: getattr(self, name) for name in CHOICES}

    def rows(self) -> PoseRows:
        """What the file says; RecordingError where it cannot be read or is of another format."""
        try:
            return TRAJECTORY_FORMATS[self.format](self.file)
        except ValueError as error:
            raise RecordingError(f"{self.file} is no {self.format} trajectory: {error}") from error


@dataclass(frozen=True, slots=True)
class GivenPoses:
    """frame_from_body of every selected frame, in metres, and what was found out about the file, in words."""

    trajectory: Trajectory
    words: str


def given_poses(recording: Recording, indices: NDArray[np.int64], other: OtherTrajectory) -> GivenPoses:
    """The poses of the selected frames (F,) by the reading that the recording supports.

    Frames without poses get them from our own odometry between those that have. UsageError for a single camera, where readings stay
    open, and where too few frames have poses; RecordingError for a file that cannot be read or belongs to another recording.
    """
    if recording.sensor_set in (SensorSet.MONO, SensorSet.MONO_INERTIAL):
        raise UsageError(
            f"{recording.path} is {recording.sensor_set}; --trajectory needs stereo or depth, such as DROID's disps.npy beside its poses"
        )
    rows = other.rows()
    stamps_ns = recording.frame_stamps_ns[indices]
    clock = clock_of(rows, recording, indices, other)
    units = _units(rows, clock, stamps_ns, other)
    each = [covered(stamps_of(rows, unit, clock), stamps_ns) for unit in units]
    check_span(stamps_ns, np.any(each, axis=0), recording, other)
    known = np.all(each, axis=0)
    is_sparse = known.sum() < 2 or np.median(np.diff(stamps_ns[known])) > GAP_NS
    whole = is_sparse or len(stamps_ns) <= _WINDOWS * _WINDOW_FRAMES
    followed = _followed(recording, indices, whole=whole)
    shown = Shown(followed, stretches(followed, known), recording.calibration.cameras[0].body_from_cam)
    found, words = _judged(rows, units, clock, shown, recording, other)
    as_read = read_as(rows, found.reading, clock)
    is_placed = covered(as_read.stamps_ns, stamps_ns)
    check_span(stamps_ns, is_placed, recording, other)
    at_frames = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    at_frames[is_placed] = [pose_at(as_read, int(stamp)) for stamp in stamps_ns[is_placed]]
    at_frames[:, :3, 3] *= found.in_metres
    at_frames = at_frames @ se3_inverse(shown.body_from(found.reading))
    if not is_placed.all():
        if not whole:
            followed = _followed(recording, indices, whole=True)
        at_frames = _bridged(at_frames, is_placed, followed, other)
        words += (
            f"; {int((~is_placed).sum())} of {len(stamps_ns)} frames without a pose are bridged by our own odometry"
        )
    return GivenPoses(Trajectory(stamps_ns, at_frames), words)


def clock_of(rows: PoseRows, recording: Recording, indices: NDArray[np.int64], other: OtherTrajectory) -> Stamps:
    """Stamps of the frames that numbers of frames mean: all of the recording, or the selected ones where rows are as many."""
    stamps, count = recording.frame_stamps_ns, len(rows.positions)
    if rows.stamps is not None or count == len(stamps):
        return stamps
    if count == len(indices):
        return stamps[indices]
    raise UsageError(
        f"{other.file} has {count} poses without stamps, {recording.name} has {len(stamps)} frames, of which {len(indices)} are "
        "selected; select those that the poses belong to with --frames, or pass a file with stamps"
    )


def _units(rows: PoseRows, clock: Stamps, stamps_ns: Stamps, other: OtherTrajectory) -> list[str | None]:
    """Units of the stamps by which poses lie at frames; RecordingError where there is none."""
    if rows.stamps is None:
        return [None]
    possible = possible_units(rows, clock)
    units: list[str | None] = [
        unit
        for unit in possible
        if other.stamps in (None, unit) and covered(stamps_of(rows, unit, clock), stamps_ns).sum() > LEAST_STRETCHES
    ]
    if not units:
        said = "in no unit" if other.stamps is None else f"in {other.stamps}"
        first, last = (format_stamp(int(stamp)) for stamp in stamps_ns[[0, -1]])
        raise RecordingError(
            f"{other.file} belongs to another recording: {said} are more than {LEAST_STRETCHES} of its {len(rows.positions)} stamps, "
            f"{rows.stamps[0] / 1e9:.9g} to {rows.stamps[-1] / 1e9:.9g}, at frames between {first} and {last} s, where half of them should "
            "be; pass the recording's own, on the cameras' clock"
        )
    return units


def _followed(recording: Recording, indices: NDArray[np.int64], *, whole: bool) -> Followed:
    """Our own odometry over all frames, or over some windows of them."""
    count = len(indices)
    spans = [(0, count)]
    if not whole:
        starts = np.linspace(0, count - _WINDOW_FRAMES, _WINDOWS).round().astype(int).tolist()
        spans = [(start, start + _WINDOW_FRAMES) for start in starts]
    rig, settings = recording.calibration, for_depths(SurveySettings(), recording.depth_sigma_px)
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
    rows: PoseRows, units: list[str | None], clock: Stamps, shown: Shown, recording: Recording, other: OtherTrajectory
) -> tuple[Judged, str]:
    """The reading that fits best, and why in words. RecordingError where none fits, UsageError where several do."""
    mounting = shown.body_from_cam
    is_camera_body = bool(np.abs(mounting - np.eye(4)).max() < 1e-3)
    candidates = list(readings(rows, units, other.said(), is_camera_body))
    found = [judge(read_as(rows, reading, clock), reading, shown, other.scale) for reading in candidates]
    found.sort(key=lambda judged: float(judged.errors.mean()) if len(judged.errors) else 0.0)
    best, rest = found[0], found[1:]
    name, count = f"{other.file.name} ({other.format})", len(shown.pairs)
    figures = " and ".join(
        f"{100 * error:.0f} % of {what}"
        for error, what in ((best.turn_error, "the turn"), (best.way_error, "the way"))
        if error is not None
    )
    if not best.fits:
        raise RecordingError(
            f"{other.file} belongs to another recording: read as {best.reading}, which fits {recording.name} best, it is off by {figures} "
            f"in the median of {count} stretches, {100 * FITS_WITHIN:.0f} % is the most; pass the poses of this recording"
        )
    same = undecided(best, rest)
    open_items = [item for item in CHOICES if len({getattr(each.reading, item) for each in (best, *same)}) > 1]
    if open_items or best.scale_within > SCALE_WITHIN:
        open_items += ["scale"] if best.scale_within > SCALE_WITHIN else []
        raise UsageError(
            f"{other.file} can be read in {len(same) + 1} ways that {recording.name} does not tell apart over {count} stretches; "
            f"say {asked(open_items)}"
        )
    words = f"trajectory {name}: {best.reading}, scale {best.in_metres:.4g}"
    if not best.is_told:
        return best, f"{words}, as said; the recording moves too little to judge it"
    following = f"; the next reading, {rest[0].reading}, by {100 * rest[0].errors.mean():.0f} %" if rest else ""
    return best, f"{words}: off our own odometry by {figures} in the median of {count} stretches{following}"


def asked(items: Iterable[str]) -> str:
    """The options that say open items of a reading."""
    return " and ".join(f"--trajectory-{item} {'|'.join(CHOICES.get(item, ('METRES',)))}" for item in items)


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
