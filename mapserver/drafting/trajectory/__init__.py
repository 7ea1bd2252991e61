"""Another SLAM system's poses as a survey's initial trajectory: read, compared with the recording, completed."""

from mapserver.drafting.trajectory.depths import with_depths
from mapserver.drafting.trajectory.given import GivenPoses, OtherTrajectory, given_poses

__all__ = ["GivenPoses", "OtherTrajectory", "given_poses", "with_depths"]
