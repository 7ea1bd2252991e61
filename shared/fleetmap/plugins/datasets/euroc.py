"""EuRoC's folder layout (ASL): mav0/cam0, cam1, imu0, ground truth; also TUM-VI's export in that layout."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Array, se3_inverse
from fleetmap.plugins.datasets.layout import existing_images, read_ground_truth, read_image_list, read_imu, rig_frames
from fleetmap.recordings import OpenOptions, Recording, RecordingFormat
from fleetmap.recordings.calibration_files import calibration_files, camera_of, imu_noise, read_yaml
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize, logged_calibration
from fleetmap.recordings.ordering import ReadLog
from fleetmap.sensors.calibration import CameraCalibration, ImuNoise, RigCalibration, check_camera
from fleetmap.sensors.samples import Trajectory

# The second kind is TUM-VI's, whose motion-capture poses are those of the IMU
_GROUND_TRUTHS = ("mav0/state_groundtruth_estimate0/data.csv", "dso/gt_imu.csv", "mav0/mocap0/data.csv")
_MOST_CAMERAS = 16
_CAMCHAINS = ("camchain.yaml", "dso/camchain.yaml", "mav0/camchain.yaml")


def recognises(path: Path) -> bool:
    """True for the parent of a mav0 folder, or mav0 itself."""
    return (path / "mav0").is_dir() or (path.name == "mav0" and path.is_dir())


def open_euroc(path: Path, options: OpenOptions) -> Recording:
    """Open the recording in a EuRoC folder. The body is the IMU if imu0/sensor.yaml exists, else EuRoC's body frame."""
    root = path.resolve().parent if path.name == "mav0" else path
    log = ReadLog()
    if not (root / "mav0/cam0").is_dir():
        there = ", ".join(sorted(p.name for p in (root / "mav0").iterdir() if p.is_dir())) or "nothing"
        raise RecordingError(f"{root}/mav0/cam0 is missing (there is {there}); copy the recording again")
    cameras = []
    for folder in (root / f"mav0/cam{number}" for number in range(_MOST_CAMERAS)):
        if folder.is_dir():
            stamps_ns, names = read_image_list(folder / "data.csv", log)
            images = [folder / "data" / name.relative_to(folder) for name in names]
            cameras.append(existing_images(stamps_ns, images, folder.name, log))
    calibration, euroc_from_imu = _calibration(root, len(cameras), options, log)
    frames = rig_frames(root, log, cameras, calibration)
    imu = read_imu(root / "mav0/imu0/data.csv", log)
    truth, name = _ground_truth(root, euroc_from_imu, log), root.resolve().name
    return finalize(RecordingParts(path, "euroc", *frames, name=name, imu=imu, ground_truth=truth), log)


def _calibration(root: Path, count: int, options: OpenOptions, log: ReadLog) -> tuple[RigCalibration, Array]:
    """The calibration with the IMU as body, and EuRoC's body from the IMU (4, 4)."""
    imu_file = root / "mav0/imu0/sensor.yaml"
    euroc_from_imu, noise = np.eye(4), None
    if imu_file.is_file():
        sensor = read_yaml(imu_file)
        euroc_from_imu, noise = sensor.matrix("T_BS"), imu_noise(sensor) or ImuNoise()
    if given := calibration_of_options(options, log):
        return given, euroc_from_imu
    camera_files = [root / f"mav0/cam{i}/sensor.yaml" for i in range(count)]
    if missing := [file for file in camera_files if not file.is_file()]:
        for chain in (root / name for name in _CAMCHAINS if (root / name).is_file()):
            return logged_calibration(chain, log).calibration, euroc_from_imu
        lack = f"{missing[0]} is missing and there is no camchain.yaml"
        raise CalibrationError(f"{lack}; pass a calibration with --calibration FILE")
    log.files += [part for file in camera_files for part in calibration_files(file)]
    log.files += [imu_file] if noise is not None else []
    cameras = [read_camera(file) for file in camera_files]
    if not np.array_equal(euroc_from_imu, np.eye(4)):
        imu_from_euroc = se3_inverse(euroc_from_imu)
        cameras = [replace(c, body_from_cam=imu_from_euroc @ c.body_from_cam) for c in cameras]
    return RigCalibration(tuple(cameras), noise), euroc_from_imu


def read_camera(path: Path) -> CameraCalibration:
    """Read a sensor.yaml: the camera is mounted on the frame that the file calls body."""
    file = read_yaml(path)
    return check_camera(camera_of(file, "distortion_coefficients", file.matrix("T_BS")), str(path))


def _ground_truth(root: Path, euroc_from_imu: Array, log: ReadLog) -> Trajectory | None:
    file = next((root / name for name in _GROUND_TRUTHS if (root / name).is_file()), None)
    trajectory = None if file is None else read_ground_truth(file, log)
    if file is None or trajectory is None:
        return None
    sensor_file = file.with_name("sensor.yaml")
    sensor = read_yaml(sensor_file) if sensor_file.is_file() else None
    euroc_from_sensor = sensor.matrix("T_BS") if sensor and "T_BS" in sensor else np.eye(4)
    imu_from_sensor = se3_inverse(euroc_from_imu) @ euroc_from_sensor
    if np.array_equal(imu_from_sensor, np.eye(4)):
        return trajectory
    return Trajectory(trajectory.stamps_ns, trajectory.frame_from_body @ se3_inverse(imu_from_sensor))


FORMAT = RecordingFormat("a folder with mav0/cam0/data.csv in it", recognises, open_euroc, rank=-6)
