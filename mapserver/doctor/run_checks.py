"""Reads the frames that the checks need and runs all of them."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, se3, so3_log
from fleetmap.recordings import Recording
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier, StereoCamera
from fleetmap.sensors.samples import CameraFrame, SensorSet
from mapserver.doctor import accelerometer_images, inertial, timing
from mapserver.doctor.accelerometer_images import accelerometer_axes, fit_accelerometer
from mapserver.doctor.calibration import MeasuredCalibration, followed_frames, measure_calibration
from mapserver.doctor.camera_motion import motion_between
from mapserver.doctor.depth import depth_share, measured_depth
from mapserver.doctor.findings import Finding, Limits, Verdict, judge, not_judged
from mapserver.doctor.fixed_pattern import fine_structure, fixed_pattern
from mapserver.doctor.flicker import flicker_check
from mapserver.doctor.gyro_images import AXES, CameraTurns, gyro_check, turn_upside_down
from mapserver.doctor.lens import lens_check
from mapserver.doctor.metres import ImageMetres, Metres
from mapserver.doctor.sharpness import laplacian_variance, sharpness
from mapserver.doctor.stereo import (
    ROTATE_BACK,
    SWAPPED,
    StereoMatches,
    epipolar_error,
    match_stereo,
    swapped_cameras,
)
from mapserver.doctor.wheel_images import WheelFit, fit_wheels
from mapserver.survey.executor import SERIAL, Executor

_PAIRS = (SensorSet.STEREO, SensorSet.STEREO_INERTIAL)
SAMPLED_FRAMES = 40
_STEP_S = 0.045  # between two frames that show a speed: a step of 20 Hz
TURN_FRAMES = 200


@dataclass(frozen=True, slots=True)
class CheckResults:
    """All findings, in a fixed order, and the time offset that gyro and images show beyond the calibration's.

    measured_offset_s is None where it was not measured, or hardly. calibration: what was measured of it, nothing without a pair.
    """

    findings: list[Finding]
    measured_offset_s: float | None
    calibration: MeasuredCalibration


class _Frames:
    """Reads frames and remembers which could not be."""

    def __init__(self, recording: Recording, on_frame: Callable[[], None]) -> None:
        self._recording, self._on_frame = recording, on_frame
        self.tried = self.repeats = 0
        self.errors: list[str] = []

    def read(self, index: int) -> CameraFrame | None:
        self.tried += 1
        self._on_frame()
        try:
            return self._recording.read_frame(index)
        except RecordingError as error:
            self.errors.append(str(error))
            return None


def frames_to_check(recording: Recording, sampled: int = SAMPLED_FRAMES, turn_frames: int = TURN_FRAMES) -> int:
    """How often `run_checks` calls `on_frame`, about."""
    turns = min(turn_frames, len(recording)) if len(recording.imu) else 0
    return min(sampled, len(recording)) + turns + followed_frames(recording)


def run_checks(
    recording: Recording,
    on_frame: Callable[[], None] = lambda: None,
    *,
    sampled: int = SAMPLED_FRAMES,
    turn_frames: int = TURN_FRAMES,
    executor: Executor = SERIAL,
) -> CheckResults:
    """Everything the checks say about a recording.

    Reads at most `sampled` frames, spread over the recording, a run of `turn_frames`, and with a pair the busiest 30 s; `on_frame` is
    called after each.
    """
    stamps_ns, imu = recording.frame_stamps_ns, recording.imu
    frames = _Frames(recording, on_frame)
    shift_s = recording.calibration.cameras[0].imu_minus_cam_s
    findings = [
        timing.camera_rate(stamps_ns),
        timing.camera_gaps(stamps_ns),
        timing.imu_rate(imu.stamps_ns),
        timing.imu_gaps(imu.stamps_ns),
        timing.stamp_order(recording.issues),
        *timing.imu_noise(recording.calibration),
    ]
    rectifier = Rectifier(recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD)
    calibration = MeasuredCalibration([], None)
    seen = _sampled(recording, frames, rectifier, sampled, executor)
    findings += _soon_seen(recording, rectifier, seen, frames)
    turns: CameraTurns | None = None

    def judged(turns: CameraTurns) -> tuple[Finding, Metres]:
        """The accelerometer's axes, and who is right about metres."""
        fits = fit_accelerometer(turns, imu, shift_s) if has_gravity else []
        axes = not_judged(accelerometer_images.NAME, "there is no IMU", timing.RECORD_IMU)
        if len(imu):
            axes = accelerometer_axes(fits, recording.calibration.base_from_body if recording.wheel else None)
        given = next((fit for fit in fits if fit.is_given), None) if axes.verdict is Verdict.OK else None
        return axes, Metres.of(seen.wheels, given, seen.images, seen.image_mps)

    has_gravity = not any(f.name == inertial.NAME and f.verdict is Verdict.FAIL for f in findings)
    metres = Metres.of(seen.wheels, None, seen.images, seen.image_mps)
    used = recording
    if metres.wheels_finding().verdict is Verdict.FAIL or metres.metres_finding().verdict is Verdict.FAIL:
        turns = _camera_turns(recording, frames, rectifier, turn_frames, executor)
        if judged(turns)[1].wheels_finding().verdict is Verdict.FAIL:
            used = replace(recording, wheel=())

    if recording.sensor_set in _PAIRS:
        calibration = measure_calibration(used, on_frame, executor)
    if turns is None:
        turns = _camera_turns(recording, frames, rectifier, turn_frames, executor)
    checked, measured_offset_s = gyro_check(turns, imu, shift_s)
    upside_down = turn_upside_down(turns, imu, shift_s, rectifier.body_from_cam)
    if recording.sensor_set in _PAIRS:
        findings = [swapped_cameras(seen.pairs, upside_down=upside_down) if f.name == SWAPPED else f for f in findings]
    if upside_down:
        words = f"; or the images of all cameras are rotated by 180 degrees: {ROTATE_BACK}"
        checked = [replace(f, sentence=f.sentence + words) if f.name == AXES else f for f in checked]
    axes, metres = judged(turns)
    findings += [*checked, axes, metres.wheels_finding(), metres.metres_finding()]
    findings += [*calibration.findings, sharpness(seen.variances), flicker_check(recording, frames.read)]
    findings += [_readable(frames)]
    findings += [repeated_images(frames.repeats, min(turn_frames, len(recording)))] if len(imu) else []
    return CheckResults(findings + timing.other_issues(recording.issues), measured_offset_s, calibration)


