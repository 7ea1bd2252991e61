"""The drivers of a robot: `python -m support.ros2.player RECORDING` sends a recording's samples as messages of ROS's own classes, as fast
as they were taken and with stamps of now. It waits for a subscriber of every topic, and ends when all have everything."""

import sys
import time
from array import array
from collections.abc import Iterator
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, TransformStamped, Vector3
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image, Imu
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from fleetmap.geometry import Array
from fleetmap.recordings import Recording, open_recording
from fleetmap.sensors.calibration import CameraCalibration

_QUEUE = 1000  # so that a busy machine drops nothing


def _header(stamp_ns: int, frame_id: str) -> Header:
    return Header(stamp=Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9), frame_id=frame_id)


def _transform(parent: str, child: str, parent_from_child: Array) -> TransformStamped:
    link = TransformStamped(header=_header(time.time_ns(), parent), child_frame_id=child)
    link.transform.translation = Vector3(**dict(zip("xyz", parent_from_child[:3, 3].tolist(), strict=True)))
    quat_xyzw = Rotation.from_matrix(parent_from_child[:3, :3]).as_quat()
    link.transform.rotation = Quaternion(**dict(zip("xyzw", quat_xyzw.tolist(), strict=True)))
    return link


def _camera_info(header: Header, camera: CameraCalibration) -> CameraInfo:
    info = CameraInfo(header=header, width=camera.width_px, height=camera.height_px, distortion_model="plumb_bob")
    fx, fy, cx, cy = camera.intrinsics_px.tolist()
    info.d = [*camera.distortion.tolist(), 0.0]
    info.k, info.r = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], np.eye(3).ravel()
    info.p = [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return info


def messages(recording: Recording) -> Iterator[tuple[int, str, Any]]:
    """Time in nanoseconds, topic and message, sensor by sensor; a message's header has the recording's stamp."""
    for index, stamp_ns in enumerate(recording.frame_stamps_ns.tolist()):
        frame = recording.read_frame(index)
        for number, pixels in enumerate((frame.left, frame.right)):
            assert pixels is not None
            header, (height, width) = _header(stamp_ns, f"cam{number}_optical"), pixels.shape
            image = Image(header=header, height=height, width=width, encoding="mono8", step=width)
            image.data = array("B", pixels.tobytes())
            yield stamp_ns, f"/cam{number}/image_raw", image
            info = _camera_info(header, recording.calibration.cameras[number])
            yield stamp_ns, f"/cam{number}/camera_info", info
    imu = recording.imu
    for stamp_ns, gyro, accel in zip(imu.stamps_ns.tolist(), imu.gyro_radps, imu.accel_mps2, strict=True):
        message = Imu(header=_header(stamp_ns, "imu_link"))
        for vector, values in ((message.angular_velocity, gyro), (message.linear_acceleration, accel)):
            vector.x, vector.y, vector.z = values.tolist()
        yield stamp_ns, "/imu0", message
    for sample in recording.wheel:
        odometry = Odometry(header=_header(sample.stamp_ns, "odom"), child_frame_id="base_link")
        linear = odometry.twist.twist.linear
        linear.x, linear.y, linear.z = sample.velocity_base_mps.tolist()
        odometry.twist.twist.angular.z = sample.yaw_rate_radps
        odometry.twist.covariance = np.diag([sample.sigma_mps**2] * 3 + [sample.sigma_radps**2] * 3).ravel()
        yield sample.stamp_ns, "/odom", odometry


def play(path: str) -> None:
    """Send a recording of a stereo rig."""
    node, reliable = Node("drivers"), QoSProfile(depth=_QUEUE)
    with open_recording(path) as recording:
        sent = sorted(messages(recording), key=lambda item: item[0])
        calibration = recording.calibration
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publishers = {topic: node.create_publisher(type(message), topic, reliable) for _, topic, message in sent}
    publishers["/tf_static"] = node.create_publisher(TFMessage, "/tf_static", latched)
    links = [("base_link", "imu_link", calibration.base_from_body)]
    links += [("imu_link", f"cam{n}_optical", camera.body_from_cam) for n, camera in enumerate(calibration.cameras)]
    publishers["/tf_static"].publish(TFMessage(transforms=[_transform(*link) for link in links]))
    while not all(publisher.get_subscription_count() for publisher in publishers.values()):
        time.sleep(0.05)
    later_ns = time.time_ns() - sent[0][0]
    for taken_ns, topic, message in sent:
        time.sleep(max(0.0, (taken_ns + later_ns - time.time_ns()) * 1e-9))
        message.header.stamp = _header(taken_ns + later_ns, "").stamp
        publishers[topic].publish(message)
    for publisher in publishers.values():
        assert publisher.wait_for_all_acked(Duration(seconds=20))


if __name__ == "__main__":
    rclpy.init()
    play(sys.argv[1])
