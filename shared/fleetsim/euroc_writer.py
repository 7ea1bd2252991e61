"""Writes recordings as EuRoC/ASL folders: PNG pictures, CSV tables, sensor.yaml.

Wheels, priors and base_from_body have no place there.
"""

from pathlib import Path

import cv2
import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, quat_wxyz_from_rotation
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration
from fleetmap.sensors.samples import CameraFrame, Image, ImuSamples, PositionPrior, Trajectory, WheelSample

_PNG_OPTIONS = (cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
_IMU_HEAD = "#timestamp [ns],w_x [rad s^-1],w_y,w_z,a_x [m s^-2],a_y,a_z"
_TRUTH_HEAD = (
    "#timestamp [ns],p_x [m],p_y,p_z,q_w [],q_x,q_y,q_z,v_x [m s^-1],v_y,v_z,"
    "b_w_x [rad s^-1],b_w_y,b_w_z,b_a_x [m s^-2],b_a_y,b_a_z"
)
_ZEROS = ",0,0,0,0,0,0,0,0,0"  # velocity and biases, which readers of this layout expect and we do not state


class EurocRecordingWriter:
    """Same calls as McapRecordingWriter; the layout has no place for wheels and priors."""

    def __init__(self, path: Path, calibration: RigCalibration) -> None:
        self._root = path / "mav0"
        if self._root.exists():
            raise RecordingError(f"{self._root} exists already; choose another folder with --out")
        for number, camera in enumerate(calibration.cameras):
            (self._root / f"cam{number}" / "data").mkdir(parents=True)
            (self._root / f"cam{number}" / "sensor.yaml").write_text(_camera_yaml(camera))
        (self._root / "imu0").mkdir()
        (self._root / "state_groundtruth_estimate0").mkdir()
        if calibration.imu is not None:
            (self._root / "imu0" / "sensor.yaml").write_text(_imu_yaml(calibration))
        heads = {"cam0": "#timestamp [ns],filename", "cam1": "#timestamp [ns],filename", "imu0": _IMU_HEAD}
        heads["state_groundtruth_estimate0"] = _TRUTH_HEAD
        self._tables = {name: (self._root / name / "data.csv").open("w") for name in heads}
        for name, head in heads.items():
            self._tables[name].write(head + "\n")

    def write_frame(self, frame: CameraFrame) -> None:
        """Both pictures as PNG, named by the stamp."""
        self._write_picture("cam0", frame.stamp_ns, frame.left)
        if frame.right is not None:
            self._write_picture("cam1", frame.stamp_ns, frame.right)

    def write_imu(self, samples: ImuSamples) -> None:
        """One row per sample, at full precision."""
        rows = np.concatenate([samples.gyro_radps, samples.accel_mps2], axis=1)
        for stamp_ns, row in zip(samples.stamps_ns.tolist(), rows.tolist(), strict=True):
            self._tables["imu0"].write(f"{stamp_ns}," + ",".join(map(repr, row)) + "\n")

    def write_wheel(self, samples: tuple[WheelSample, ...]) -> None:
        """Leaves them out."""

    def write_prior(self, priors: tuple[PositionPrior, ...]) -> None:
        """Leaves them out."""

    def write_ground_truth(self, trajectory: Trajectory) -> None:
        """One row per transform."""
        table = self._tables["state_groundtruth_estimate0"]
        for stamp_ns, map_from_body in zip(trajectory.stamps_ns.tolist(), trajectory.frame_from_body, strict=True):
            values = [*map_from_body[:3, 3].tolist(), *quat_wxyz_from_rotation(map_from_body[:3, :3]).tolist()]
            table.write(f"{stamp_ns}," + ",".join(map(repr, values)) + _ZEROS + "\n")

    def close(self) -> None:
        """Ends the tables."""
        for table in self._tables.values():
            table.close()

    def _write_picture(self, camera: str, stamp_ns: int, image: Image) -> None:
        path = self._root / camera / "data" / f"{stamp_ns}.png"
        if not cv2.imwrite(str(path), image, _PNG_OPTIONS):
            raise RecordingError(f"{path} cannot be written; is the disk full?")
        self._tables[camera].write(f"{stamp_ns},{stamp_ns}.png\n")


def _matrix_yaml(matrix: Array) -> str:
    data = ", ".join(repr(float(value)) for value in matrix.ravel())
    return f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\n"


def _camera_yaml(camera: CameraCalibration) -> str:
    distortion = camera.distortion if len(camera.distortion) else np.zeros(4)
    lists = {
        "resolution": [camera.width_px, camera.height_px],
        "intrinsics": [float(value) for value in camera.intrinsics_px],
        "distortion_coefficients": [float(value) for value in distortion],
    }
    lines = "".join(f"{key}: {value}\n" for key, value in lists.items())
    head = f"sensor_type: camera\ncamera_model: pinhole\ndistortion_model: {camera.model}\n"
    return head + lines + _matrix_yaml(camera.body_from_cam)


def _imu_yaml(calibration: RigCalibration) -> str:
    noise = calibration.imu
    assert noise is not None
    values = {
        "gyroscope_noise_density": noise.gyro_noise_radps_rthz,
        "gyroscope_random_walk": noise.gyro_walk_radps2_rthz,
        "accelerometer_noise_density": noise.accel_noise_mps2_rthz,
        "accelerometer_random_walk": noise.accel_walk_mps3_rthz,
    }
    return (
        "sensor_type: imu\n" + "".join(f"{key}: {value!r}\n" for key, value in values.items()) + _matrix_yaml(np.eye(4))
    )
