"""Final steps of all formats: selection of sensors, and checks of the recording."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fleetmap.encoding import MOST
from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Array, so3_exps
from fleetmap.recordings.calibration_files import CalibrationFile, calibration_files, load_calibration
from fleetmap.recordings.image_series import SeriesFrames
from fleetmap.recordings.images import grey_bits, grey_peak, is_mosaic, is_wide
from fleetmap.recordings.ordering import PAIR_TOLERANCE_NS, ReadLog, check_together
from fleetmap.recordings.recording import OpenOptions, Recording, sensors_of_view
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.samples import CameraFrame, ImuSamples, PositionPrior, Stamps, Trajectory, WheelSample

_MIN_SAMPLES = 50
_TRIED_FRAMES = 5
_ACCEL_IN_G = (0.8, 1.25)
_FASTEST_GYRO_RADPS = 35.0  # 2000 deg/s, the full scale of the usual sensors
_WINDOW_S, _SMOOTH_S = 0.5, 0.1
_ROTATION_OFF = 0.02  # as of a quaternion whose length is 1 % off


@dataclass(frozen=True)
class RecordingParts:
    """Parts read by a format, input of `finalize`: the calibration's cameras follow one another view by view, as far as they have images.
    The name is the path's unless given."""

    path: Path
    format: str
    calibration: RigCalibration
    frames: SeriesFrames
    name: str = ""
    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    wheel: tuple[WheelSample, ...] = ()
    priors: tuple[PositionPrior, ...] = ()
    ground_truth: Trajectory | None = None


def calibration_of_options(options: OpenOptions, log: ReadLog) -> RigCalibration | None:
    """The calibration chosen by the caller, None to use the recording's own."""
    return None if options.calibration_file is None else logged_calibration(options.calibration_file, log).calibration


def logged_calibration(file: Path, log: ReadLog) -> CalibrationFile:
    """A calibration file, which with all that it names is part of the recording's content."""
    log.files += calibration_files(file)
    return load_calibration(file)


def _sound_truth(truth: Trajectory, log: ReadLog) -> Trajectory | None:
    """The ground truth without rows that are no pose or too far away, which are noted; None if no row is left."""
    frame_from_body = truth.frame_from_body
    near = np.asarray((np.abs(frame_from_body) <= MOST).all(axis=(1, 2)))
    rotations = np.where(near[:, None, None], frame_from_body[:, :3, :3], 0.0)
    off = rotations @ rotations.transpose(0, 2, 1) - np.eye(3)
    kept = near & np.asarray((np.abs(off) < _ROTATION_OFF).all(axis=(1, 2)))
    if not kept.all():
        words = f"{int((~kept).sum())} of {len(kept)} left out: not finite, farther than {MOST:g} m, or no rotation"
        log.note("ground truth: rows that are no pose", words)
    return Trajectory(truth.stamps_ns[kept], frame_from_body[kept]) if kept.any() else None


