"""Settings of the estimates that a robot publishes to its own programs, and the interface through which they reach them."""

from abc import ABC, abstractmethod
from math import inf
from typing import Annotated

import msgspec

from fleetmap.config import Section
from fleetmap.geometry import Array
from fleetmap.version_grid import FLOOR_M, TOP_M, OccupancyGrid
from locclient.localization.estimate import Estimate
from locclient.robot.continuous_odom import PublishedPose


class OutputSection(Section, frozen=True):
    """Format and endpoint of estimates. Default endpoint: the map server's; without a server nothing is published."""

    format: str = "messagepack"
    endpoint: str | None = None
    stop_above_m: Annotated[float, msgspec.Meta(gt=0)] = inf
    robot_height_m: Annotated[float, msgspec.Meta(gt=FLOOR_M, le=TOP_M)] = 1.1
    autostart: bool = True
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
    transform_tolerance_s: Annotated[float, msgspec.Meta(ge=0, le=60)] = 0.0


class Publisher(ABC):
    """Sends estimates. An estimate that cannot be sent at once is dropped: the next one replaces it."""

    grid_height_m: float | None = None
    """Robot height in metres for the version's occupancy grid; None if no grid is published."""

    @abstractmethod
    def publish(self, estimate: Estimate, published: PublishedPose, base_from_body: Array) -> None:
        """Send this estimate."""

    def alive(self, is_silent: bool) -> None:  # noqa: B027
        """Publish a heartbeat, called once a second; is_silent: no frames are received."""

    def show_grid(self, version: int, grid: OccupancyGrid | None, why: str) -> None:  # noqa: B027
        """Publish the grid of the version that runs now, or the reason `why` there is none; thread-safe."""

    def close(self) -> None:  # noqa: B027
        """Undeclare all publishers."""


class NoPublisher(Publisher):
    """Sends estimates to nobody."""

    def publish(self, estimate: Estimate, published: PublishedPose, base_from_body: Array) -> None:
        return
