"""The last steps that all formats share: which sensors take part, and the checks before a recording is handed out."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings.calibration_files import CalibrationFile, load_calibration
from fleetmap.recordings.imu_units import check_imu_units
from fleetmap.recordings.ordering import ReadLog
from fleetmap.recordings.recording import FrameSource, OpenOptions, Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import ImuSamples, PositionPrior, SensorSet, Stamps, Trajectory, WheelSample


@dataclass(frozen=True)
class RecordingParts:
    """The parts that a format has read; `finalize` makes a Recording of them. The name is the path's unless given."""

    path: Path
    format: str
    calibration: RigCalibration
    frame_stamps_ns: Stamps
    frames: FrameSource
    has_right: bool = False
    has_depth: bool = False
    name: str = ""
    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    wheel: tuple[WheelSample, ...] = ()
    priors: tuple[PositionPrior, ...] = ()
    ground_truth: Trajectory | None = None


def calibration_of_options(options: OpenOptions) -> CalibrationFile | None:
    """The calibration that the caller asked for, None where the recording's own shall be used."""
    return None if options.calibration_file is None else load_calibration(options.calibration_file)


def finalize(parts: RecordingParts, log: ReadLog) -> Recording:
    """The Recording of `parts`, with the issues of `log`.

    RecordingError for no frame, for units that cannot be right and for a first image that contradicts the calibration;
    CalibrationError for too few cameras in the calibration.
    """
    if len(parts.frame_stamps_ns) == 0:
        issues = "; ".join(f"{issue.what}: {issue.detail}" for issue in log.issues)
        raise RecordingError(f"{parts.path}: no frame is complete; {issues or 'the recording is empty'}")
    cameras, count = parts.calibration.cameras, 2 if parts.has_right else 1
    if len(cameras) < count:
        raise CalibrationError(
            f"{parts.path}: {count} cameras are recorded, the calibration describes {len(cameras)}; "
            "pass one that has all with --calibration FILE"
        )
    if len(cameras) > count and not parts.has_depth:
        log.note("cameras missing", f"the calibration describes {len(cameras)}, there are images of {count}")
    imu = parts.imu
    if len(imu) and parts.calibration.imu is None:
        how = "no calibration says how the IMU is mounted; pass one with --calibration FILE"
        log.note("imu not used", f"{len(imu)} samples, but {how}")
        imu = ImuSamples.empty()
    check_imu_units(imu, str(parts.path))
    recording = Recording(
        path=parts.path,
        name=parts.name or parts.path.resolve().name,
        format=parts.format,
        sensor_set=_sensor_set(parts, imu),
        calibration=RigCalibration(
            cameras[:count], parts.calibration.imu if len(imu) else None, parts.calibration.base_from_body
        ),
        frame_stamps_ns=np.ascontiguousarray(parts.frame_stamps_ns, np.int64),
        imu=imu,
        frames=parts.frames,
        wheel=parts.wheel,
        priors=parts.priors,
        ground_truth=parts.ground_truth,
        issues=tuple(log.issues),
    )
    recording.read_frame(0)
    return recording


def _sensor_set(parts: RecordingParts, imu: ImuSamples) -> SensorSet:
    if parts.has_depth:
        return SensorSet.RGBD
    if parts.has_right:
        return SensorSet.STEREO_INERTIAL if len(imu) else SensorSet.STEREO
    return SensorSet.MONO_INERTIAL if len(imu) else SensorSet.MONO
