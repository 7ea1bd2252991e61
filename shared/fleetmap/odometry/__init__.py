"""Odometry of stereo and single cameras, with and without IMU: used live by the robot and for the initial trajectory by the survey.

Names are imported at their first use, so that reading settings stays light.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fleetmap.odometry.estimate import ContinuousFrame, OdometryEstimate, OdometryStatus, is_away
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
    "is_away",
    "make_odometry",
]
_NAMES = {
    "estimate": "ContinuousFrame OdometryEstimate OdometryStatus is_away",
    "mono.mono_modes": "MonocularOdometry make_odometry",
    "odometry": "Odometry",
    "settings": "OdometrySettings",
}
_MODULES = {name: f"fleetmap.odometry.{module}" for module, names in _NAMES.items() for name in names.split()}


def __getattr__(name: str) -> object:
    """Import a public name at its first use (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module 'fleetmap.odometry' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
