"""Sensors as ROS 2 topics: raw and compressed images, depth, IMU, wheels and priors."""

import threading
from collections.abc import Callable

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image, Imu

from fleetmap.errors import FleetmapError
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.source_settings import PACKED
from fleetmap.sources.intake import Intake
from locclient.plugins.ros2_node.node import Feed, MessageReader, ensure_ros, ros_errors
from locclient.plugins.ros2_node.sensor_messages import SensorMessages, Take

_IDLE_S = 0.2
_SENSOR_DEPTH = 200  # a second of an IMU
_TYPES = {"imu": Imu, "wheel": Odometry, "prior": PoseWithCovarianceStamped}


class Ros2Source:
    """Subscribes to the topics, to those of images as image_transport sends them; a node of its own in the graph, fleetmap_sensors."""

    def __init__(self, messages: SensorMessages, calibration: RigCalibration, *, has_depth: bool) -> None:
        """See `open_topics`."""
        self.calibration, self.has_depth, self._messages = calibration, has_depth, messages
        self._reading = threading.Lock()
        with ros_errors():
            ensure_ros()
            own = ["--ros-args", "-r", "__node:=fleetmap_sensors"]  # a launch file's name is that of the localizer
            self._node = Node("fleetmap_sensors", cli_args=own, start_parameter_services=False)

    def run(self, intake: Intake, wait: Callable[[float], bool]) -> None:
        with self._reading:
            reader = MessageReader(self._node, [_feed(*each, intake) for each in self._messages.topics if each[0][0]])
            while not wait(0.0):
                reader.read(_IDLE_S)

    def close(self) -> None:
        self._reading.acquire(timeout=10 * _IDLE_S)  # another thread may still read, beside a camera
        self._node.destroy_node()


def _feed(topics: tuple[str, ...], kind: str, take: Take, intake: Intake) -> Feed:
    def handle(message_type: type, message: bytes) -> None:
        try:
            take(intake, message_type is CompressedImage, message)
        except (ValueError, FleetmapError) as error:
            # An unreadable message is skipped; the health report counts them.
            intake.count_unreadable(str(error))

    if kind != "image":
        return Feed([(topics[0], _TYPES[kind])], handle, _SENSOR_DEPTH)
    choices = [(topic, each) for topic in topics for each in (Image, CompressedImage)]
    return Feed(
        [(topic, each) for topic, each in choices if each is CompressedImage or not topic.endswith(PACKED)], handle
    )
