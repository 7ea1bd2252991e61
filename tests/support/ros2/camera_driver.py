"""A stereo camera's driver: `python -m support.ros2.camera_driver` takes the arguments of `drive` as a line of JSON and says that it sends,
then the stamps of the pairs that it sent to both sides. It ends with its standard input."""

import json
import sys
import time
from array import array

import cv2
import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage, Image, Imu

_IMU_PER_FRAME = 7


def message(pixels: np.ndarray, *, is_compressed: bool) -> Image | CompressedImage:
    if is_compressed:
        jpeg = array("B", cv2.imencode(".jpg", pixels)[1].tobytes())
        return CompressedImage(format="mono8; jpeg compressed", data=jpeg)
    height, width = pixels.shape
    return Image(width=width, height=height, step=width, encoding="mono8", data=array("B", pixels.tobytes()))


def drive(
    frames: int,
    *,
    size_px: tuple[int, int] = (752, 480),
    rate_hz: float = 30.0,
    is_compressed: bool = False,
    is_best_effort: bool = False,
    has_imu: bool = False,
) -> list[int]:
    """Send frames, each to those who subscribed, as image_transport does; return the stamps in ns of those that went to both sides."""
    node, qos = Node("camera"), qos_profile_sensor_data if is_best_effort else QoSProfile(depth=10)
    texture = np.random.default_rng(3).integers(0, 256, (2, size_px[1] // 8, size_px[0] // 8), np.uint8)
    pair = [message(cv2.resize(each, size_px), is_compressed=is_compressed) for each in texture]
    suffix = "/compressed" if is_compressed else ""
    cameras = [node.create_publisher(type(one), f"/cam{n}/image_raw{suffix}", qos) for n, one in enumerate(pair)]
    imu, ticks = node.create_publisher(Imu, "/imu0", qos), _IMU_PER_FRAME if has_imu else 1
    print("sending", flush=True)
    sent_ns, tick, begun_s = list[int](), 0, time.monotonic()
    while len(sent_ns) < frames:
        stamp_ns = time.time_ns()
        stamp = Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        if has_imu:
            sample = Imu()
            sample.header.stamp, sample.linear_acceleration.z = stamp, 9.81
            imu.publish(sample)
        if tick % ticks == 0:
            subscribed = [camera.get_subscription_count() > 0 for camera in cameras]
            for camera, image, is_heard in zip(cameras, pair, subscribed, strict=True):
                image.header.stamp = stamp
                if is_heard:
                    camera.publish(image)
            sent_ns += [stamp_ns] if all(subscribed) else []
        tick += 1
        time.sleep(max(0.0, begun_s + tick / (rate_hz * ticks) - time.monotonic()))
    for camera in cameras:
        camera.wait_for_all_acked(Duration(seconds=10))
    return sent_ns


if __name__ == "__main__":
    rclpy.init()
    print(json.dumps(drive(**json.loads(sys.stdin.readline()))), flush=True)
    sys.stdin.read()  # best effort is not acknowledged: who heard all says so
