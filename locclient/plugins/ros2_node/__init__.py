"""ROS 2 of a robot, by rclpy: sensors from topics, and localization as a managed node.

rclpy is the robot's own, and imported once a robot's settings ask for ROS 2; this package itself needs none.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import UsageError
from fleetmap.recordings import Topics, read_calibration
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.source_settings import SourceSection
from fleetmap.sources.intake import Intake
from fleetmap.sources.source import Source
from locclient.hooks import OutputHook
from locclient.outputs import OutputSection, Publisher
from locclient.plugins.ros2_node.sensor_messages import SensorMessages

_log = logging.getLogger(__name__)
# Of the robot of this process, as they were checked: a source is opened without [output], an output without [topics].
_checked = [(OutputSection(), Topics())]


@contextmanager
def _sourced() -> Iterator[None]:
    """Turn a failed import into a UsageError that says what to source."""
    try:
        yield
    except ImportError as error:
        raise UsageError(
            f"ROS 2 is not to be had ({str(error).splitlines()[0]}): source it before the start, such as "
            "`source /opt/ros/kilted/setup.bash`, with locclient in a virtual environment of the same Python, made with "
            "--system-site-packages (docs/ros2.md)"
        ) from error


def open_topics(section: SourceSection, topics: Topics, map_frame: str, *, images: bool = True) -> Source:
    """Open ROS 2 topics as the source, or beside another one, which has the images."""
    has_depth = section.sensors == "rgbd"
    messages = SensorMessages(topics, rig_of(section), images=images, has_depth=has_depth, map_frame=map_frame)
    with _sourced():
        from locclient.plugins.ros2_node.source import Ros2Source

        return Ros2Source(messages, _checked[0][0].namespace)


def topics_beside(section: SourceSection, topics: Topics, map_frame: str) -> Source | None:
    """Open the topics beside another source of images; None, with a warning, without ROS 2 and an IMU, which would need it."""
    if find_spec("rclpy") is None and rig_of(section).imu is None:
        _log.warning("ROS 2 is not sourced: the camera is used without wheels and priors")
        return None
    return open_topics(section, topics, map_frame, images=False)


def rig_of(section: SourceSection) -> RigCalibration:
    """Read the calibration of a source's cameras; UsageError without one, and for sensors that it does not describe."""
    if section.calibration is None:
        raise UsageError("[source] calibration is missing: a live camera needs the path of its Kalibr camchain")
    calibration = read_calibration(Path(section.calibration))
    if section.sensors != "stereo":
        return replace(calibration, cameras=calibration.cameras[:1])
    if (count := len(calibration.cameras)) < 2:
        need = "a stereo source needs a pair: or set [source] sensors to rgbd or mono"
        raise UsageError(f"{section.calibration} describes {count} camera; {need}")
    return calibration


def _open_output(
    section: OutputSection, _bus: Bus | None, _site: str, robot: str, calibration: RigCalibration, intake: Intake
) -> Publisher:
    with _sourced():
        from locclient.plugins.ros2_node.localizer import Ros2Localizer

        return Ros2Localizer(section, _checked[0][1], robot, calibration, intake)


def check(section: OutputSection, topics: Topics) -> None:
    """Raise UsageError for an endpoint, for frames that tf2 rejects, and for odometry that would come back as that of the wheels."""
    frames = (section.map_frame, section.odom_frame, section.base_frame)
    names = ", ".join(map(repr, frames))
    if len(set(frames)) < 3 or any(not name or name.startswith("/") for name in frames):
        fault = f"map_frame, odom_frame and base_frame = {names}: tf2 needs three different names that do not begin with a slash"
        raise UsageError(f"[output] {fault}")
    if section.endpoint is not None:
        fault = "is none of ROS 2, which has ROS_DOMAIN_ID and RMW_IMPLEMENTATION in the environment; leave it out"
        raise UsageError(f"[output] endpoint = {section.endpoint!r} {fault}")
    if section.odom_topic.lstrip("/") == topics.wheel.lstrip("/"):
        raise UsageError(
            f"[output] odom_topic = {section.odom_topic!r} is also the topic of [topics] wheel: the robot would take its own "
            'odometry for that of its wheels; set wheel = "" if it has none'
        )
    _checked[0] = section, topics


OUTPUT = OutputHook(_open_output, check, needs_bus=False)