def run_cheap_checks(recording: Recording, sampled: int) -> list[Finding]:
    """Those of `run_checks` for which the IMU and `sampled` frames will do: what can be said before a long drive begins."""
    rectifier = Rectifier(recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD)
    frames = _Frames(recording, lambda: None)
    seen = _sampled(recording, frames, rectifier, sampled, SERIAL)
    return _soon_seen(recording, rectifier, seen, frames)


@dataclass(frozen=True, slots=True)
class _Seen:
    """What frames all over the recording show.

    depth_shares: of pixels that have a depth. wheels: against the images, None without wheels. image_mps: median speed by the images.
    """

    pairs: list[StereoMatches]
    variances: list[float]
    depth_shares: list[float]
    structures: list[tuple[Array, Array]]
    images: ImageMetres | None
    wheels: WheelFit | None
    image_mps: float


def _soon_seen(recording: Recording, rectifier: Rectifier, seen: _Seen, frames: _Frames) -> list[Finding]:
    imu, shift_s = recording.imu, recording.calibration.cameras[0].imu_minus_cam_s
    overlap = timing.camera_imu_overlap(recording.frame_stamps_ns, imu.stamps_ns, shift_s)
    shutter = inertial.rolling_shutter(recording.calibration.cameras[0], imu)
    findings = [overlap, inertial.gravity_magnitude(imu), *shutter, fixed_pattern(seen.structures)]
    if recording.sensor_set in _PAIRS:
        findings += [swapped_cameras(seen.pairs), epipolar_error(seen.pairs, rectifier.camera.focal_px)]
    if recording.sensor_set is SensorSet.RGBD:
        findings.append(measured_depth(seen.depth_shares))
    return [*findings, lens_check(recording, frames.read)]


