"""EuRoC's folder layout (ASL): mav0/cam0, cam1, imu0, ground truth; also TUM-VI's export in that layout."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Array, se3_inverse
from fleetmap.recordings.calibration_files import (
    load_calibration,
    matrix_4x4,
    read_euroc_camera,
    read_euroc_imu,
    read_yaml,
)
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize
from fleetmap.recordings.folders.image_files import FileFrames, ImageFiles, existing_images, paired_cameras
from fleetmap.recordings.folders.table_files import read_ground_truth, read_imu, read_name_table
from fleetmap.recordings.ordering import ReadLog
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import Trajectory

# The second kind is TUM-VI's, whose motion-capture poses are those of the IMU
_GROUND_TRUTHS = ("mav0/state_groundtruth_estimate0/data.csv", "dso/gt_imu.csv", "mav0/mocap0/data.csv")
_CAMCHAINS = ("camchain.yaml", "dso/camchain.yaml", "mav0/camchain.yaml")


def recognises(path: Path) -> bool:
    """Whether `path` is the parent of a mav0 folder, or mav0 itself."""
    return (path / "mav0").is_dir() or (path.name == "mav0" and path.is_dir())


def open_euroc(path: Path, options: OpenOptions) -> Recording:
    """The recording in a EuRoC folder. The body is the IMU where imu0/sensor.yaml exists, else EuRoC's body frame."""
    root = path.resolve().parent if path.name == "mav0" else path
    log = ReadLog()
    cameras = _cameras(root, log)
    calibration, body_from_imu = _calibration(root, len(cameras), options, log)
    left, right = paired_cameras(cameras, log)
    parts = RecordingParts(
        path=path,
        name=root.resolve().name,
        format="euroc",
        calibration=calibration,
        frame_stamps_ns=left.stamps_ns,
        frames=FileFrames(root, log.files, left, right),
        has_right=right is not None,
        imu=read_imu(root / "mav0/imu0/data.csv", log),
        ground_truth=_ground_truth(root, body_from_imu, log),
    )
    return finalize(parts, log)


def _cameras(root: Path, log: ReadLog) -> list[ImageFiles]:
    if not (root / "mav0/cam0").is_dir():
        found = sorted(p.name for p in (root / "mav0").iterdir() if p.is_dir())
        raise RecordingError(
            f"{root}/mav0/cam0 is missing (there is {', '.join(found) or 'nothing'}); copy the recording again"
        )
    present = [name for name in ("cam0", "cam1") if (root / "mav0" / name).is_dir()]
    return [_camera(root / "mav0" / name, name, log) for name in present]


def _camera(folder: Path, name: str, log: ReadLog) -> ImageFiles:
    stamps_ns, names = read_name_table(folder / "data.csv")
    if not names:
        raise RecordingError(f"{folder / 'data.csv'} names no image; copy the recording again")
    log.files.append(folder / "data.csv")
    return existing_images(ImageFiles(stamps_ns, tuple(folder / "data" / image for image in names)), name, log)


def _calibration(root: Path, count: int, options: OpenOptions, log: ReadLog) -> tuple[RigCalibration, Array]:
    """The calibration with the IMU as body, and EuRoC's body from the IMU (4, 4)."""
    imu_file = root / "mav0/imu0/sensor.yaml"
    euroc_from_imu, noise = read_euroc_imu(imu_file) if imu_file.is_file() else (np.eye(4), None)
    given = calibration_of_options(options)
    if given is not None and options.calibration_file is not None:
        log.files.append(options.calibration_file)
        return given.calibration, euroc_from_imu
    camera_files = [root / f"mav0/cam{i}/sensor.yaml" for i in range(count)]
    if all(file.is_file() for file in camera_files):
        log.files += camera_files + ([imu_file] if noise is not None else [])
        cameras = [read_euroc_camera(file) for file in camera_files]
        imu_from_body = se3_inverse(euroc_from_imu)
        if np.array_equal(euroc_from_imu, np.eye(4)):
            return RigCalibration(tuple(cameras), noise), euroc_from_imu
        cameras_on_imu = tuple(replace(c, body_from_cam=imu_from_body @ c.body_from_cam) for c in cameras)
        return RigCalibration(cameras_on_imu, noise), euroc_from_imu
    for name in _CAMCHAINS:
        if (root / name).is_file():
            log.files.append(root / name)
            return load_calibration(root / name).calibration, euroc_from_imu
    missing = next(file for file in camera_files if not file.is_file())
    raise CalibrationError(
        f"{missing} is missing and there is no camchain.yaml; pass a calibration with --calibration FILE"
    )


def _ground_truth(root: Path, body_from_imu: Array, log: ReadLog) -> Trajectory | None:
    for name in _GROUND_TRUTHS:
        file = root / name
        if not file.is_file():
            continue
        trajectory = read_ground_truth(file, log)
        sensor_file = file.with_name("sensor.yaml")
        sensor = read_yaml(sensor_file) if sensor_file.is_file() else {}
        body_from_sensor = matrix_4x4(sensor["T_BS"], f"{sensor_file}: T_BS") if "T_BS" in sensor else np.eye(4)
        imu_from_sensor = se3_inverse(body_from_imu) @ body_from_sensor
        if trajectory is None or np.array_equal(imu_from_sensor, np.eye(4)):
            return trajectory
        return Trajectory(trajectory.stamps_ns, trajectory.frame_from_body @ se3_inverse(imu_from_sensor))
    return None
