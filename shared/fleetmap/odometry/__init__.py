"""Odometry of stereo and single cameras, with and without IMU: run live by the robot and as initial trajectory by the survey."""

from fleetmap.odometry.estimate import ContinuousFrame, OdometryEstimate, OdometryStatus
from fleetmap.odometry.mono.mono_modes import MonocularOdometry, make_odometry
from fleetmap.odometry.odometry import Odometry
from fleetmap.odometry.settings import OdometrySettings

__all__ = [
    "ContinuousFrame",
    "MonocularOdometry",
    "Odometry",
    "OdometryEstimate",
    "OdometrySettings",
    "OdometryStatus",
    "make_odometry",
]
