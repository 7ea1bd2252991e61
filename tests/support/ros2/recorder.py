"""A recorder like rosbag2's: `python -m support.ros2.recorder BAG TOPICS` writes the bytes of that many topics, as they come from rclpy,
to a bag of rosbags' writer, until nobody publishes any more and nothing comes."""

import sys
import time
from importlib import import_module
from pathlib import Path

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import HistoryPolicy
from rosbags.interfaces import Connection
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

_OWN = {"/rosout", "/parameter_events"}
_QUEUE = 1000
_SILENCE_S = 2.0


def record(path: Path, topics: int) -> None:
    """Write what comes on the first `topics` topics that appear, in the quality that their publishers offer."""
    node, types = Node("recorder"), get_typestore(Stores.ROS2_KILTED)
    connections: dict[str, Connection] = {}
    heard_s = time.monotonic()
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def write(topic: str, data: bytes) -> None:
        nonlocal heard_s
        writer.write(connections[topic], time.time_ns(), data)
        heard_s = time.monotonic()

    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        while len(connections) < topics:
            for topic, (name, *_) in node.get_topic_names_and_types():
                offers = node.get_publishers_info_by_topic(topic)
                if topic in connections or topic in _OWN or not offers:
                    continue
                connections[topic] = writer.add_connection(topic, name, typestore=types)
                package, _, short = name.split("/")
                qos = offers[0].qos_profile
                qos.history, qos.depth = HistoryPolicy.KEEP_LAST, _QUEUE
                message = getattr(import_module(f"{package}.msg"), short)
                node.create_subscription(message, topic, lambda data, of=topic: write(of, data), qos, raw=True)
            executor.spin_once(timeout_sec=0.1)
        while time.monotonic() - heard_s < _SILENCE_S or any(node.count_publishers(topic) for topic in connections):
            executor.spin_once(timeout_sec=0.5)


if __name__ == "__main__":
    rclpy.init()
    record(Path(sys.argv[1]), int(sys.argv[2]))
