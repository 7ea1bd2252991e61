"""Reads the frames that the checks need and runs all of them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, so3_log
from fleetmap.recordings import Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.rectification import RectifiedFrame, Rectifier, StereoCamera
from fleetmap.sensors.samples import CameraFrame, SensorSet
from mapserver.calibration import CalibrationEstimate
from mapserver.calibration.recordings import Follow
from mapserver.doctor import inertial, timing
from mapserver.doctor.calibration import MeasuredCalibration, measure_calibration
from mapserver.doctor.camera_rotation import rotation_between
from mapserver.doctor.depth import depth_share, measured_depth
from mapserver.doctor.findings import Finding, Verdict
from mapserver.doctor.gyro_images import CameraTurns, gyro_check
from mapserver.doctor.sharpness import laplacian_variance, sharpness
from mapserver.doctor.stereo import StereoMatches, epipolar_error, match_stereo, swapped_cameras
from mapserver.survey.executor import SERIAL, Executor, Work

_Turns = tuple[CameraTurns, int, list[str]]  # how many frames were tried, and what was wrong with some
_PAIRS = (SensorSet.STEREO, SensorSet.STEREO_INERTIAL)
SAMPLED_FRAMES = 40
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
        self.tried = 0
        self.errors: list[str] = []

    def read(self, index: int) -> CameraFrame | None:
        self.tried += 1
        self._on_frame()
        try:
            return self._recording.read_frame(index)
        except RecordingError as error:
            self.errors.append(str(error))
            return None

    def taken(self, turns: CameraTurns, tried: int, errors: list[str]) -> CameraTurns:
        """The turns of frames that were read elsewhere."""
        self.tried += tried
        self.errors += errors
        for _ in range(tried):
            self._on_frame()
        return turns


def run_checks(
    recording: Recording,
    on_frame: Callable[[], None] = lambda: None,
    *,
    sampled: int = SAMPLED_FRAMES,
    turn_frames: int = TURN_FRAMES,
    executor: Executor = SERIAL,
    follow: Follow | None = None,
) -> CheckResults:
    """Everything the checks say about a recording.

    Reads at most `sampled` frames, spread over the recording, a run of `turn_frames`, and with a pair the busiest 30 s; `on_frame` is
    called after each. follow: see `measure_calibration`.
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
    ]
    rectifier = Rectifier(recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD)
    calibration = MeasuredCalibration([], None)
    seen = _sampled(recording, frames, rectifier, sampled, executor)
    findings += _soon_seen(recording, rectifier, seen)
    beside: list[Work[_Turns]] = []

    def followed(rig: RigCalibration) -> Work[CalibrationEstimate]:
        """Turns are looked at once the estimate is on its way."""
        assert follow is not None
        work = follow(rig)
        turns = executor.beside(_turns_alone, _bare(recording), turn_frames) if not beside else None
        beside.extend([] if turns is None else [turns])
        return work

    if recording.sensor_set in _PAIRS:
        calibration = measure_calibration(recording, on_frame, executor, None if follow is None else followed)
    if beside:
        turns = frames.taken(*beside[0].result())
    else:
        turns = _camera_turns(recording, frames, rectifier, turn_frames, executor)
    checked, measured_offset_s = gyro_check(turns, imu, shift_s)
    findings += [*checked, *calibration.findings, sharpness(seen.variances), _readable(frames)]
    return CheckResults(findings + timing.other_issues(recording.issues), measured_offset_s, calibration)


def run_cheap_checks(recording: Recording, sampled: int) -> list[Finding]:
    """Those of `run_checks` for which the IMU and `sampled` frames will do: what can be said before a long drive begins."""
    rectifier = Rectifier(recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD)
    seen = _sampled(recording, _Frames(recording, lambda: None), rectifier, sampled, SERIAL)
    return _soon_seen(recording, rectifier, seen)


@dataclass(frozen=True, slots=True)
class _Seen:
    """What frames all over the recording show. depth_shares: of pixels that have a depth."""

    pairs: list[StereoMatches]
    variances: list[float]
    depth_shares: list[float]


def _soon_seen(recording: Recording, rectifier: Rectifier, seen: _Seen) -> list[Finding]:
    imu, shift_s = recording.imu, recording.calibration.cameras[0].imu_minus_cam_s
    overlap = timing.camera_imu_overlap(recording.frame_stamps_ns, imu.stamps_ns, shift_s)
    findings = [overlap, inertial.gravity_magnitude(imu)]
    if recording.sensor_set in _PAIRS:
        findings += [swapped_cameras(seen.pairs), epipolar_error(seen.pairs, rectifier.camera.focal_px)]
    if recording.sensor_set is SensorSet.RGBD:
        findings.append(measured_depth(seen.depth_shares))
    return findings


