"""A gyro whose stamps are too late or too early is found by the turns of the images; a good one is not accused."""

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.odometry import Odometry, OdometrySettings
from fleetmap.odometry.gyro_clock import GyroClock
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples
from support.worlds.inertial_motion import analytic_motion
from support.worlds.point_world import noisy_imu
from support.worlds.textured_room import BODY_FROM_CAM, CAMERA, rig, stereo_frame

FRAME_NS = 50_000_000
IMU = ImuNoise(2e-4, 1e-5, 2e-3, 1e-4)


def yaw_rad(time_s: Array) -> Array:
    """Of a robot that looks left and right: at most 0.8 rad/s and 1.6 rad/s^2."""
    return 0.4 * np.cos(2.0 * time_s)


def samples(late_s: float = 0.0, axes_rad: Array | float = 0.0, bias_radps: float = 0.01) -> ImuSamples:
    times_s, rng = np.arange(1300) * 0.005, np.random.default_rng(1)
    rates = np.zeros((len(times_s), 3))
    rates[:, 2] = -0.8 * np.sin(2.0 * times_s)
    gyro = rates @ so3_exp(axes_rad * np.ones(3)).T + bias_radps + 0.003 * rng.normal(size=rates.shape)
    return ImuSamples(np.round((times_s + late_s) * 1e9).astype(np.int64), gyro, np.zeros_like(rates))


def found(
    imu: ImuSamples, *, seen_sigma_rad: float = 0.0005, turns: float = 1.0, ahead_s: float = 0.01
) -> float | None:
    """What is found in six seconds; turns: the images' share of the true ones, ahead_s: of samples, when a frame comes."""
    clock, rng = GyroClock(0.06), np.random.default_rng(2)
    for k in range(1, 120):
        turn = turns * np.diff(yaw_rad(np.array([k - 1, k]) * FRAME_NS * 1e-9))
        seen = so3_exp(np.array([0.0, 0.0, turn[0]]) + seen_sigma_rad * rng.normal(size=3))
        clock.handle(k * FRAME_NS, se3(seen, np.zeros(3)), imu.between(-(2**62), k * FRAME_NS + round(ahead_s * 1e9)))
    return clock.off_s


@pytest.mark.parametrize("off_s", [-0.2, -0.1, -0.07, 0.05, 0.1, 0.2])
def test_late_and_early_stamps_are_found(off_s: float) -> None:
    for sigma_rad in (0.0, 0.0005):
        assert found(samples(off_s), seen_sigma_rad=sigma_rad) == pytest.approx(off_s, abs=0.02)


@pytest.mark.parametrize(
    "imu",
    [
        samples(),
        samples(-0.05),  # the filter finds it
        samples(0.03),
        samples(axes_rad=0.05),
        samples(bias_radps=0.05),
        samples().between(0, 3_000_000_000),
        ImuSamples.empty(),
    ],
)
def test_no_other_fault_is_taken_for_a_wrong_clock(imu: ImuSamples) -> None:
    for sigma_rad in (0.0, 0.0005, 0.01):
        for scale in (1.0, 1.1):
            assert found(imu, seen_sigma_rad=sigma_rad, turns=scale) is None


def test_images_that_see_no_turn_and_samples_that_come_late_accuse_no_clock() -> None:
    assert found(samples(), turns=0.0) is None
    assert found(samples(), ahead_s=-0.2) is None


def test_the_odometry_goes_on_without_an_imu_whose_clock_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    imu = noisy_imu(np.random.default_rng(1), 4.5, IMU, np.array([0.01, -0.02, 0.015]), np.zeros(3))
    odometry, fed_ns, estimates = Odometry(rig(IMU), CAMERA, BODY_FROM_CAM, 0.0, OdometrySettings()), 0, []
    for k in range(1, 51):
        if k == 30:
            monkeypatch.setattr(GyroClock, "_judge", lambda clock, _: setattr(clock, "off_s", 0.1))
        odometry.handle_imu(imu.between(fed_ns, k * FRAME_NS + 1))
        fed_ns = k * FRAME_NS + 1
        estimates.append(odometry.handle_stereo(stereo_frame(k * FRAME_NS)))
    assert estimates[25].inertial
    assert odometry.imu_late_s == 0.1
    assert odometry.refuses_imu
    assert not estimates[-1].inertial
    first, last = (analytic_motion(n * FRAME_NS * 1e-9).map_from_body for n in (41, 50))
    moved = se3_inverse(estimates[40].odom_from_body) @ estimates[49].odom_from_body
    np.testing.assert_allclose(moved, se3_inverse(first) @ last, atol=0.03)
