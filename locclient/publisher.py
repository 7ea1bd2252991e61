"""The interface through which estimates reach the robot's own programs."""

from abc import ABC, abstractmethod

from fleetmap.geometry import Array
from fleetmap.occupancy_grid import OccupancyGrid
from locclient.localization.estimate import Estimate
from locclient.robot.continuous_odom import PublishedPose


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
