"""The output of the node: its settings are checked, and it is opened on a bus of ROS."""

from functools import partial

from fleetmap.bus import Bus
from fleetmap.errors import UsageError
from fleetmap.sensors.source_settings import Topics
from locclient.hooks import OutputHook
from locclient.output_section import OutputSection
from locclient.plugins.ros2_node.localizer import Ros2Localizer


def _check(section: OutputSection, topics: Topics) -> None:
    """Raise UsageError for frame names that tf2 rejects, and for odometry that would come back as that of the wheels."""
    frames = (section.map_frame, section.odom_frame, section.base_frame)
    if len(set(frames)) < 3 or any(not name or name.startswith("/") for name in frames):
        raise UsageError(
            f"[output] map_frame, odom_frame and base_frame = {', '.join(map(repr, frames))}: tf2 needs three different names "
            "that do not begin with a slash"
        )
    if section.odom_topic.lstrip("/") == topics.wheel.lstrip("/"):
        raise UsageError(
            f"[output] odom_topic = {section.odom_topic!r} is also the topic of [topics] wheel: the robot would take its own "
            'odometry for that of its wheels; set wheel = "" if it has none'
        )


OUTPUT = OutputHook(Ros2Localizer, _check, partial(Bus.connect, is_ros=True))
