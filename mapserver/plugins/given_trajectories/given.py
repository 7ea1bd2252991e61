"""The initial trajectory from a file of poses: read in its stated convention, compared with the recording, scaled, for every frame.

Correct poses move as the recording does. Poses of another convention rotate about other axes or backwards, move in another
direction, or are unrelated; their errors are then as large as the motion itself. Ground truth is not used.
"""

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fleetmap import geometry
from fleetmap.errors import RecordingError, UsageError
from fleetmap.geometry import Array, Indices, Mask, rotation_from_quat_wxyz, se3, se3_exp, se3_inverse, se3_log
from fleetmap.odometry.estimate import OdometryStatus
from fleetmap.recordings import Recording
from fleetmap.recordings.ordering import nearest
from fleetmap.recordings.tum import format_stamp
from fleetmap.sensors.rectification import Rectifier
from fleetmap.sensors.samples import DataIssue, ImuSamples, SensorSet, Stamps, Trajectory
from mapserver.drafting.survey_recordings import GivenPoses
from mapserver.plugins.given_trajectories.depths import DepthFrames, check_depths
from mapserver.plugins.given_trajectories.formats import WrittenPoses, read_poses
from mapserver.survey.odometry_pass import OdometryRun, SampleFeed
from mapserver.survey.settings import SurveySettings

FRAMES = ("camera", "body")
GAP_NS = 200_000_000  # largest gap of interpolated poses
NEAR_NS = 2_000_000  # a pose this close to a frame belongs to it
_STRETCH_RAD, _STRETCH_M, _STRETCH_NS = 0.15, 0.3, 1_000_000_000
_LEAST_RAD, _LEAST_M = 0.05, 0.1  # lower bounds of a motion in relative errors
LEAST_STRETCHES = 6
_STANDARD_ERRORS = 4.0
_OWN_SCALE_WITHIN = 0.01  # systematic error of scale by stereo and depth: 0.1 px in 10 px of disparity
_OUTLIER_MEDIANS = 4.0  # of the distances between translations: 3 standard deviations and more
FITS_WITHIN = 0.5  # of the motion: a trajectory further off is worse than none for most motions
SCALE_WITHIN = 0.05 * _STANDARD_ERRORS  # from the drift that the survey assumes for a given trajectory
_WINDOWS, _WINDOW_FRAMES = 5, 60
_LEAST_SPAN = 0.5  # of the frames' time
_MARGIN_NS = 1_000_000_000