def finalize(parts: RecordingParts, log: ReadLog) -> Recording:
    """Build the Recording of `parts`, with the issues of `log`.

    RecordingError for no frame, for wrong units and for a first image that contradicts the calibration;
    CalibrationError for too few cameras in the calibration.
    """
    frame_stamps_ns, views = parts.frames.stamps_ns, parts.frames.views
    if len(frame_stamps_ns) == 0:
        raise RecordingError(f"{parts.path}: no frame is complete; {log.told() or 'the recording is empty'}")
    cameras, count = parts.calibration.cameras, sum(1 + ("right" in view.images) for view in views)
    if len(cameras) < count:
        raise CalibrationError(
            f"{parts.path}: {count} cameras are recorded, the calibration describes {len(cameras)}; "
            "pass one that has all with --calibration FILE"
        )
    recorded, has_depth = cameras[:count], "depth" in views[0].images
    _check_depths(parts, recorded)
    if len(cameras) > count and not has_depth:
        log.note("cameras missing", f"the calibration describes {len(cameras)}, there are images of {count}")
    imu, wheel, truth = parts.imu, parts.wheel, parts.ground_truth
    for what, stamps_ns in {
        "imu": imu.stamps_ns,
        "wheel odometry": [sample.stamp_ns for sample in wheel],
        "position priors": [prior.stamp_ns for prior in parts.priors],
        "ground truth": () if truth is None else truth.stamps_ns,
    }.items():
        check_together(np.array(stamps_ns, np.int64), what, frame_stamps_ns)
    truth = None if truth is None else _sound_truth(truth, log)
    if len(imu) and parts.calibration.imu is None:
        how = "the mounting of the IMU is unknown; pass a calibration with --calibration FILE"
        log.note("imu not used", f"{len(imu)} samples, but {how}")
        imu = ImuSamples.empty()
    if wheel and (fault := parts.calibration.wheels_fault):
        log.note("wheels not used", f"{len(wheel)} samples, but {fault}")
        wheel = ()
    check_imu_units(imu, str(parts.path))
    recording = Recording(
        path=parts.path,
        # A file's name may be no UTF-8, which reports cannot hold.
        name=(parts.name or parts.path.resolve().name).encode("utf-8", "backslashreplace").decode(),
        format=parts.format,
        sensor_set=sensors_of_view("right" in views[0].images, has_depth, len(imu) > 0),
        calibration=replace(parts.calibration, cameras=recorded, imu=parts.calibration.imu if len(imu) else None),
        frame_stamps_ns=np.ascontiguousarray(frame_stamps_ns, np.int64),
        imu=imu,
        frames=parts.frames,
        wheel=wheel,
        priors=parts.priors,
        ground_truth=truth,
        damaged_ns=_damaged_moments(log.damaged_ns, frame_stamps_ns),
    )
    if (bits := _grey_bits(parts.frames)) < 16:
        log.note(f"{bits} bits in 16", f"no value of the images is above {2**bits - 1}; they are used as {bits} bits")
        parts.frames.grey_bits = bits
    if is_mosaic(_first_frame(recording).left):
        log.note("Bayer pattern", "a mosaic of colours remains in the left images; record them with its right encoding")
    return replace(recording, issues=tuple(log.issues))


def _check_depths(parts: RecordingParts, cameras: tuple[CameraCalibration, ...]) -> None:
    """Raise CalibrationError for a camera of another view that should have depth and has none."""
    first, *others = parts.frames.views
    firsts = [n for n in range(1 + ("right" in first.images), len(cameras)) if cameras[n].has_depth]
    if len(firsts) > sum("depth" in other.images for other in others):
        names = " and ".join(f"cam{number} (--topic cam{number}_depth=/NAME)" for number in firsts)
        raise CalibrationError(
            f"{parts.path}: the calibration says has_depth of {names}, and not all of these have depth images; name the topic, or take "
            "has_depth out of the calibration to use the camera without its depth. Depth beside a pair is read from MCAP files and bags"
        )


def _damaged_moments(damaged_ns: list[int], frame_stamps_ns: Stamps) -> Stamps:
    """(D,) stamps of moments without a frame because of a damaged image, each once even if both images of a pair are damaged."""
    moments: list[int] = []
    for stamp_ns in np.setdiff1d(np.array(damaged_ns, np.int64), frame_stamps_ns).tolist():
        if not moments or stamp_ns - moments[-1] > PAIR_TOLERANCE_NS:
            moments.append(stamp_ns)
    return np.array(moments, np.int64)


def _first_frame(recording: Recording) -> CameraFrame:
    """The first of a few frames that can be decoded; RecordingError of the first one if none can."""
    faults = []
    for index in range(min(_TRIED_FRAMES, len(recording))):
        try:
            return recording.read_frame(index)
        except RecordingError as error:
            faults.append(error)
    raise faults[0]


