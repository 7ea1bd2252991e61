"""The robot carries no scipy, and the odometry must run without."""

import subprocess
import sys
from pathlib import Path

SCRIPT = """
import sys

sys.modules["scipy"] = None  # it is not on this robot
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.odometry.odometry import Odometry
from fleetmap.odometry.settings import OdometrySettings
from support.worlds.inertial_motion import sample_motion
from support.worlds.textured_room import driven, mounted, stereo_frame

frames = (stereo_frame(k * 50_000_000) for k in [*range(1, 30), 37, 38])
odometry = Odometry(mounted(ImuNoise()), OdometrySettings())
*_, estimate = driven(odometry, frames, sample_motion(rate_hz=200.0, duration_s=3.0))
assert estimate.inertial, estimate
print("status", estimate.status)
"""


def test_odometry_needs_no_scipy() -> None:
    """Flow, descriptors after a gap, start in motion and filter updates, in a process where scipy cannot be imported."""
    command = [sys.executable, "-c", SCRIPT]
    said = subprocess.check_output(command, cwd=Path(__file__).parents[1], text=True, timeout=240)
    assert "status tracking" in said
