"""The last steps that all formats share: which sensors take part, and the checks before a recording is handed out."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings.calibration_files import CalibrationFile, load_calibration
from fleetmap.recordings.imu_units import check_imu_units
from fleetmap.recordings.recording import FrameSource, OpenOptions, Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import DataIssue, ImuSamples, PositionPrior, SensorSet, Stamps, Trajectory, WheelSample


@dataclass
class Parts:
    """What a format has found; `assemble` makes a Recording of it."""

    path: Path
    name: str
    format: str
    calibration: RigCalibration
    frame_stamps_ns: Stamps
    frames: FrameSource
    has_right: bool
    has_depth: bool = False
    imu: ImuSamples = field(default_factory=ImuSamples.empty)
    wheel: tuple[WheelSample, ...] = ()
    priors: tuple[PositionPrior, ...] = ()
    ground_truth: Trajectory | None = None
    losses: list[DataIssue] = field(default_factory=list)


def calibration_of_options(options: OpenOptions) -> CalibrationFile | None:
    """The calibration that the caller asked for, None where the recording's own shall be used."""
    return None if options.calibration_file is None else load_calibration(options.calibration_file)


def assemble(parts: Parts) -> Recording:
    """The Recording of what was found.

    RecordingError for no frame, for units that cannot be right and for a first image that contradicts the calibration;
    CalibrationError for too few cameras in the calibration.
    """
    if len(parts.frame_stamps_ns) == 0:
        raise RecordingError(
            f"{parts.path}: no frame is complete; {_in_words(parts.losses) or 'the recording is empty'}"
        )
    wanted = 2 if parts.has_right else 1
    if len(parts.calibration.cameras) < wanted:
        raise CalibrationError(
            f"{parts.path}: {wanted} cameras are recorded, the calibration describes {len(parts.calibration.cameras)}; "
            "pass one that has all with --calibration FILE"
        )
    if len(parts.calibration.cameras) > wanted and not parts.has_depth:
        described = len(parts.calibration.cameras)
        parts.losses.append(
            DataIssue("cameras missing", f"the calibration describes {described}, there are images of {wanted}")
        )
    imu = _usable_imu(parts)
    check_imu_units(imu, str(parts.path))
    recording = Recording(
        path=parts.path,
        name=parts.name,
        format=parts.format,
        sensor_set=_sensor_set(parts, imu),
        calibration=_only_used(parts.calibration, wanted, imu),
        frame_stamps_ns=np.ascontiguousarray(parts.frame_stamps_ns, np.int64),
        imu=imu,
        frames=parts.frames,
        wheel=parts.wheel,
        priors=parts.priors,
        ground_truth=parts.ground_truth,
        losses=tuple(parts.losses),
    )
    recording.read_frame(0)
    return recording


def _usable_imu(parts: Parts) -> ImuSamples:
    if len(parts.imu) == 0 or parts.calibration.imu is not None:
        return parts.imu
    parts.losses.append(
        DataIssue(
            "imu not used",
            f"{len(parts.imu)} samples, but no calibration says how the IMU is mounted; pass one with --calibration "
            f"FILE",
        )
    )
    return ImuSamples.empty()


def _only_used(calibration: RigCalibration, wanted: int, imu: ImuSamples) -> RigCalibration:
    return RigCalibration(
        calibration.cameras[:wanted], calibration.imu if len(imu) else None, calibration.base_from_body
    )


def _sensor_set(parts: Parts, imu: ImuSamples) -> SensorSet:
    if parts.has_depth:
        return SensorSet.RGBD
    if parts.has_right:
        return SensorSet.STEREO_INERTIAL if len(imu) else SensorSet.STEREO
    return SensorSet.MONO_INERTIAL if len(imu) else SensorSet.MONO


def _in_words(losses: list[DataIssue]) -> str:
    return "; ".join(f"{loss.what}: {loss.detail}" for loss in losses)