def _grey_bits(frames: SeriesFrames) -> int:
    """Number of bits used in 16-bit left images, from a few of them: drivers store 10 and 12 bits in the lower ones."""
    peak, left = 0, frames.views[0].images["left"]
    for index in sorted({round(share * (len(left) - 1)) for share in np.linspace(0, 1, _TRIED_FRAMES)}):
        try:
            image = frames.reader.read(left.sources[index], int(left.stamps_ns[index]))
            if index == 0 and not is_wide(image):
                return 16  # the usual case: nothing more is read
            peak = max(peak, grey_peak(image))
        except RecordingError:
            continue
    return grey_bits(peak)


# ------------------------------------------------------------------------------------------------------- units of the IMU


def check_imu_units(imu: ImuSamples, where: str) -> None:
    """Raise RecordingError for an accelerometer in g and for a gyro in degrees per second.

    The accelerometer at rest or in any gentle motion measures about 9.81. The gyro is compared with the rotation of gravity in the
    accelerometer: over half a second the direction of the specific force, rotated by the integrated rate, must
    match the measured one (in slow motion to a few degrees). It is in degrees if that fails clearly and a rate 57
    times smaller explains it.
    """
    if len(imu) < _MIN_SAMPLES:
        return
    accel = float(np.median(np.linalg.norm(imu.accel_mps2, axis=1)))
    if _ACCEL_IN_G[0] <= accel <= _ACCEL_IN_G[1]:
        raise RecordingError(
            f"{where}: the accelerometer seems to be in g (median {accel:.2f}, gravity is 9.81 m/s^2); "
            "multiply it by 9.80665"
        )
    rate = float(np.percentile(np.linalg.norm(imu.gyro_radps, axis=1), 99))
    errors_rad = gravity_direction_errors_rad(imu, 1.0)
    is_off = len(errors_rad) >= 4 and np.median(errors_rad) >= np.radians(10)
    if rate > _FASTEST_GYRO_RADPS or (
        is_off and np.median(errors_rad) > 4 * np.median(gravity_direction_errors_rad(imu, np.pi / 180))
    ):
        raise RecordingError(
            f"{where}: the gyro seems to be in degrees per second (99 % of the rates are below {rate:.1f} where rad/s "
            "are expected, and the accelerometer does not see such turns); multiply it by pi/180"
        )


def gravity_direction_errors_rad(imu: ImuSamples, gyro_scale: float) -> Array:
    """(K,) angle between the measured specific force and the one predicted by the gyro times `gyro_scale`.

    Over windows of half a second, and only if both ends measure within 1 m/s^2 of gravity: otherwise the direction
    is affected by acceleration.
    """
    period_s = float(np.median(np.diff(imu.stamps_ns))) * 1e-9
    smooth = max(1, round(_SMOOTH_S / period_s))
    window = max(2, round(_WINDOW_S / period_s))
    if len(imu) <= window + 2 * smooth:
        return np.zeros(0)
    kernel = np.ones(smooth) / smooth
    accel = np.stack([np.convolve(column, kernel, "same") for column in imu.accel_mps2.T], axis=1)
    usable = np.abs(np.linalg.norm(accel, axis=1) - 9.81) < 1.0
    starts = np.arange(smooth, len(imu) - window - smooth, window)
    starts = starts[usable[starts] & usable[starts + window]]
    starts = starts[imu.stamps_ns[starts + window] - imu.stamps_ns[starts] < 1.5e9 * _WINDOW_S]
    predicted, measured = accel[starts], accel[starts + window]
    for step in range(window):
        steps_s = (imu.stamps_ns[starts + step + 1] - imu.stamps_ns[starts + step]) * 1e-9
        turns = so3_exps(-gyro_scale * steps_s[:, None] * imu.gyro_radps[starts + step])
        predicted = (turns @ predicted[:, :, None])[:, :, 0]
    norms = np.linalg.norm(predicted, axis=1) * np.linalg.norm(measured, axis=1)
    return np.asarray(np.arccos(np.clip((predicted * measured).sum(axis=1) / norms, -1, 1)))