def _sampled(recording: Recording, frames: _Frames, rectifier: Rectifier, count: int, executor: Executor) -> _Seen:
    looks = list(
        executor.map(_look, (rectifier.camera, rectifier.body_from_cam), _moments(recording, frames, rectifier, count))
    )
    pairs = [look.pair for look in looks if look.pair is not None]
    depths = [look.depth_m for look in looks if np.isfinite(look.depth_m)]
    turns = _turns(look.motion for look in looks if look.motion is not None)
    speeds = np.linalg.norm(turns.ways_m, axis=1) / ((turns.ends_ns - turns.starts_ns) * 1e-9)
    wheels, rig = None, recording.calibration
    if recording.wheel:
        wheels = fit_wheels(turns, recording.wheel, rig.base_from_body, rig.cameras[0].imu_minus_cam_s)
    baseline_m = rectifier.camera.baseline_m if recording.sensor_set in _PAIRS else None
    shows_metres = recording.sensor_set in _PAIRS or recording.sensor_set is SensorSet.RGBD
    return _Seen(
        pairs,
        [look.variance for look in looks],
        [look.depth_share for look in looks if look.depth_share is not None],
        [look.structure for look in looks],
        ImageMetres(baseline_m, float(np.median(depths))) if shows_metres and depths else None,
        wheels,
        float(np.nanmedian(speeds)) if np.isfinite(speeds).any() else 0.0,
    )


_Moment = tuple[CameraFrame, RectifiedFrame, RectifiedFrame | None]


def _moments(recording: Recording, frames: _Frames, rectifier: Rectifier, count: int) -> Iterator[_Moment]:
    """Frames spread over the recording, as recorded and rectified, and the next ones where they are near and a speed is wanted."""
    stamps_ns, needs_speed = recording.frame_stamps_ns, bool(recording.wheel) or not len(recording.imu)
    for index in np.unique(np.linspace(0, len(recording) - 1, min(count, len(recording))).round().astype(int)):
        frame = frames.read(int(index))
        after = int(np.searchsorted(stamps_ns, stamps_ns[index] + int(_STEP_S * 1e9)))
        is_near = needs_speed and after < len(recording) and stamps_ns[after] - stamps_ns[index] < timing.SPARSE_S * 1e9
        other = frames.read(after) if is_near else None
        if frame is not None:
            yield frame, rectifier.rectify(frame), None if other is None else rectifier.rectify(other)


@dataclass(frozen=True, slots=True)
class _Look:
    """What one moment shows. depth_m: median, NaN if unknown."""

    variance: float
    pair: StereoMatches | None
    depth_share: float | None
    depth_m: float
    structure: tuple[Array, Array]
    motion: tuple[int, int, Array | None] | None


def _look(shared: tuple[StereoCamera, Array], moment: _Moment) -> _Look:
    (camera, _), (frame, rectified, after) = shared, moment
    pair = None if frame.right is None else match_stereo(rectified)
    share, depth_m = None, np.nan
    if frame.depth_m is not None:
        share, known = depth_share(frame.depth_m), frame.depth_m[frame.depth_m > 0]
        depth_m = float(np.median(known)) if len(known) else np.nan
    elif pair is not None and len(pair.disparities_px):
        depth_m = camera.focal_px * camera.baseline_m / max(float(np.median(pair.disparities_px)), 0.1)
    motion = (
        None if after is None or np.array_equal(rectified.left, after.left) else _motion(shared, (rectified, after))
    )
    return _Look(laplacian_variance(frame.left), pair, share, depth_m, fine_structure(frame.left), motion)


def _camera_turns(
    recording: Recording, frames: _Frames, rectifier: Rectifier, count: int, executor: Executor
) -> CameraTurns:
    pairs = _consecutive(recording, frames, rectifier, count)
    return _turns(executor.map(_motion, (rectifier.camera, rectifier.body_from_cam), pairs))


