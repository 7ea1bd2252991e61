"""`python -m support.ros2.recorded_drive RECORDING BAG`: a node sends a recording's messages by ROS's own classes, another one writes the
bytes that come to a bag of rosbags' writer, as rosbag2 does: none of them is made by this project."""

import sys
from pathlib import Path

import rclpy
from mcap.reader import make_reader
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from support.ros2.peer import message_class


def record(recording: Path, bag: Path) -> None:
    """Send it, message by message, each when the one before has come."""
    rclpy.init()
    drivers, recorder, executor = rclpy.create_node("drivers"), rclpy.create_node("recorder"), SingleThreadedExecutor()
    executor.add_node(recorder)
    came: list[bytes] = []
    publishers, connections, types = {}, {}, get_typestore(Stores.ROS2_KILTED)
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer, recording.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            kind, topic = message_class(schema.name), channel.topic
            if topic not in publishers:
                connections[topic] = writer.add_connection(topic, schema.name, typestore=types)
                recorder.create_subscription(kind, topic, came.append, 10, raw=True)
                publishers[topic] = drivers.create_publisher(kind, topic, 10)
                while not publishers[topic].get_subscription_count():
                    executor.spin_once(timeout_sec=0.1)
            publishers[topic].publish(deserialize_message(message.data, kind))
            while not came:
                executor.spin_once(timeout_sec=1.0)
            writer.write(connections[topic], message.log_time, came.pop())


if __name__ == "__main__":
    record(Path(sys.argv[1]), Path(sys.argv[2]))
