"""A robot drives or stands: by its wheels, its velocity, or how far its cameras moved."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import se3
from fleetmap.odometry import OdometryStatus
from fleetmap.sensors.samples import WheelSample
from locclient.robot.motion_checks import SpeedGauge
from support.fleet.estimates import estimate


def speeds(
    gauge: SpeedGauge, mps: float, *, frames: int = 40, wheel: bool = False, **about: object
) -> list[float | None]:
    """Frames at 10 Hz of a robot at a speed along x."""
    found = []
    for n in range(frames):
        odometry = replace(estimate(0.1 * n).odometry, **about)  # type: ignore[arg-type]
        wheels = (
            [WheelSample(odometry.stamp_ns, np.array([mps, 0.0, 0.0]), 0.0, 0.01, 0.01)] if wheel and n < 20 else []
        )
        found.append(gauge.handle(wheels, odometry, se3(np.eye(3), np.array([0.1 * n * mps, 0.0, 0.0]))))
    return found


def test_wheels_say_it_as_long_as_they_speak() -> None:
    found = speeds(SpeedGauge(), 0.4, wheel=True, velocity_odom_mps=np.array([2.0, 0.0, 0.0]))
    assert found[:25] == pytest.approx([0.4] * 25)
    assert found[25:] == [2.0] * 15, "half a second after the last sample"


def test_without_an_imu_the_cameras_motion_says_it() -> None:
    """The odometry's velocity is then zero, however fast the robot is."""
    still = {"inertial": False, "velocity_odom_mps": np.zeros(3)}
    assert speeds(SpeedGauge(), 0.7, **still)[6:] == pytest.approx([0.7] * 34)
    assert speeds(SpeedGauge(), 0.0, **still)[6:] == pytest.approx([0.0] * 34)
    assert speeds(SpeedGauge(), 0.7, **still)[:5] == [None] * 5


def test_what_nobody_knows_is_none() -> None:
    lost = {"inertial": False, "velocity_odom_mps": np.zeros(3)}
    assert set(speeds(SpeedGauge(), 0.7, status=OdometryStatus.DEGRADED, **lost)) == {None}
    assert set(speeds(SpeedGauge(), 0.7, scale_known=False)) == {None}