def _turns(motions: Iterable[tuple[int, int, Array | None]]) -> CameraTurns:
    """Of what `_motion` found."""
    found = [each for each in motions if each[2] is not None]
    spans = np.array([[start_ns, end_ns] for start_ns, end_ns, _ in found], np.int64).reshape(-1, 2)
    moved = np.array([motion for *_, motion in found]).reshape(-1, 4, 4)
    rates = np.array([so3_log(motion[:3, :3]) for motion in moved]).reshape(-1, 3) / (np.diff(spans) * 1e-9)
    return CameraTurns(spans[:, 0], spans[:, 1], rates, moved[:, :3, 3])


def _motion(
    shared: tuple[StereoCamera, Array], pair: tuple[RectifiedFrame, RectifiedFrame]
) -> tuple[int, int, Array | None]:
    """Stamps of two frames and the body's motion (4, 4) between them, earlier_from_later."""
    (camera, body_from_cam), (before, after) = shared, pair
    motion = motion_between(before, after, camera)
    if motion is None:
        return before.stamp_ns, after.stamp_ns, None
    axes, place = body_from_cam[:3, :3], body_from_cam[:3, 3]
    turn = axes @ motion[:3, :3] @ axes.T  # known, where the way may not be
    return before.stamp_ns, after.stamp_ns, se3(turn, axes @ motion[:3, 3] + place - turn @ place)


def _consecutive(
    recording: Recording, frames: _Frames, rectifier: Rectifier, count: int
) -> Iterator[tuple[RectifiedFrame, RectifiedFrame]]:
    """Pairs of rectified frames close in time, from the run of frames in which the gyro is busiest."""
    if len(recording.imu) == 0:
        return
    stamps_ns = recording.frame_stamps_ns
    first = _busiest_start(recording, count)
    previous: RectifiedFrame | None = None
    is_same = False
    for index in range(first, min(first + count, len(recording))):
        is_close = previous is not None and stamps_ns[index] - previous.stamp_ns < timing.SPARSE_S * 1e9
        has_next = index + 1 < len(recording) and stamps_ns[index + 1] - stamps_ns[index] < timing.SPARSE_S * 1e9
        if not (is_close or has_next):
            continue
        frame = frames.read(index)
        current = None if frame is None else rectifier.rectify(frame)
        if previous is not None and current is not None and is_close:
            is_same, was_same = np.array_equal(previous.left, current.left), is_same
            if is_same:  # a camera at rest repeats for long, and no sensor without noise repeats at all
                frames.repeats += not was_same
                continue
            yield previous, current
        previous = current


def _busiest_start(recording: Recording, count: int) -> int:
    stamps_ns, imu = recording.frame_stamps_ns, recording.imu
    if len(stamps_ns) <= count:
        return 0
    speeds = np.linalg.norm(imu.gyro_radps - np.median(imu.gyro_radps, axis=0), axis=1)
    total = np.concatenate([[0.0], np.cumsum(np.minimum(speeds, 3.0))])
    starts = np.arange(0, len(stamps_ns) - count, max(1, count // 4))
    a = np.searchsorted(imu.stamps_ns, stamps_ns[starts])
    b = np.searchsorted(imu.stamps_ns, stamps_ns[starts + count])
    return int(starts[np.argmax(total[b] - total[a])])


def repeated_images(repeats: int, count: int) -> Finding:
    """How often among `count` frames an image is the one before, and the next one is another."""
    bad = f"an image is that of the frame before, {repeats} times in {count} frames; record each image once, with its own stamp"
    return judge(
        "repeated images",
        repeats / count,
        Limits(0.02, 0.1, "of the frames"),
        "every frame has an image of its own",
        bad,
    )


def _readable(frames: _Frames) -> Finding:
    limit = "every frame that was looked at must be readable"
    if not frames.errors:
        return Finding("images", Verdict.OK, 0.0, limit, f"all {frames.tried} frames that were looked at are whole")
    sentence = f"{len(frames.errors)} of {frames.tried} cannot be read; {frames.errors[0]}"
    return Finding("images", Verdict.FAIL, float(len(frames.errors)), limit, sentence)
