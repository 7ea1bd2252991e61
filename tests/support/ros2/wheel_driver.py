"""The driver of a robot's wheels: `python -m support.ros2.wheel_driver POSES` publishes odom -> base_link on /tf, by the clock of the
robot's camera, which it takes from /visual_odom. POSES: a JSON list of stamp in ns, and position and quaternion x y z x y z w."""

import json
import sys
from collections import deque
from pathlib import Path

import rclpy
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

_AHEAD_NS = 200_000_000


def drive(node: Node, way: "deque[tuple[int, list[float]]]") -> None:
    publisher = node.create_publisher(TFMessage, "/tf", 100)

    def follow(heard: Odometry) -> None:
        now_ns = heard.header.stamp.sec * 10**9 + heard.header.stamp.nanosec
        while way and way[0][0] <= now_ns + _AHEAD_NS:
            stamp_ns, (x, y, z, qx, qy, qz, qw) = way.popleft()
            link = TransformStamped(child_frame_id="base_link")
            link.header.frame_id = "odom"
            link.header.stamp.sec, link.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            place, turn = link.transform.translation, link.transform.rotation
            place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w = x, y, z, qx, qy, qz, qw
            publisher.publish(TFMessage(transforms=[link]))

    node.create_subscription(Odometry, "/visual_odom", follow, 10)
    rclpy.spin(node)


if __name__ == "__main__":
    rclpy.init()
    drive(Node("wheels"), deque(map(tuple, json.loads(Path(sys.argv[1]).read_text()))))
