"""Odometry of stereo and single cameras, with and without IMU: used live by the robot and for the initial trajectory by the survey.

Names are imported at their first use, so that reading settings stays light.
"""

from typing import TYPE_CHECKING

from fleetmap.lazy_names import lazy_names

if TYPE_CHECKING:
    from fleetmap.odometry.estimate import ContinuousFrame, OdometryEstimate, OdometryStatus, is_away
    from fleetmap.odometry.mono.mono_modes import MonocularOdometry, WheelOdometry, make_odometry
    from fleetmap.odometry.mono.wheel_mode import SeenWay
    from fleetmap.odometry.odometry import Odometry
    from fleetmap.odometry.settings import OdometrySettings

__all__ = [
    "ContinuousFrame",
    "MonocularOdometry",
    "Odometry",
    "OdometryEstimate",
    "OdometrySettings",
    "OdometryStatus",
    "SeenWay",
    "WheelOdometry",
    "is_away",
    "make_odometry",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "fleetmap.odometry.estimate": "ContinuousFrame OdometryEstimate OdometryStatus is_away",
        "fleetmap.odometry.mono.mono_modes": "MonocularOdometry WheelOdometry make_odometry",
        "fleetmap.odometry.mono.wheel_mode": "SeenWay",
        "fleetmap.odometry.odometry": "Odometry",
        "fleetmap.odometry.settings": "OdometrySettings",
    },
)
