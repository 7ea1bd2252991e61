"""Starts under an even acceleration, which an IMU alone takes for a tilt."""

import numpy as np
import pytest

from fleetmap.geometry import Array, rotation_angle_rad, se3, so3_exp
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.odometry.odometry import Odometry
from fleetmap.odometry.settings import OdometrySettings
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import ImuSamples, WheelSample
from support.worlds.textured_room import BODY_FROM_CAM, CAMERA, rig, view

IMU = ImuNoise(2e-4, 1e-5, 2e-3, 1e-4)
SPEEDING_UP_MPS2 = 0.8  # as a tote robot drives off
FRAME_NS, IMU_NS, FRAMES = 50_000_000, 5_000_000, 28
TURN_NS, TURN_RADPS = 100_000_000, 3.0
_RIGHT_FROM_LEFT = se3(np.eye(3), np.array([CAMERA.baseline_m, 0.0, 0.0]))


def placed(time_s: float, speed_mps: float, speeding_up_mps2: float) -> Array:
    """The body on its way along x."""
    way_m = speed_mps * time_s + 0.5 * speeding_up_mps2 * time_s**2
    return np.asarray(se3(np.eye(3), np.array([-2.0 + way_m, 0.2, 0.1])))


def frame(number: int, speed_mps: float, speeding_up_mps2: float) -> RectifiedFrame:
    left = placed(number * FRAME_NS * 1e-9, speed_mps, speeding_up_mps2) @ BODY_FROM_CAM
    return RectifiedFrame(number * FRAME_NS, view(left), view(left @ _RIGHT_FROM_LEFT), None)


def started(
    *, wheels: bool, imu_from_ns: int, speed_mps: float = 0.0, speeding_up_mps2: float = SPEEDING_UP_MPS2
) -> list[OdometryEstimate]:
    """Estimates of a robot that speeds up evenly; its IMU, and its wheels, speak from imu_from_ns on."""
    odometry = Odometry(rig(IMU), CAMERA, BODY_FROM_CAM, 0.0, OdometrySettings())
    rng = np.random.default_rng(2)
    stamps_ns = np.arange(imu_from_ns, (FRAMES + 1) * FRAME_NS, IMU_NS)
    gyro = rng.normal(0, 2e-4 * np.sqrt(200), (len(stamps_ns), 3))
    accel = np.array([speeding_up_mps2, 0.0, 9.81]) + rng.normal(0, 2e-3 * np.sqrt(200), (len(stamps_ns), 3))
    samples, fed_ns, estimates = ImuSamples(stamps_ns, gyro, accel), imu_from_ns, []
    for number in range(1, FRAMES + 1):
        until_ns = number * FRAME_NS + 1
        odometry.handle_imu(samples.between(fed_ns, until_ns))
        if wheels:
            rolled = range(-(-fed_ns // 20_000_000) * 20_000_000, until_ns, 20_000_000)
            speeds = [speed_mps + speeding_up_mps2 * stamp * 1e-9 for stamp in rolled]
            odometry.handle_wheel(
                [WheelSample(s, np.array([v, 0.0, 0.0]), 0.0, 0.02, 0.02) for s, v in zip(rolled, speeds, strict=True)]
            )
        fed_ns = until_ns
        estimates.append(odometry.handle_stereo(frame(number, speed_mps, speeding_up_mps2)))
    return estimates


def tilt_deg(estimate: OdometryEstimate) -> float:
    return float(np.degrees(np.arccos(np.clip(estimate.odom_from_body[2, 2], -1.0, 1.0))))


@pytest.mark.parametrize(("imu_from_ns", "speed_mps"), [(0, 0.0), (-1_000_000_000, 1.0)])
def test_pictures_tell_it_from_a_tilt(imu_from_ns: int, speed_mps: float) -> None:
    inertial = [e for e in started(wheels=False, imu_from_ns=imu_from_ns, speed_mps=speed_mps)[1:] if e.inertial]
    assert len(inertial) > 3
    assert max(map(tilt_deg, inertial)) < 1.0  # 3.5 and more where the acceleration is taken for a tilt


def test_wheels_tell_it_before_the_first_picture() -> None:
    assert not started(wheels=True, imu_from_ns=-1_000_000_000)[0].inertial


@pytest.mark.parametrize(("wheels", "imu_from_ns"), [(False, 0), (False, -1_000_000_000), (True, -1_000_000_000)])
def test_the_speed_of_an_even_drive_is_known_at_once(wheels: bool, imu_from_ns: int) -> None:
    """By pictures where they were there, else by wheels; else the filter would take what measures it for outliers."""
    found = started(wheels=wheels, imu_from_ns=imu_from_ns, speed_mps=2.0, speeding_up_mps2=0.0)[1:]
    (a, first), *_, (b, last) = [(n, estimate) for n, estimate in enumerate(found) if estimate.inertial]
    way_m = np.linalg.norm(last.odom_from_body[:3, 3] - first.odom_from_body[:3, 3])
    assert np.linalg.norm(first.velocity_odom_mps) == pytest.approx(2.0, abs=0.1)
    assert way_m == pytest.approx(2.0 * (b - a) * FRAME_NS * 1e-9, abs=0.04)


def test_the_gyro_leads_the_eye_through_a_turn_at_the_start() -> None:
    """Before gravity is known, too: a turn that begins is nothing like the motion before, and flow follows the wrong points."""
    odometry = Odometry(rig(IMU), CAMERA, BODY_FROM_CAM, 0.0, OdometrySettings())
    stamps_ns = np.arange(0, 10 * TURN_NS, IMU_NS)
    gyro = np.where((stamps_ns >= 2 * TURN_NS)[:, None], [0.0, 0.0, TURN_RADPS], 0.0)
    force = np.tile([0.0, 0.0, 9.81], (len(stamps_ns), 1))
    samples, fed_ns, off_rad = ImuSamples(stamps_ns, gyro, force), 0, []
    for number in range(1, 9):
        until_ns = number * TURN_NS + 1
        odometry.handle_imu(samples.between(fed_ns, until_ns))
        fed_ns, yaw = until_ns, TURN_RADPS * max(number - 2, 0) * TURN_NS * 1e-9
        truth = se3(so3_exp(np.array([0.0, 0.0, yaw])), np.array([0.3, 0.2, 0.1]))
        left = truth @ BODY_FROM_CAM
        seen = odometry.handle_stereo(RectifiedFrame(number * TURN_NS, view(left), view(left @ _RIGHT_FROM_LEFT), None))
        assert not seen.inertial
        if number == 1:
            first = seen.odom_from_body[:3, :3]
        off_rad.append(rotation_angle_rad((first.T @ seen.odom_from_body[:3, :3]).T @ truth[:3, :3]))
    assert np.degrees(max(off_rad)) < 2.0  # more than 5 without the gyro
