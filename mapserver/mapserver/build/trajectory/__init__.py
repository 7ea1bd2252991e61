"""Another SLAM system's poses as a survey's initial trajectory: read, compared with the recording, completed."""

from mapserver.build.trajectory.depths import with_depths
from mapserver.build.trajectory.given import GivenPoses, OtherTrajectory, given_poses

__all__ = ["GivenPoses", "OtherTrajectory", "given_poses", "with_depths"]
