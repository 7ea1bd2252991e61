"""Another SLAM system's poses as a survey's initial trajectory: read, compared with the recording, completed.

To add a format: a function from a file to `PoseRows` and a line in TRAJECTORY_FORMATS (examples/other_trajectory.py is one).
"""

from mapserver.build.trajectory.depths import with_depths
from mapserver.build.trajectory.formats import TRAJECTORY_FORMATS, PoseRows
from mapserver.build.trajectory.given import GivenPoses, OtherTrajectory, given_poses

__all__ = ["TRAJECTORY_FORMATS", "GivenPoses", "OtherTrajectory", "PoseRows", "given_poses", "with_depths"]
