"""Sensors as ROS 2 topics: raw and compressed images, depth, IMU, wheels and priors."""

from collections.abc import Callable

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image, Imu

from fleetmap.errors import FleetmapError
from fleetmap.sensors.source_settings import PACKED
from fleetmap.sources.intake import Intake
from locclient.plugins.ros2_node.node import Feed, MessageReader, keep_on, ros_started
from locclient.plugins.ros2_node.sensor_messages import SensorMessages, Take

_IDLE_S = 0.2
_TYPES = {"image": (Image, CompressedImage), "imu": (Imu,), "wheel": (Odometry,), "prior": (PoseWithCovarianceStamped,)}
_IMAGES, _SAMPLES = 30, 200  # messages that may wait: of a second


class Ros2Source:
    """Subscribes to the topics, to those of images as image_transport sends them; a node of its own in the graph, fleetmap_sensors."""

    def __init__(self, messages: SensorMessages, namespace: str) -> None:
        """See `open_topics`."""
        self.calibration, self.has_depth, self._topics = messages.calibration, messages.has_depth, messages.topics
        with ros_started():
            own = ["--ros-args", "-r", "__node:=fleetmap_sensors"]  # a launch file's name is that of the localizer
            self._node = Node("fleetmap_sensors", namespace=namespace, cli_args=own, start_parameter_services=False)

    def run(self, intake: Intake, wait: Callable[[float], bool]) -> None:
        reader = MessageReader(self._node, [_feed(*each, intake) for each in self._topics if each[0][0]])

        def read() -> None:
            intake.source_faults = reader.faults
            reader.read(_IDLE_S)

        keep_on(read, wait)

    def close(self) -> None:
        self._node.destroy_node()


def _feed(topics: tuple[str, ...], kind: str, take: Take, intake: Intake) -> Feed:
    def handle(message_type: type, message: bytes) -> None:
        try:
            take(intake, message_type is CompressedImage, message)
        except (ValueError, FleetmapError) as error:
            # An unreadable message is skipped; the health report counts them.
            intake.count_unreadable(str(error))

    choices = [
        (topic, each) for topic in topics for each in _TYPES[kind] if each is not Image or not topic.endswith(PACKED)
    ]
    depth = _IMAGES if kind == "image" else _SAMPLES
    return Feed(choices, handle, depth, is_awaited=kind in ("image", "imu"))
