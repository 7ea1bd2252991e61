"""The robot carries no scipy, and the odometry must run without."""

import os
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]

SCRIPT = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "scipy":
            raise ModuleNotFoundError("scipy is not on this robot", name=name)
        return None

sys.meta_path.insert(0, Refuse())
import numpy as np
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
assert "scipy" not in sys.modules
print("status", estimate.status)
"""


def test_odometry_needs_no_scipy() -> None:
    """Flow, descriptors after a gap, start in motion and filter updates, in a process where scipy cannot be imported."""
    found = [str(TESTS), *(str(TESTS.parent / p) for p in ("shared", ""))]
    ended = subprocess.run(
        [sys.executable, "-c", SCRIPT],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(found)},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    assert "status tracking" in ended.stdout