@dataclass(frozen=True)
class GivenTrajectory:
    """A file of another system's poses as `StartPoses` of a build: TUM or KITTI text, DROID-SLAM's `poses.npy` or its folder.

    frame: camera (the left one) or body. scale: metres in its unit of length, None if the recording shows it.
    """

    file: Path
    frame: str = "camera"
    scale: float | None = None

    def __post_init__(self) -> None:
        """Raise UsageError for an unknown frame or an invalid scale."""
        if self.frame not in FRAMES:
            raise UsageError(f"--trajectory-frame {self.frame}: unknown frame; use one of {', '.join(FRAMES)}")
        if self.scale is not None and not 0 < self.scale < np.inf:
            raise UsageError(
                f"--trajectory-scale {self.scale}: invalid; give the metres in the file's unit of length, above 0"
            )

    def seen(self, recording: Recording, indices: Indices) -> tuple[Recording, Indices]:
        """Return a single camera's recording with depth from `disps.npy` beside DROID's poses, and the selected frames that have a depth.

        Unchanged if there is no such file or the recording needs none. UsageError without a scale, which one camera cannot
        observe. RecordingError for a file that does not match these poses and this camera.
        """
        if recording.sensor_set not in (SensorSet.MONO, SensorSet.MONO_INERTIAL):
            return recording, indices
        file = (self.file if self.file.is_dir() else self.file.parent) / "disps.npy"
        if not (self.file.is_dir() or self.file.suffix == ".npy") or not file.exists():
            return recording, indices
        if self.scale is None:
            raise UsageError(
                f"{file} holds depths of one camera, which cannot show their unit; set its metres with --trajectory-scale"
            )
        written, camera = read_poses(self.file), recording.calibration.cameras[0]
        check_depths(file, len(written.map_from_it), camera)
        stamps = stamps_on_clock(written, recording, indices, self)
        frames = nearest(recording.frame_stamps_ns, stamps)
        frame_of_row = np.where(np.abs(recording.frame_stamps_ns[frames] - stamps) > NEAR_NS, -1, frames)
        if (frame_of_row >= 0).mean() <= 0.5:
            raise RecordingError(
                f"{self.file} belongs to another recording: most of its stamps match no frame; pass the recording's own"
            )
        row_of_frame = np.full(len(recording), -1)
        row_of_frame[frame_of_row[frame_of_row >= 0]] = np.flatnonzero(frame_of_row >= 0)
        has_depth = row_of_frame[indices] >= 0
        _check_span(recording.frame_stamps_ns[indices], has_depth, recording, self)
        words = f"{int((~has_depth).sum())} of {len(indices)} frames have none in {file.name} and are left out"
        unused = "; the IMU is not used" if len(recording.imu) else ""
        seen = replace(
            recording,
            sensor_set=SensorSet.RGBD,
            calibration=replace(recording.calibration, cameras=(camera,), imu=None),
            imu=ImuSamples.empty(),
            frames=DepthFrames(recording.frames, file, row_of_frame, camera, self.scale),
            issues=(*recording.issues, DataIssue("depth of another system", words + unused)),
        )
        return seen, indices[has_depth]

    def poses_of(self, recording: Recording, indices: Indices) -> GivenPoses:
        """Return the poses of the selected frames (F,).

        Frames without poses get them from fleetmap's odometry between those with poses. UsageError for a single camera with unknown
        scale, and if too few frames have poses; RecordingError for a file that cannot be read, is of another convention (naming the one
        that fits) or of another recording.
        """
        if recording.sensor_set in (SensorSet.MONO, SensorSet.MONO_INERTIAL):
            raise UsageError(
                f"{recording.path} is {recording.sensor_set}; --trajectory needs stereo or depth, such as DROID's disps.npy beside "
                "its poses"
            )
        written = read_poses(self.file)
        stamps_ns = recording.frame_stamps_ns[indices]
        other_trajectory = Trajectory(stamps_on_clock(written, recording, indices, self), written.map_from_it)
        map_from_it = [pose_at(other_trajectory, int(stamp)) for stamp in stamps_ns]
        known = np.array([each is not None for each in map_from_it])
        if known.sum() <= LEAST_STRETCHES:
            raise _foreign_stamps(written, recording, self)
        _check_span(stamps_ns, known, recording, self)
        is_sparse = known.sum() < 2 or np.median(np.diff(stamps_ns[known])) > GAP_NS
        whole = is_sparse or len(stamps_ns) <= _WINDOWS * _WINDOW_FRAMES
        followed = _followed(recording, indices, whole=whole)
        found, words = _judged(other_trajectory, followed, stretches(followed, known), recording, self)
        words = f"trajectory {self.file.name} ({written.kind}): {words}"
        at_frames = np.array([np.eye(4) if each is None else each for each in map_from_it])
        at_frames[:, :3, 3] *= found.in_metres
        at_frames = at_frames @ se3_inverse(followed.body_from(found.reading))
        if not known.all():
            if not whole:
                followed = _followed(recording, indices, whole=True)
            at_frames = _bridged(at_frames, known, followed, self)
            gaps = f"{int((~known).sum())} of {len(stamps_ns)} frames without a pose"
            words += f"; {gaps} are bridged by our own odometry"
        return GivenPoses(Trajectory(stamps_ns, at_frames), words)


