"""`python -m support.ros2.recorded_drive RECORDING BAG`: a node sends a recording's samples as messages of ROS's own classes, another one
writes the bytes that come to a bag of rosbags' writer, as rosbag2 does: none of them is made by this project."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from fleetmap.geometry import Array
from fleetmap.recordings import Recording, open_recording
from fleetmap.sensors.calibration import RigCalibration
from support.ros2.peer import fill, message_class

Fields = dict[str, Any]


def _header(stamp_ns: int, frame_id: str) -> Fields:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame_id}


def _vector(values: Array) -> Fields:
    return dict(zip("xyzw", values.tolist(), strict=False))


def _mounting(rig: RigCalibration) -> Fields:
    links = [("base_link", "imu_link", rig.base_from_body)]
    links += [("imu_link", f"cam{n}_optical", camera.body_from_cam) for n, camera in enumerate(rig.cameras)]
    told = []
    for parent, child, parent_from_child in links:
        turn = Rotation.from_matrix(parent_from_child[:3, :3]).as_quat()
        place = {"translation": _vector(parent_from_child[:3, 3]), "rotation": _vector(turn)}
        told.append({"header": _header(0, parent), "child_frame_id": child, "transform": place})
    return {"transforms": told}


def messages(recording: Recording) -> Iterator[tuple[int, str, str, Fields]]:
    """Stamp in nanoseconds, topic, type and fields of a stereo rig's samples, sensor by sensor."""
    yield int(recording.imu.stamps_ns[0]), "/tf_static", "tf2_msgs/msg/TFMessage", _mounting(recording.calibration)
    for index, stamp_ns in enumerate(recording.frame_stamps_ns.tolist()):
        frame = recording.read_frame(index)
        for number, camera in enumerate(recording.calibration.cameras):
            pixels = (frame.left, frame.right)[number]
            assert pixels is not None
            both = {
                "header": _header(stamp_ns, f"cam{number}_optical"),
                "width": camera.width_px,
                "height": camera.height_px,
            }
            image = both | {"encoding": "mono8", "step": camera.width_px, "data": pixels.tobytes()}
            yield stamp_ns, f"/cam{number}/image_raw", "sensor_msgs/msg/Image", image
            fx, fy, cx, cy = camera.intrinsics_px
            lens = {"distortion_model": "plumb_bob", "d": [*camera.distortion, 0.0]}
            matrices = {"k": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1]), "r": np.eye(3).ravel()}
            matrices["p"] = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0])
            yield stamp_ns, f"/cam{number}/camera_info", "sensor_msgs/msg/CameraInfo", both | lens | matrices
    imu = recording.imu
    for stamp_ns, gyro, accel in zip(imu.stamps_ns.tolist(), imu.gyro_radps, imu.accel_mps2, strict=True):
        axes = {"angular_velocity": _vector(gyro), "linear_acceleration": _vector(accel)}
        yield stamp_ns, "/imu0", "sensor_msgs/msg/Imu", {"header": _header(stamp_ns, "imu_link")} | axes
    for sample in recording.wheel:
        twist = {"linear": _vector(sample.velocity_base_mps), "angular": {"z": sample.yaw_rate_radps}}
        covariance = np.diag([sample.sigma_mps**2] * 3 + [sample.sigma_radps**2] * 3).ravel()
        fields = {"child_frame_id": "base_link", "twist": {"twist": twist, "covariance": covariance}}
        yield sample.stamp_ns, "/odom", "nav_msgs/msg/Odometry", {"header": _header(sample.stamp_ns, "odom")} | fields


def record(recording: Path, bag: Path) -> None:
    """Send it, message by message, each when the one before has come."""
    rclpy.init()
    drivers, recorder, executor = rclpy.create_node("drivers"), rclpy.create_node("recorder"), SingleThreadedExecutor()
    executor.add_node(recorder)
    came: list[bytes] = []
    publishers, connections, types = {}, {}, get_typestore(Stores.ROS2_KILTED)
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer, open_recording(recording) as opened:
        for stamp_ns, topic, name, fields in sorted(messages(opened), key=lambda item: item[0]):
            kind = message_class(name)
            if topic not in publishers:
                connections[topic] = writer.add_connection(topic, name, typestore=types)
                recorder.create_subscription(kind, topic, came.append, 10, raw=True)
                publishers[topic] = drivers.create_publisher(kind, topic, 10)
                while not publishers[topic].get_subscription_count():
                    executor.spin_once(timeout_sec=0.1)
            publishers[topic].publish(fill(kind(), fields))
            while not came:
                executor.spin_once(timeout_sec=1.0)
            writer.write(connections[topic], stamp_ns, came.pop())


if __name__ == "__main__":
    record(Path(sys.argv[1]), Path(sys.argv[2]))
