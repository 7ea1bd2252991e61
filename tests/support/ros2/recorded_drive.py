"""`python -m support.ros2.recorded_drive RECORDING BAG`: a node sends a recording's samples as messages of ROS's own classes, another one
writes the bytes that come to a bag of rosbags' writer, as rosbag2 does: none of them is made by this project."""

import sys
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, Imu
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from fleetmap.geometry import Array
from fleetmap.recordings import Recording, open_recording
from fleetmap.sensors.calibration import CameraCalibration, RigCalibration


def _header(stamp_ns: int, frame_id: str) -> Header:
    return Header(stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9), frame_id=frame_id)


def _vector(values: Array) -> Vector3:
    return Vector3(**dict(zip("xyz", values.tolist(), strict=True)))


def _mounting(rig: RigCalibration, stamp_ns: int) -> TFMessage:
    links = [("base_link", "imu_link", rig.base_from_body)]
    links += [("imu_link", f"cam{n}_optical", camera.body_from_cam) for n, camera in enumerate(rig.cameras)]
    message = TFMessage()
    for parent, child, parent_from_child in links:
        quat_xyzw = Rotation.from_matrix(parent_from_child[:3, :3]).as_quat().tolist()
        turn = Quaternion(**dict(zip("xyzw", quat_xyzw, strict=True)))
        place = Transform(translation=_vector(parent_from_child[:3, 3]), rotation=turn)
        link = TransformStamped(header=_header(stamp_ns, parent), child_frame_id=child, transform=place)
        message.transforms.append(link)
    return message


def _camera_info(header: Header, camera: CameraCalibration) -> CameraInfo:
    fx, fy, cx, cy = camera.intrinsics_px.tolist()
    info = CameraInfo(header=header, width=camera.width_px, height=camera.height_px, distortion_model="plumb_bob")
    info.d, info.k, info.r = (
        [*camera.distortion.tolist(), 0.0],
        [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        np.eye(3).ravel(),
    )
    info.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return info


def messages(recording: Recording) -> Iterator[tuple[int, str, Any]]:
    """Stamp in nanoseconds, topic and message of a stereo rig's samples, sensor by sensor."""
    yield int(recording.imu.stamps_ns[0]), "/tf_static", _mounting(recording.calibration, 0)
    for index, stamp_ns in enumerate(recording.frame_stamps_ns.tolist()):
        frame = recording.read_frame(index)
        for number, camera in enumerate(recording.calibration.cameras):
            pixels, header = (frame.left, frame.right)[number], _header(stamp_ns, f"cam{number}_optical")
            assert pixels is not None
            image = Image(
                header=header, height=camera.height_px, width=camera.width_px, encoding="mono8", step=camera.width_px
            )
            image.data = array("B", pixels.tobytes())
            yield stamp_ns, f"/cam{number}/image_raw", image
            yield stamp_ns, f"/cam{number}/camera_info", _camera_info(header, camera)
    imu = recording.imu
    for stamp_ns, gyro, accel in zip(imu.stamps_ns.tolist(), imu.gyro_radps, imu.accel_mps2, strict=True):
        axes = {"angular_velocity": _vector(gyro), "linear_acceleration": _vector(accel)}
        yield stamp_ns, "/imu0", Imu(header=_header(stamp_ns, "imu_link"), **axes)
    for sample in recording.wheel:
        odometry = Odometry(header=_header(sample.stamp_ns, "odom"), child_frame_id="base_link")
        odometry.twist.twist.linear = _vector(sample.velocity_base_mps)
        odometry.twist.twist.angular.z = sample.yaw_rate_radps
        odometry.twist.covariance = np.diag([sample.sigma_mps**2] * 3 + [sample.sigma_radps**2] * 3).ravel()
        yield sample.stamp_ns, "/odom", odometry


def record(recording: Path, bag: Path) -> None:
    """Send it, message by message, each when the one before has come."""
    rclpy.init()
    drivers, recorder, executor = rclpy.create_node("drivers"), rclpy.create_node("recorder"), SingleThreadedExecutor()
    executor.add_node(recorder)
    came: list[bytes] = []
    publishers, connections, types = {}, {}, get_typestore(Stores.ROS2_KILTED)
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer, open_recording(recording) as opened:
        for stamp_ns, topic, message in sorted(messages(opened), key=lambda item: item[0]):
            kind = type(message)
            if topic not in publishers:
                name = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
                connections[topic] = writer.add_connection(topic, name, typestore=types)
                recorder.create_subscription(kind, topic, came.append, 10, raw=True)
                publishers[topic] = drivers.create_publisher(kind, topic, 10)
                while not publishers[topic].get_subscription_count():
                    executor.spin_once(timeout_sec=0.1)
            publishers[topic].publish(message)
            while not came:
                executor.spin_once(timeout_sec=1.0)
            writer.write(connections[topic], stamp_ns, came.pop())


if __name__ == "__main__":
    record(Path(sys.argv[1]), Path(sys.argv[2]))