class PoseReading(NamedTuple):
    """A convention of poses: their frame, and the inversions needed to read the file that way."""

    frame: str
    is_inverted: bool = False
    is_w_first: bool = False

    def __str__(self) -> str:
        inverted = ", inverted (pose_from_map)" if self.is_inverted else ""
        return f"poses of the {self.frame}{inverted}{', quaternions w x y z' if self.is_w_first else ''}"

    def instead(self, said: str) -> str:
        """Return the steps that make the file readable if this convention fits and `said` is the named frame."""
        steps = [f"say --trajectory-frame {self.frame}"] if self.frame != said else []
        steps += ["write map_from_pose, the inverse of each pose"] if self.is_inverted else []
        steps += ["write quaternions as x y z w"] if self.is_w_first else []
        return " and ".join(steps)


class OwnMotion(NamedTuple):
    """Motion of the recording: stamps_ns (F,), frame_from_body (F, 4, 4), and the number of the connected piece (F,) of each frame,
    -1 if lost; and the mount of the camera.
    """

    stamps_ns: Stamps
    frame_from_body: Array
    piece: Indices
    body_from_cam: Array

    def body_from(self, reading: PoseReading) -> Array:
        """(4, 4) body_from_pose."""
        return self.body_from_cam if reading.frame == "camera" else np.eye(4)


class Judgement(NamedTuple):
    """A reading against the recording: metres in the file's unit of length and sigma of their logarithm, relative errors (P,) of
    stretches, medians of those of rotations and translations (None with fewer than LEAST_STRETCHES informative ones).
    """

    reading: PoseReading
    scale: float
    scale_within: float
    errors: Array
    turn_error: float | None
    way_error: float | None

    @property
    def fits(self) -> bool:
        """True if the recording does not contradict it."""
        return all(error is None or error <= FITS_WITHIN for error in (self.turn_error, self.way_error))

    @property
    def figures(self) -> str:
        """The errors as text."""
        told = ((self.turn_error, "the turn"), (self.way_error, "the way"))
        return " and ".join(f"{100 * error:.0f} % of {what}" for error, what in told if error is not None) or "nothing"

    @property
    def in_metres(self) -> float:
        """The scale, 1 if indistinguishable from it: then the file is in metres, which are more accurate than the fit."""
        return 1.0 if abs(np.log(self.scale)) <= self.scale_within else self.scale


def pose_at(as_read: Trajectory, stamp_ns: int) -> Array | None:
    """Return (4, 4) interpolated, or that of the nearest stamp if it is near, since stamps may be rounded; None without either."""
    found = as_read.at(stamp_ns, GAP_NS)
    if found is not None:
        return found
    off_ns = np.abs(as_read.stamps_ns - stamp_ns)
    return np.asarray(as_read.frame_from_body[off_ns.argmin()]) if off_ns.min() <= NEAR_NS else None


def read_as(trajectory: Trajectory, reading: PoseReading) -> Trajectory:
    """Convert poses read as map_from_pose with quaternions x y z w to another convention."""
    matrices = trajectory.frame_from_body
    if reading.is_w_first:
        xyzw = [geometry.quat_wxyz_from_rotation(each[:3, :3])[[1, 2, 3, 0]] for each in matrices]
        matrices = np.array(
            [se3(rotation_from_quat_wxyz(q), each[:3, 3]) for q, each in zip(xyzw, matrices, strict=True)]
        )
    return Trajectory(trajectory.stamps_ns, se3_inverse(matrices) if reading.is_inverted else matrices)


