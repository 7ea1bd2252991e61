"""An accelerometer that the images contradict is named by its axes or its unit; a good one is not accused."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.odometry import Odometry, OdometrySettings
from fleetmap.odometry.accelerometer_check import AccelerometerCheck
from fleetmap.sensors.calibration import ImuNoise
from support.worlds.inertial_motion import analytic_motion
from support.worlds.point_world import noisy_imu
from support.worlds.textured_room import BODY_FROM_CAM, CAMERA, rig, stereo_frame

FRAME_NS = 50_000_000
IMU = ImuNoise(2e-4, 1e-5, 2e-3, 1e-4)
SAMPLES = noisy_imu(np.random.default_rng(1), 6.5, IMU, np.array([0.01, -0.02, 0.015]), np.array([0.1, -0.1, 0.2]))


def fault(by_accel: Array | float, away: Array | None = None) -> str:
    """What is found in six seconds; away (6,): sigma of the images' motion from frame to frame."""
    check, rng = AccelerometerCheck(np.eye(4)), np.random.default_rng(2)
    imu = replace(
        SAMPLES, accel_mps2=SAMPLES.accel_mps2 @ (np.eye(3) * by_accel if np.ndim(by_accel) < 2 else by_accel)
    )
    for k in range(1, 120):
        before, now = (analytic_motion(n * FRAME_NS * 1e-9).map_from_body for n in (k - 1, k))
        moved = se3_inverse(before) @ now
        if away is not None:
            noise = away * rng.normal(size=6)
            moved = moved @ se3(so3_exp(noise[:3]), noise[3:])
        check.handle(k * FRAME_NS, moved, imu, on_wheels=False)
    return check.fault


SEEN = np.repeat([0.0005, 0.002], 3)


@pytest.mark.parametrize(
    ("by_accel", "words"),
    [
        (1.0, ""),
        (1.05, ""),
        (so3_exp(np.array([0.05, -0.05, 0.0])), ""),
        (-1.0, "wrong sign"),
        (np.diag([-1.0, 1.0, 1.0]), "wrong sign on its x axis"),
        (np.diag([1.0, -1.0, 1.0]), "wrong sign on its y axis"),
        (np.diag([1.0, 1.0, -1.0]), "wrong sign on its z axis"),
        (np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), "axes exchanged (x is y, y is -x, z is z)"),
        (0.0, "gravity was taken out"),
        (1 / 9.80665, "it is in g"),
        (9.80665, "unit"),
        (0.5, "check its unit"),
    ],
)
def test_faults_are_named(by_accel: Array | float, words: str) -> None:
    for found in (fault(by_accel), fault(by_accel, SEEN)):
        assert words in found
        assert bool(words) == bool(found)


@pytest.mark.parametrize("away", [10.0 * SEEN, 100.0 * SEEN])
def test_images_that_are_followed_badly_accuse_no_accelerometer(away: Array) -> None:
    assert not fault(1.0, away)


def test_the_odometry_goes_on_without_a_negated_accelerometer() -> None:
    odometry, fed_ns, estimates = Odometry(rig(IMU), CAMERA, BODY_FROM_CAM, 0.0, OdometrySettings()), 0, []
    imu = replace(SAMPLES, accel_mps2=-SAMPLES.accel_mps2)
    for k in range(1, 81):
        odometry.handle_imu(imu.between(fed_ns, k * FRAME_NS + 1))
        fed_ns = k * FRAME_NS + 1
        estimates.append(odometry.handle_stereo(stereo_frame(k * FRAME_NS)))
    assert "wrong sign" in odometry.accelerometer_fault
    assert not odometry.refuses_imu
    assert not estimates[-1].inertial
    first, last = (analytic_motion(n * FRAME_NS * 1e-9).map_from_body for n in (61, 80))
    moved = se3_inverse(estimates[60].odom_from_body) @ estimates[79].odom_from_body
    np.testing.assert_allclose(moved, se3_inverse(first) @ last, atol=0.03)
