"""Reads the frames for the checks and runs all checks."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from fleetmap.errors import RecordingError, SurveyError
from fleetmap.geometry import Array
from fleetmap.odometry.accelerometer_check import LONGEST_STEP_NS
from fleetmap.recordings import Recording
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier, StereoCamera
from fleetmap.sensors.samples import CameraFrame, SensorSet
from mapserver.calibration.motion_rows import CalibrationData
from mapserver.calibration.recordings import Follow, stretches
from mapserver.doctor import accelerometer_images, images, sensors
from mapserver.doctor.accelerometer_images import AxesFit, accelerometer_axes, fit_accelerometer
from mapserver.doctor.calibration import MeasuredCalibration, followed_frames, measure_calibration, unknown_calibration
from mapserver.doctor.camera_motion import CameraTurns, OdometryTurns, body_motion
from mapserver.doctor.findings import Finding, Limits, Verdict, judge, not_judged, worst
from mapserver.doctor.gyro_images import AXES, OFFSET, GyroFit, gyro_check, turn_upside_down
from mapserver.doctor.metres import ImageMetres, WheelFit, fit_wheels, judge_metres
from mapserver.doctor.stereo import ROTATE_BACK, SWAPPED, StereoMatches, epipolar_error, match_stereo, swapped_cameras
from mapserver.survey.executor import SERIAL, Executor
from mapserver.survey.settings import SurveySettings
from mapserver.survey.survey_inputs import SurveyTools, TrackedFrame

_PAIRS = (SensorSet.STEREO, SensorSet.STEREO_INERTIAL)
SAMPLED_FRAMES = 20
_MATCHED_EVERY = 4  # of those, where the matches of so few pairs are good
_LONGEST_STEP_S = 0.7e-9 * LONGEST_STEP_NS  # of an IMU whose steps vary
_STEP_S = 0.045  # between two frames for a speed: one step at 20 Hz
TURN_FRAMES = 120
_EARLY = TURN_FRAMES // 2, TURN_FRAMES  # frames after which a drive is doubted at once, not at its end
# Above, or with fewer of the frames, the odometry's turns are no certificate
_CERTAIN_OFFSET_S, _CERTAIN_SHARE = 0.003, 0.9


@dataclass(frozen=True, slots=True)
class CheckResults:
    """All findings, in a fixed order.

    gyro: its fit to the images, None if unknown. calibration: its measurement, empty without a pair. metres: of a metre of the images, with
    the sigma, by wheels and accelerometer as far as these know it.
    """

    findings: list[Finding]
    gyro: GyroFit | None
    calibration: MeasuredCalibration
    metres: Mapping[str, tuple[float, float]] = field(default_factory=dict)


_Moment = tuple[CameraFrame, RectifiedFrame, RectifiedFrame | None, bool]


class _Frames:
    """Reads the frames of a recording and records the unreadable ones, also as the source of its `recording`'s frames."""

    def __init__(self, recording: Recording, on_frame: Callable[[], None]) -> None:
        self.source, self._on_frame = recording.frames, on_frame
        self.stored, self.part, self.hash_into = self.source.stored, self.source.part, self.source.hash_into
        self.close, self.recording = self.source.close, replace(recording, frames=self)
        self.errors: dict[int, str] = {}
        self.rectifier = Rectifier(recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD)
        self.rig = self.rectifier.camera, self.rectifier.body_from_cam
        self.tried: set[int] = set()
        self.repeats = 0

    def frame(self, index: int) -> CameraFrame:
        """See FrameSource."""
        try:
            return self.source.frame(index)
        except RecordingError as error:
            self.errors[index] = str(error)
            raise

    def read(self, index: int) -> CameraFrame | None:
        self.tried.add(index)
        self._on_frame()
        try:
            return self.recording.read_frame(index)
        except RecordingError as error:
            self.errors[index] = str(error)
            return None

    def _rectified(self, index: int) -> RectifiedFrame | None:
        frame = self.read(index)
        return None if frame is None else self.rectifier.rectify(frame)

    def moments(self, matched_every: int) -> Iterator[_Moment]:
        """Yield frames over the recording, raw and rectified, the next ones if near and a speed is needed, and if their pair is matched."""
        stamps_ns = self.recording.frame_stamps_ns
        needs_speed = bool(self.recording.wheel) or not len(self.recording.imu)
        spread = np.linspace(0, len(stamps_ns) - 1, min(SAMPLED_FRAMES, len(stamps_ns))).round().astype(int)
        for number, index in enumerate(np.unique(spread)):
            frame = self.read(int(index))
            after = int(np.searchsorted(stamps_ns, stamps_ns[index] + int(_STEP_S * 1e9)))
            is_near = after < len(stamps_ns) and stamps_ns[after] - stamps_ns[index] < sensors.SPARSE_S * 1e9
            later = self._rectified(after) if needs_speed and is_near else None
            if frame is not None:
                yield frame, self.rectifier.rectify(frame), later, number % matched_every == 0

    def consecutive(self, count: int) -> Iterator[tuple[RectifiedFrame, RectifiedFrame]]:
        """Yield pairs of rectified frames close in time, from the run of frames with the fastest rotation by the gyro."""
        if len(self.recording.imu) == 0:
            return
        stamps_ns, first = self.recording.frame_stamps_ns, self._busiest_start(count)
        previous: RectifiedFrame | None = None
        is_same = False
        for index in range(first, min(first + count, len(stamps_ns))):
            is_close = previous is not None and stamps_ns[index] - previous.stamp_ns < sensors.SPARSE_S * 1e9
            has_next = index + 1 < len(stamps_ns) and stamps_ns[index + 1] - stamps_ns[index] < sensors.SPARSE_S * 1e9
            if not (is_close or has_next):
                continue
            current = self._rectified(index)
            if previous is not None and current is not None and is_close:
                is_same, was_same = np.array_equal(previous.left, current.left), is_same
                if is_same:  # long repeats are a camera at rest; sensor noise excludes exact repeats
                    self.repeats += not was_same
                    continue
                yield previous, current
            previous = current

    def _busiest_start(self, count: int) -> int:
        stamps_ns, imu = self.recording.frame_stamps_ns, self.recording.imu
        if len(stamps_ns) <= count:
            return 0
        speeds = np.linalg.norm(imu.gyro_radps - np.median(imu.gyro_radps, axis=0), axis=1)
        total = np.concatenate([[0.0], np.cumsum(np.minimum(speeds, 3.0))])
        starts = np.arange(0, len(stamps_ns) - count, max(1, count // 4))
        a, b = (np.searchsorted(imu.stamps_ns, stamps_ns[edges]) for edges in (starts, starts + count))
        return int(starts[np.argmax(total[b] - total[a])])


def frames_to_check(recording: Recording) -> int:
    """Return the approximate number of `on_frame` calls by `run_checks`."""
    turns = min(TURN_FRAMES, len(recording)) if len(recording.imu) else 0
    return min(SAMPLED_FRAMES, len(recording)) + turns + followed_frames(recording)


def run_checks(
    recording: Recording,
    on_frame: Callable[[], None] = lambda: None,
    executor: Executor = SERIAL,
    follow: Follow | None = None,
    before_calibration: Callable[[Sequence[Finding]], None] = lambda _: None,
) -> CheckResults:
    """Return the findings of all checks of a recording.

    Reads SAMPLED_FRAMES over the recording, and with a pair the frames of `follow`, by default the 30 s with the most motion; if these do
    not certify the IMU, also a run of TURN_FRAMES. `on_frame` is called after each. before_calibration: called with the findings before the
    calibration is measured.
    """
    frames = _Frames(recording, on_frame)
    recording, seen = frames.recording, _sampled(frames, executor)
    imu, has_pair, camera = recording.imu, recording.sensor_set in _PAIRS, recording.calibration.cameras[0]
    soon = _soon_seen(frames, seen)

    stamps = [*sensors.camera_checks(recording.frame_stamps_ns), *sensors.imu_checks(imu.stamps_ns)]
    stamps += [sensors.stamp_order(recording.issues), *sensors.imu_noise(recording.calibration)]
    follow = follow or stretches(SurveySettings(), SurveyTools(progress=lambda *_: on_frame(), executor=executor))
    by_turns, data = None, None
    is_sound = not any(f.verdict is Verdict.FAIL for f in (*stamps, *soon))
    if has_pair and len(imu) and is_sound and followed_frames(recording):
        by_turns, data = _by_odometry(frames, soon, follow, seen)
    if by_turns is None:
        pairs = frames.consecutive(TURN_FRAMES)
        by_turns = _by_turns(recording, CameraTurns.of(executor.map(body_motion, frames.rig, pairs)), soon)
    turns, gyro, gyro_fit, axes, given = by_turns
    upside_down = turn_upside_down(turns, imu, camera.imu_minus_cam_s, frames.rectifier.body_from_cam)
    if has_pair:
        soon = [_of_pairs(frames, seen.looks, upside_down)[0] if f.name == SWAPPED else f for f in soon]
    if upside_down:
        words = f"; or the images of all cameras are rotated by 180 degrees: {ROTATE_BACK}"
        gyro = [replace(f, sentence=f.sentence + words) if f.name == AXES else f for f in gyro]

    wheels, metres = judge_metres(seen.wheels, given, seen.images, has_imu=len(imu) > 0)

    findings = [*stamps, *soon, *gyro, axes, wheels, metres]
    before_calibration(findings)
    calibration = MeasuredCalibration([], None)
    if has_pair and gyro_fit is not None and gyro_fit.is_unsteady:
        reason = "the stamps of images and IMU drift against each other"
        calibration = unknown_calibration(reason, "stamp both by one clock, each image at its exposure")
    elif has_pair:
        is_wrong = wheels.verdict is Verdict.FAIL
        used = replace(recording, wheel=()) if is_wrong else recording
        calibration = measure_calibration(used, follow, None if is_wrong else data)

    findings += [*calibration.findings, images.sharpness([look.variance for look in seen.looks])]
    findings += [images.flicker_check(recording, frames.read), _readable(frames)]
    if len(imu):
        findings.append(_repeated(frames.repeats, min(TURN_FRAMES, len(recording))))
    known = {}
    if seen.wheels is not None and seen.wheels.size:
        known["the wheels"] = seen.wheels.size, seen.wheels.speed_sigma
    if given is not None and given.metres > 0:
        known["the accelerometer"] = given.metres, given.sigma
    return CheckResults(findings + sensors.other_issues(recording.issues), gyro_fit, calibration, known)


def _repeated(repeats: int, count: int) -> Finding:
    bad = f"an image repeats the previous one {repeats} times in {count} frames; record each image once, with its own stamp"
    limits = Limits(0.02, 0.1, "of the frames")
    return judge("repeated images", repeats / count, limits, "every frame has an image of its own", bad)


class _ByTurns(NamedTuple):
    """Findings about IMU and images by the camera's turns. given: fit with the given axes of the accelerometer, if they are right."""

    turns: CameraTurns
    gyro: list[Finding]
    gyro_fit: GyroFit | None
    axes: Finding
    given: AxesFit | None

    @property
    def is_unsteady(self) -> bool:
        """True if the two clocks drift against each other, and all else is good."""
        others = worst([*(f for f in self.gyro if f.name != OFFSET), self.axes])
        return self.gyro_fit is not None and self.gyro_fit.is_unsteady and others is Verdict.OK

    @property
    def verdict(self) -> Verdict:
        """The worst of them; a doubtful offset is no good one."""
        is_late = self.gyro_fit is not None and abs(self.gyro_fit.offset_s) > _CERTAIN_OFFSET_S
        return max(worst([*self.gyro, self.axes]), Verdict.WARN if is_late else Verdict.OK, key=list(Verdict).index)


def _by_turns(recording: Recording, turns: CameraTurns, soon: Sequence[Finding]) -> _ByTurns:
    shift_s = recording.calibration.cameras[0].imu_minus_cam_s
    return _ByTurns(turns, *gyro_check(turns, recording.imu, shift_s), *_accelerometer(recording, turns, soon))


class _Doubt(Exception):  # noqa: N818 -- no error: what it ends is done otherwise
    """The first turns of a drive do not agree with its IMU."""


def _by_odometry(
    frames: _Frames, soon: Sequence[Finding], follow: Follow, sampled: "_Seen"
) -> tuple[_ByTurns | None, CalibrationData | None]:
    """Return the findings by the turns that the odometry of the drive sees, and its data; None as far as they are not certain.

    Odometry searches points where the IMU predicts them: what it says of a sound IMU is right, but who doubts the IMU must not need it.
    """
    recording, seen = frames.recording, OdometryTurns(frames.rectifier.body_from_cam)

    def watch(tracked: TrackedFrame) -> None:
        seen.add(tracked)
        is_early = len(seen.motions) in _EARLY
        if is_early and _by_turns(recording, CameraTurns.of(seen.motions), soon).verdict is Verdict.FAIL:
            raise _Doubt

    try:
        data = follow(recording, recording.calibration, watch)
    except (RecordingError, SurveyError, np.linalg.LinAlgError, _Doubt):
        return None, None
    turns = CameraTurns.of(seen.motions)
    is_whole = not seen.repeats and len(turns.starts_ns) > _CERTAIN_SHARE * len(seen.motions)
    found = _by_turns(recording, turns, soon) if is_whole else None
    if found is not None and found.is_unsteady:  # what TURN_FRAMES are too few to show, and what refuses no recording
        return found, data
    if found is None or found.verdict is not Verdict.OK:
        return None, data
    # The fit of a metre is biased by noise of the images, and over a whole drive surer than that: it certifies, but refuses nothing.
    _, metres = judge_metres(sampled.wheels, found.given, sampled.images, has_imu=True)
    return found if metres.verdict in (Verdict.OK, Verdict.NOT_JUDGED) else None, data


def _accelerometer(recording: Recording, turns: CameraTurns, soon: Sequence[Finding]) -> tuple[Finding, AxesFit | None]:
    """Return the finding of the accelerometer's axes; and the fit with the given ones, if they are right."""
    if not len(recording.imu):
        return not_judged(accelerometer_images.NAME, *sensors.NO_IMU), None
    has_gravity = not any(f.name == sensors.GRAVITY and f.verdict is Verdict.FAIL for f in soon)
    shift_s = recording.calibration.cameras[0].imu_minus_cam_s
    fits = fit_accelerometer(turns, recording.imu, shift_s) if has_gravity else []
    period_s = sensors.median_period_s(recording.imu.stamps_ns)
    if has_gravity and not fits and period_s > _LONGEST_STEP_S:
        seldom = f"{1 / period_s:.0f} samples a second do not show how the velocity changes"
        return not_judged(accelerometer_images.NAME, seldom, sensors.FASTER_IMU), None
    axes = accelerometer_axes(fits, recording.calibration.base_from_body if recording.wheel else None)
    return axes, next((fit for fit in fits if fit.is_given), None) if axes.verdict is Verdict.OK else None


def run_cheap_checks(recording: Recording) -> list[Finding]:
    """Return the findings of `run_checks` that need only the IMU and SAMPLED_FRAMES: for use before a long drive begins."""
    frames = _Frames(recording, lambda: None)
    return _soon_seen(frames, _sampled(frames, SERIAL))


class _Seen(NamedTuple):
    """Results of frames all over the recording. wheels: against the images, None without wheels; images: None for one camera."""

    looks: list["_Look"]
    images: ImageMetres | None
    wheels: WheelFit | None


def _soon_seen(frames: _Frames, seen: _Seen) -> list[Finding]:
    recording, imu, camera = frames.recording, frames.recording.imu, frames.recording.calibration.cameras[0]
    overlap = sensors.camera_imu_overlap(recording.frame_stamps_ns, imu.stamps_ns, camera.imu_minus_cam_s)
    shutter = sensors.rolling_shutter(camera, imu)
    findings = [
        overlap,
        sensors.gravity_magnitude(imu),
        *shutter,
        images.fixed_pattern([look.structure for look in seen.looks]),
    ]
    if recording.sensor_set in _PAIRS:
        findings += _of_pairs(frames, seen.looks)
    if recording.sensor_set is SensorSet.RGBD:
        shares = [look.depth_share for look in seen.looks if look.depth_share is not None]
        findings.append(images.measured_depth(shares))
    return [*findings, images.lens_check(recording, frames.read)]


def _of_pairs(frames: _Frames, looks: Sequence["_Look"], upside_down: bool | None = None) -> list[Finding]:
    pairs = [look.pair for look in looks if look.pair is not None]
    return [swapped_cameras(pairs, upside_down=upside_down), epipolar_error(pairs, frames.rectifier.camera.focal_px)]


def _sampled(frames: _Frames, executor: Executor) -> _Seen:
    recording, looks = frames.recording, list(executor.map(_look, frames.rig, frames.moments(_MATCHED_EVERY)))
    if recording.sensor_set in _PAIRS and worst(_of_pairs(frames, looks)) is not Verdict.OK:
        looks = list(executor.map(_look, frames.rig, frames.moments(1)))
    depths = [look.depth_m for look in looks if np.isfinite(look.depth_m)]
    turns = CameraTurns.of(look.motion for look in looks if look.motion is not None)
    metres, wheels, calibration = None, None, recording.calibration
    if recording.wheel:
        shift_s = calibration.cameras[0].imu_minus_cam_s
        wheels = fit_wheels(turns, recording.wheel, calibration.base_from_body, shift_s)
    if depths and (recording.sensor_set in _PAIRS or recording.sensor_set is SensorSet.RGBD):
        speeds = np.linalg.norm(turns.ways_m, axis=1) / ((turns.ends_ns - turns.starts_ns) * 1e-9)
        speed_mps = float(np.nanmedian(speeds)) if np.isfinite(speeds).any() else 0.0
        baseline_m = frames.rectifier.camera.baseline_m if recording.sensor_set in _PAIRS else None
        metres = ImageMetres(baseline_m, float(np.median(depths)), speed_mps)
    return _Seen(looks, metres, wheels)


class _Look(NamedTuple):
    """Results of one moment. depth_share: of pixels with a depth; depth_m: median, NaN if unknown. motion: as `body_motion`, None if not
    computed."""

    variance: float
    pair: StereoMatches | None
    depth_share: float | None
    depth_m: float
    structure: tuple[Array, Array]
    motion: tuple[int, int, Array | None] | None


def _look(rig: tuple[StereoCamera, Array], moment: _Moment) -> _Look:
    (camera, _), (frame, rectified, after, is_matched) = rig, moment
    pair = match_stereo(rectified) if is_matched and frame.right is not None else None
    share, depth_m = None, np.nan
    if frame.depth_m is not None:
        share, known = images.depth_share(frame.depth_m), frame.depth_m[frame.depth_m > 0]
        depth_m = float(np.median(known)) if len(known) else np.nan
    elif pair is not None and len(pair.disparities_px):
        depth_m = camera.focal_px * camera.baseline_m / max(float(np.median(pair.disparities_px)), 0.1)
    motion = None
    if after is not None and not np.array_equal(rectified.left, after.left):
        motion = body_motion(rig, (rectified, after))
    variance, structure = images.laplacian_variance(frame.left), images.fine_structure(frame.left)
    return _Look(variance, pair, share, depth_m, structure, motion)


def _readable(frames: _Frames) -> Finding:
    tried, errors = len(frames.tried | frames.errors.keys()), list(frames.errors.values())
    bad = f"{len(errors)} of {tried} cannot be read; {''.join(errors[:1])}"
    limits = Limits(0, 0, words="every checked frame must be readable")
    return judge("images", float(len(errors)), limits, f"all {tried} checked frames are readable", bad)