def stretches(followed: OwnMotion, known: Mask) -> Indices:
    """Return (P, 2) consecutive numbers of frames with poses: between each pair there was enough rotation, translation or time."""
    found: list[tuple[int, int]] = []
    for piece in np.unique(followed.piece[followed.piece >= 0]):
        numbers = np.flatnonzero(known & (followed.piece == piece))
        for number in numbers[1:]:
            begin = found[-1][1] if found and followed.piece[found[-1][1]] == piece else numbers[0]
            moved = se3_inverse(followed.frame_from_body[begin]) @ followed.frame_from_body[number]
            if (
                _angles(moved[:3, :3]) >= _STRETCH_RAD
                or np.linalg.norm(moved[:3, 3]) >= _STRETCH_M
                or followed.stamps_ns[number] - followed.stamps_ns[begin] >= _STRETCH_NS
            ):
                found.append((begin, number))
    return np.array(found, np.int64).reshape(-1, 2)


def judge(
    as_read: Trajectory, reading: PoseReading, followed: OwnMotion, pairs: Indices, scale: float | None
) -> Judgement:
    """Judge the reading with poses `as_read`, over stretches (P, 2); scale: metres in the unit of length if known."""
    ends: Array = np.array([pose_at(as_read, int(stamp)) for stamp in followed.stamps_ns[pairs.ravel()]], np.float64)
    ends = ends.reshape(-1, 2, 4, 4)
    moved = se3_inverse(ends[:, 0]) @ ends[:, 1]
    seen_ends = followed.frame_from_body[pairs] @ followed.body_from(reading)
    seen = se3_inverse(seen_ends[:, 0]) @ seen_ends[:, 1]
    turns, seen_turns = _angles(moved[:, :3, :3]), _angles(seen[:, :3, :3])
    ways, seen_ways = (np.linalg.norm(motion[:, :3, 3], axis=1) for motion in (moved, seen))
    scale, within = (scale, 0.0) if scale is not None else fitted_scale(moved[:, :3, 3], seen[:, :3, 3])
    apart = _angles(np.swapaxes(seen[:, :3, :3], 1, 2) @ moved[:, :3, :3])
    turn_size, way_size = np.maximum(turns, seen_turns), np.maximum(scale * ways, seen_ways)
    turn_errors = np.minimum(apart / np.maximum(turn_size, _LEAST_RAD), 1.0)
    off_m = np.linalg.norm(scale * moved[:, :3, 3] - seen[:, :3, 3], axis=1)
    way_errors = np.minimum(off_m / np.maximum(way_size, _LEAST_M), 1.0)
    medians = [
        float(np.median(errors[tell])) if (tell := sizes >= least).sum() >= LEAST_STRETCHES else None
        for errors, sizes, least in ((turn_errors, turn_size, _LEAST_RAD), (way_errors, way_size, _LEAST_M))
    ]
    return Judgement(reading, scale, within, 0.5 * (turn_errors + way_errors), *medians)


def is_undecided(best: Judgement, other: Judgement) -> bool:
    """True if another one is indistinguishable from the best: its errors are larger by less than the noise of the difference."""
    worse = other.errors - best.errors
    if len(worse) < LEAST_STRETCHES:
        return True
    noise = float(worse.std(ddof=1)) / np.sqrt(len(worse))
    return bool(worse.mean() <= max(_STANDARD_ERRORS * noise, 1e-6))


