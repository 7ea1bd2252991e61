"""Wheels that the robot's other sensors contradict are left out until they agree again."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fleetmap.geometry import se3
from fleetmap.sensors.samples import WheelSample
from locclient.robot.motion_checks import WheelAgreement, imu_refused
from support.fleet.estimates import estimate


def drive(
    agreement: WheelAgreement, mps: float, wheel_mps: float, metres: float, first: int = 0, **changes: Any
) -> bool:
    """Frames at 10 Hz, with changes of the odometry's estimates; whether the wheels are refused at their end."""
    for n in range(first, first + round(metres / (0.1 * max(mps, wheel_mps)))):
        moved = se3(np.eye(3), np.array([0.1 * mps, 0.0, 0.0]))
        odometry = replace(estimate(0.1 * n).odometry, previous_from_body=moved, **changes)
        wheel = WheelSample(odometry.stamp_ns, np.array([wheel_mps, 0.0, 0.0]), 0.0, 0.01, 0.01)
        agreement.handle([wheel], odometry)
    return agreement.is_refused


@pytest.mark.parametrize(
    ("factor", "metres", "is_refused"),
    [
        (1.0, 30.0, False),
        (1.2, 30.0, False),
        (-1.0, 5.0, True),
        (0.5, 5.0, True),
        (1000.0, 50000.0, True),
        (0.0, 5.0, False),  # of a robot that is carried the wheels rest, too, and not for as long
        (0.0, 20.0, True),
    ],
)
def test_wheels_that_contradict_are_refused(factor: float, metres: float, *, is_refused: bool) -> None:
    assert drive(WheelAgreement(np.eye(4)), 1.5, 1.5 * factor, metres) is is_refused


def test_wheels_that_agree_again_are_used_again() -> None:
    agreement = WheelAgreement(np.eye(4))
    assert drive(agreement, 1.0, -1.0, 5.0)
    assert drive(agreement, 1.0, 1.0, 4.0, first=50)
    assert not drive(agreement, 1.0, 1.0, 4.0, first=90)


@pytest.mark.parametrize("changes", [{"inlier_share": 0.1}, {"after_gap": True}])
def test_images_that_cannot_be_followed_accuse_no_wheels(changes: dict[str, Any]) -> None:
    """A starved processor leaves images metres apart; then it is the odometry that is wrong."""
    assert not drive(WheelAgreement(np.eye(4)), 1.5, -1.5, 30.0, **changes)


def test_an_imu_that_is_left_out_is_named_with_its_clock() -> None:
    assert "turns otherwise" in imu_refused(None)["imu_refused"]
    assert "about 0.10 s late" in imu_refused(0.101)["imu_refused"]
    assert "about 0.20 s early" in imu_refused(-0.198)["imu_refused"]