def _sampled(recording: Recording, frames: _Frames, rectifier: Rectifier, count: int, executor: Executor) -> _Seen:
    seen = _Seen([], [], [])
    for variance, pair, share in executor.map(_look, None, _moments(recording, frames, rectifier, count)):
        seen.variances.append(variance)
        seen.pairs.extend([] if pair is None else [pair])
        seen.depth_shares.extend([] if share is None else [share])
    return seen


def _moments(
    recording: Recording, frames: _Frames, rectifier: Rectifier, count: int
) -> Iterator[tuple[CameraFrame, RectifiedFrame | None]]:
    """Frames spread over the recording: as recorded, and the pair where there is a right picture."""
    for index in np.unique(np.linspace(0, len(recording) - 1, min(count, len(recording))).round().astype(int)):
        frame = frames.read(int(index))
        if frame is not None:
            yield frame, None if frame.right is None else rectifier.rectify(frame)


def _look(
    _: None, moment: tuple[CameraFrame, RectifiedFrame | None]
) -> tuple[float, StereoMatches | None, float | None]:
    frame, pair = moment
    share = None if frame.depth_m is None else depth_share(frame.depth_m)
    return laplacian_variance(frame.left), None if pair is None else match_stereo(pair), share


def _camera_turns(
    recording: Recording, frames: _Frames, rectifier: Rectifier, count: int, executor: Executor
) -> CameraTurns:
    starts, ends, rates = [], [], []
    pairs = _consecutive(recording, frames, rectifier, count)
    for start_ns, end_ns, rate in executor.map(_turn, (rectifier.camera, rectifier.body_from_cam[:3, :3]), pairs):
        if rate is not None:
            starts.append(start_ns)
            ends.append(end_ns)
            rates.append(rate)
    return CameraTurns(np.array(starts, np.int64), np.array(ends, np.int64), np.array(rates).reshape(-1, 3))


def _bare(recording: Recording) -> Recording:
    """What turns are seen in, to be read in another process."""
    part = recording.part(np.arange(len(recording)))
    return replace(part, wheel=(), priors=(), ground_truth=None, issues=())


def _turns_alone(recording: Recording, count: int) -> _Turns:
    """The camera's turns in a recording, which is closed then."""
    with recording:
        frames = _Frames(recording, lambda: None)
        rectifier = Rectifier(recording.calibration, has_depth=recording.sensor_set is SensorSet.RGBD)
        return _camera_turns(recording, frames, rectifier, count, SERIAL), frames.tried, frames.errors


def _turn(
    shared: tuple[StereoCamera, Array], pair: tuple[RectifiedFrame, RectifiedFrame]
) -> tuple[int, int, Array | None]:
    """Stamps of two frames and the body's angular rate (3,) between them."""
    (camera, rotation), (before, after) = shared, pair
    before_from_after = rotation_between(before, after, camera)
    if before_from_after is None:
        return before.stamp_ns, after.stamp_ns, None
    dt_s = (after.stamp_ns - before.stamp_ns) * 1e-9
    return before.stamp_ns, after.stamp_ns, so3_log(rotation @ before_from_after @ rotation.T) / dt_s


def _consecutive(
    recording: Recording, frames: _Frames, rectifier: Rectifier, count: int
) -> Iterator[tuple[RectifiedFrame, RectifiedFrame]]:
    """Pairs of rectified frames close in time, from the run of frames in which the gyro is busiest."""
    if len(recording.imu) == 0:
        return
    stamps_ns = recording.frame_stamps_ns
    first = _busiest_start(recording, count)
    previous: RectifiedFrame | None = None
    for index in range(first, min(first + count, len(recording))):
        is_close = previous is not None and stamps_ns[index] - previous.stamp_ns < timing.SPARSE_S * 1e9
        has_next = index + 1 < len(recording) and stamps_ns[index + 1] - stamps_ns[index] < timing.SPARSE_S * 1e9
        if not (is_close or has_next):
            continue
        frame = frames.read(index)
        current = None if frame is None else rectifier.rectify(frame)
        if previous is not None and current is not None and is_close:
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


def _readable(frames: _Frames) -> Finding:
    limit = "every frame that was looked at must be readable"
    if not frames.errors:
        return Finding("images", Verdict.OK, 0.0, limit, f"all {frames.tried} frames that were looked at are whole")
    sentence = f"{len(frames.errors)} of {frames.tried} cannot be read; {frames.errors[0]}"
    return Finding("images", Verdict.FAIL, float(len(frames.errors)), limit, sentence)