def fitted_scale(moved: Array, seen: Array) -> tuple[float, float]:
    """Return metres in the unit of translations moved (P, 3), given those in metres, seen (P, 3), and sigma of its logarithm.

    Both are noisy. A regression of either on the other is biased low by the share of noise in its divisor, so the truth lies between;
    the result is their geometric mean, the ratio of root mean squares. Its sigma is half of their difference, four standard
    errors and the error of the reference scale; infinite with too few moving stretches. Outliers on either side are left out.
    Source: Horn 1987, section 2.E (symmetric scale).
    """
    moving = (np.linalg.norm(seen, axis=1) >= _LEAST_M) & (np.linalg.norm(moved, axis=1) > 0)
    if moving.sum() < LEAST_STRETCHES:
        return 1.0, np.inf
    moved, seen = moved[moving], seen[moving]
    start = float(np.median(np.linalg.norm(seen, axis=1) / np.linalg.norm(moved, axis=1)))
    off_m = np.linalg.norm(start * moved - seen, axis=1)
    kept = off_m <= _OUTLIER_MEDIANS * np.median(off_m)
    moved_squared, seen_squared = (np.einsum("ni,ni->n", way, way) for way in (moved[kept], seen[kept]))
    both = float(np.einsum("ni,ni->", moved[kept], seen[kept]))
    moved_sum, seen_sum = float(moved_squared.sum()), float(seen_squared.sum())
    apart = max(np.log(np.sqrt(moved_sum * seen_sum) / both), 0.0) if both > 0 else np.inf
    error = 0.5 * float(np.linalg.norm(seen_squared / seen_sum - moved_squared / moved_sum))
    return np.sqrt(seen_sum / moved_sum), apart + _STANDARD_ERRORS * error + _OWN_SCALE_WITHIN


def _angles(rotations: Array) -> Array:
    """Return angles of rotations (..., 3, 3)."""
    chord = np.linalg.norm(rotations - np.eye(3), axis=(-2, -1)) / np.sqrt(8.0)
    return np.asarray(2.0 * np.arcsin(np.minimum(chord, 1.0)))


