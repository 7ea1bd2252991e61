"""MCAP with Foxglove's protobuf schemas, made by Foxglove's own classes."""

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.descriptor_pb2 import FileDescriptorProto
from google.protobuf.descriptor_pool import Default as DefaultPool
from google.protobuf.message_factory import GetMessageClass
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array, quat_wxyz_from_rotation
from fleetmap.recordings import open_recording
from fleetmap.sensors.samples import SensorSet
from support.recordings.recording_samples import BODY_FROM_CAM0, FOCAL, HEIGHT, WIDTH, calibration, make_sample

SAMPLE = make_sample(4)


def _imu_class() -> Any:
    """An inertial message by this project's convention, as a recorder would declare it."""
    file = FileDescriptorProto(name="test_imu.proto", package="fleetmap", syntax="proto3")
    file.dependency.extend(["google/protobuf/timestamp.proto", "foxglove/Vector3.proto"])
    message = file.message_type.add(name="Imu")
    kinds = {"timestamp": ".google.protobuf.Timestamp", "frame_id": None}
    kinds |= dict.fromkeys(("angular_velocity", "linear_acceleration"), ".foxglove.Vector3")
    for number, (name, kind) in enumerate(kinds.items(), start=1):
        message.field.add(name=name, number=number, type=11 if kind else 9, label=1, type_name=kind)
    pool = DefaultPool()
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName("fleetmap.Imu"))


IMU_CLASS = _imu_class()


def stamp(stamp_ns: int) -> Timestamp:
    return Timestamp(seconds=stamp_ns // 10**9, nanos=stamp_ns % 10**9)


def fill(vector: Any, values: Array) -> None:
    vector.x, vector.y, vector.z = values.tolist()


def turn(quaternion: Any, rotation: Array) -> None:
    quaternion.w, quaternion.x, quaternion.y, quaternion.z = quat_wxyz_from_rotation(rotation).tolist()


def write(path: Path) -> Path:
    with path.open("wb") as file, Writer(file) as writer:
        for number, camera in enumerate(calibration().cameras):
            link = FrameTransform(timestamp=stamp(1), parent_frame_id="imu", child_frame_id=f"cam{number}")
            fill(link.translation, camera.body_from_cam[:3, 3])
            turn(link.rotation, camera.body_from_cam[:3, :3])
            writer.write_message("/tf_static", link, 1, 1)
            fx, fy, cx, cy = camera.intrinsics_px
            lens = CameraCalibration(timestamp=stamp(1), frame_id=f"cam{number}", width=WIDTH, height=HEIGHT)
            lens.distortion_model, lens.D[:] = "plumb_bob", [1e-9, 0, 0, 0, 0]
            lens.K[:] = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
            writer.write_message(f"/cam{number}/camera_info", lens, 1, 1)
        for i, s in enumerate(SAMPLE.stamps_ns.tolist()):
            left = RawImage(timestamp=stamp(s), frame_id="cam0", width=WIDTH, height=HEIGHT, encoding="mono8")
            left.step, left.data = WIDTH, SAMPLE.left[i].tobytes()
            writer.write_message("/cam0/image_raw", left, s, s)
            png = cv2.imencode(".png", SAMPLE.right[i])[1].tobytes()
            right = CompressedImage(timestamp=stamp(s), frame_id="cam1", data=png, format="png")
            writer.write_message("/cam1/image_raw", right, s, s)
            truth = PoseInFrame(timestamp=stamp(s), frame_id="map")
            fill(truth.pose.position, SAMPLE.world_from_body[i][:3, 3])
            turn(truth.pose.orientation, SAMPLE.world_from_body[i][:3, :3])
            writer.write_message("/ground_truth", truth, s, s)
        for s, gyro, accel in zip(SAMPLE.imu_stamps_ns.tolist(), SAMPLE.gyro_radps, SAMPLE.accel_mps2, strict=True):
            message = IMU_CLASS(timestamp=stamp(s), frame_id="imu")
            fill(message.angular_velocity, gyro)
            fill(message.linear_acceleration, accel)
            writer.write_message("/imu0", message, s, s)
    return path


def test_everything_is_read(tmp_path: Path) -> None:
    with open_recording(write(tmp_path / "a.mcap")) as recording:
        assert (recording.sensor_set, recording.issues) == (SensorSet.STEREO_INERTIAL, ())
        np.testing.assert_array_equal(recording.frame_stamps_ns, SAMPLE.stamps_ns)
        for index in (2, 0):
            frame = recording.read_frame(index)
            np.testing.assert_array_equal(frame.left, SAMPLE.left[index])
            np.testing.assert_array_equal(frame.right, SAMPLE.right[index])
        np.testing.assert_array_equal(recording.imu.gyro_radps, SAMPLE.gyro_radps)
        np.testing.assert_array_equal(recording.imu.accel_mps2, SAMPLE.accel_mps2)
        camera = recording.calibration.cameras[0]
        assert camera.intrinsics_px[0] == FOCAL
        np.testing.assert_allclose(camera.body_from_cam, BODY_FROM_CAM0, atol=1e-12)
        np.testing.assert_allclose(recording.ground_truth.frame_from_body[3], SAMPLE.world_from_body[3], atol=1e-12)


def test_without_the_library_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.mcap")
    monkeypatch.setitem(sys.modules, "google.protobuf.message", None)
    with pytest.raises(RecordingError, match="pip install protobuf"):
        open_recording(path)
