"""A stereo camera's driver: `python -m support.ros2.camera_driver FRAMES [--compressed] [--best-effort] [--imu] [--size WxH] [--rate HZ]`
sends frames, each to those who subscribed, as image_transport does, and prints how many pairs it sent to both sides."""

import argparse
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


def messages(width: int, height: int, *, is_compressed: bool) -> list[Image | CompressedImage]:
    """One of each camera."""
    texture = np.random.default_rng(3).integers(0, 256, (2, height // 8, width // 8), np.uint8)
    made: list[Image | CompressedImage] = []
    for pixels in (cv2.resize(each, (width, height)) for each in texture):
        if is_compressed:
            message = CompressedImage(format="mono8; jpeg compressed")
            message.data = array("B", cv2.imencode(".jpg", pixels)[1].tobytes())
        else:
            message = Image(width=width, height=height, step=width, encoding="mono8")
            message.data = array("B", pixels.tobytes())
        made.append(message)
    return made


def drive(given: argparse.Namespace) -> int:
    """Send the frames; return the number of those that went to both sides."""
    width, height = map(int, given.size.split("x"))
    node = Node("camera")
    qos = qos_profile_sensor_data if given.best_effort else QoSProfile(depth=10)
    pair = messages(width, height, is_compressed=given.compressed)
    suffix = "/compressed" if given.compressed else ""
    cameras = [node.create_publisher(type(one), f"/cam{n}/image_raw{suffix}", qos) for n, one in enumerate(pair)]
    imu = node.create_publisher(Imu, "/imu0", qos) if given.imu else None
    sent, ticks = 0, _IMU_PER_FRAME if given.imu else 1
    tick, begun_s = 0, time.monotonic()
    while sent < given.frames:
        stamp = Time(**dict(zip(("sec", "nanosec"), divmod(time.time_ns(), 10**9), strict=True)))
        if imu is not None:
            message = Imu()
            message.header.stamp, message.linear_acceleration.z = stamp, 9.81
            imu.publish(message)
        if tick % ticks == 0:
            subscribed = [camera.get_subscription_count() > 0 for camera in cameras]
            for camera, image, is_heard in zip(cameras, pair, subscribed, strict=True):
                image.header.stamp = stamp
                if is_heard:
                    camera.publish(image)
            sent += all(subscribed)
        tick += 1
        time.sleep(max(0.0, begun_s + tick / (given.rate * ticks) - time.monotonic()))
    for camera in cameras:
        camera.wait_for_all_acked(Duration(seconds=10))
    time.sleep(0.5)  # best effort is not acknowledged
    return sent


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("frames", type=int)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--size", default="752x480")
    for option in ("--compressed", "--best-effort", "--imu"):
        parser.add_argument(option, action="store_true")
    rclpy.init()
    print(drive(parser.parse_args()), flush=True)