def stamps_on_clock(rows: WrittenPoses, recording: Recording, indices: Indices, other: GivenTrajectory) -> Stamps:
    """Return (N,) nanoseconds on the recording's clock, of stamps in seconds of that clock or since the first frame, or frame numbers.

    Rows without stamps belong to all frames, or to the selected ones: UsageError if their number matches neither. RecordingError for
    stamps of another clock.
    """
    # The other system has also read and counted damaged frames: among the selected ones those between them, and perhaps
    # those next to them
    frames, damaged = recording.frame_stamps_ns, recording.damaged_ns
    clock, chosen = np.union1d(frames, damaged), frames[indices]
    inner = np.union1d(chosen, damaged[(damaged > chosen[0]) & (damaged < chosen[-1])])
    before_ns = frames[frames < chosen[0]].max(initial=-(2**62))
    after_ns = frames[frames > chosen[-1]].min(initial=2**62)
    chosen = np.union1d(chosen, damaged[(damaged > before_ns) & (damaged < after_ns)])
    count = len(rows.map_from_it)
    if rows.stamps_ns is None:
        for counted in (clock, chosen, inner):
            if count == len(counted):
                return counted
        raise UsageError(
            f"{other.file} has {count} poses without stamps, {recording.name} has {len(clock)} frames, of which {len(chosen)} are "
            "selected; select the frames of the poses with --frames, or pass a file with stamps"
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


def _foreign_stamps(rows: WrittenPoses, recording: Recording, other: GivenTrajectory) -> RecordingError:
    stamps_ns, clock = rows.stamps_ns, recording.frame_stamps_ns
    written, frames = (
        "no stamps" if some is None else " to ".join(format_stamp(int(stamp)) for stamp in (some.min(), some.max()))
        for some in (stamps_ns, clock)
    )
    return RecordingError(
        f"{other.file} belongs to another recording: of its {len(rows.map_from_it)} poses, at {written}, almost none match frames, "
        f"{frames} s; pass the recording's own, with stamps in seconds on the cameras' clock or since the first frame, or numbers of frames"
    )


def _followed(recording: Recording, indices: Indices, *, whole: bool) -> OwnMotion:
    """Return fleetmap's odometry over all frames, or over some windows of them."""
    count = len(indices)
    spans = [(0, count)]
    if not whole:
        starts = np.linspace(0, count - _WINDOW_FRAMES, _WINDOWS).round().astype(int).tolist()
        spans = [(start, start + _WINDOW_FRAMES) for start in starts]
    rig, settings = recording.calibration, SurveySettings()
    rectifier = Rectifier(rig, has_depth=recording.sensor_set is SensorSet.RGBD)
    frame_from_body, piece, pieces = np.tile(np.eye(4), (count, 1, 1)), np.full(count, -1), 0
    for first, end in spans:
        run = OdometryRun(rig, rectifier, settings)
        feed = SampleFeed(recording.imu, recording.wheel, rectifier.imu_minus_cam_s)
        for number in range(first, end):
            frame = rectifier.rectify(recording.read_frame(int(indices[number])))
            estimate = run.handle(frame, *feed.until(frame.stamp_ns)).estimate
            is_lost = estimate.status is OdometryStatus.DEGRADED and not estimate.inertial
            pieces += is_lost or number == first  # without an IMU the next frames are not connected to the earlier ones
            piece[number] = pieces
        frame_from_body[first:end] = run.chain.odom_from_body()
    return OwnMotion(recording.frame_stamps_ns[indices], frame_from_body, piece, rig.cameras[0].body_from_cam)


def _judged(
    trajectory: Trajectory, followed: OwnMotion, pairs: Indices, recording: Recording, other: GivenTrajectory
) -> tuple[Judgement, str]:
    """Return the poses in the named convention, and text on how well they fit.

    RecordingError if another convention fits better, with what to do, or none fits; UsageError if the scale is unknown.
    """
    is_camera_body = bool(np.abs(followed.body_from_cam - np.eye(4)).max() < 1e-3)
    # A camera that is the body has one frame.
    conventions = [PoseReading(*each) for each in product(FRAMES[is_camera_body:], (False, True), (False, True))]
    every = [judge(read_as(trajectory, each), each, followed, pairs, other.scale) for each in conventions]
    best = min(every, key=lambda judged: float(judged.errors.mean()) if len(judged.errors) else 0.0)
    said = PoseReading(FRAMES[1] if is_camera_body else other.frame)
    (found,) = [each for each in every if each.reading == said]
    count = len(pairs)
    if not best.fits:
        raise RecordingError(
            f"{other.file} belongs to another recording: read as {best.reading}, which fits {recording.name} best, it is off by "
            f"{best.figures} in the median of {count} stretches, {100 * FITS_WITHIN:.0f} % is the most; pass the poses of this recording"
        )
    if found is not best and not is_undecided(best, found):
        raise RecordingError(
            f"{other.file} does not fit {recording.name} as {said}: off by {found.figures} in the median of {count} stretches, and by "
            f"{best.figures} as {best.reading}; {best.reading.instead(other.frame)}"
        )
    if found.scale_within > SCALE_WITHIN:
        raise UsageError(
            f"{recording.name} does not show the unit of {other.file}; set its metres with --trajectory-scale METRES"
        )
    words = f"{said}, scale {found.in_metres:.4g}"
    if found.turn_error is None and found.way_error is None:
        return found, f"{words}, as stated; the recording moves too little to judge it"
    return found, f"{words}: off our own odometry by {found.figures} in the median of {count} stretches"


def _check_span(stamps_ns: Stamps, is_placed: Mask, recording: Recording, other: GivenTrajectory) -> None:
    """Raise UsageError if the frames (F,) with poses span less than half of the time of all."""
    times = stamps_ns[is_placed]
    if len(times) < 2 or np.ptp(times) < _LEAST_SPAN * np.ptp(stamps_ns):
        missing = [format_stamp(int(stamp)) for stamp in stamps_ns[~is_placed]]
        raise UsageError(
            f"{other.file} has no pose for {len(missing)} of {len(stamps_ns)} frames of {recording.name}: {', '.join(missing[:5])}"
            f"{', ...' if len(missing) > 5 else ''}, and spans less than half of their time; select frames that it covers with --frames"
        )


def _bridged(at_frames: Array, is_placed: Mask, followed: OwnMotion, other: GivenTrajectory) -> Array:
    """Return the poses (F, 4, 4); missing ones follow odometry from the previous pose, adjusted to arrive at the next one."""
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
