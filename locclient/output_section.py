"""Settings of the estimates that a robot publishes to its own programs."""

from typing import Annotated

import msgspec

from fleetmap.config import Section
from fleetmap.version_grid import FLOOR_M, TOP_M


class OutputSection(Section, frozen=True):
    """Format and endpoint of estimates. Default endpoint: the map server's; without a server nothing is published."""

    format: str = "messagepack"
    endpoint: str | None = None
    robot_height_m: Annotated[float, msgspec.Meta(gt=FLOOR_M, le=TOP_M)] = 1.1
    autostart: bool = True
    domain: int = 0
    keys: str = "rmw_zenoh"
    namespace: str = ""
    node: str = "fleetmap_localizer"
    pose_topic: str = "amcl_pose"
    initial_pose_topic: str = "initialpose"
    odom_topic: str = "visual_odom"
    status_topic: str = "localization/status"
    map_topic: str = "map"
    tf_topic: str = "tf"
    map_frame: str = "map"
    building_frame: str = ""
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    sensor_frames: str = "fleetmap_"
    publish_odom: bool = True
    transform_tolerance_s: float = 0.0
