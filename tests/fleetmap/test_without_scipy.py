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
from support.worlds.textured_room import mounted, stereo_frame

odometry = Odometry(mounted(ImuNoise()), OdometrySettings())
samples, fed_ns = sample_motion(rate_hz=200.0, duration_s=3.0), 0
for stamp_ns in [k * 50_000_000 for k in [*range(1, 30), 37, 38]]:
    odometry.handle_imu(samples.between(fed_ns, stamp_ns + 1))
    fed_ns = stamp_ns + 1
    estimate = odometry.handle_stereo(stereo_frame(stamp_ns))
assert estimate.inertial, estimate
print("status", estimate.status)
"""


def test_odometry_needs_no_scipy() -> None:
    """Flow, descriptors after a gap, start in motion and filter updates, in a process where scipy cannot be imported."""
    command = [sys.executable, "-c", SCRIPT]
    said = subprocess.check_output(command, cwd=Path(__file__).parents[1], text=True, timeout=240)
    assert "status tracking" in said
