"""Stereo-inertial odometry: written once, run live by the robot and as a first guess by the survey."""

from fleetmap.odometry.odometry import Odometry, OdometryEstimate, OdometryStatus
from fleetmap.odometry.settings import OdometrySettings

__all__ = ["Odometry", "OdometryEstimate", "OdometrySettings", "OdometryStatus"]
