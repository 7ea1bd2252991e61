"""Faults of an IMU that the images show: each is named, a good one is not accused, and the odometry goes on without it."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.odometry.accelerometer_check import AccelerometerCheck
from fleetmap.odometry.gyro_clock import GyroClock
from fleetmap.odometry.odometry import Odometry
from fleetmap.odometry.odometry_checks import DivergenceMonitor, ZeroVelocityDetector
from fleetmap.odometry.settings import OdometrySettings
from fleetmap.sensors.rectification import RectifiedFrame
from fleetmap.sensors.samples import ImuSamples
from support.worlds.inertial_motion import moved_between
from support.worlds.point_world import noisy_imu
from support.worlds.textured_room import FRAME_NS, IMU, driven, mounted, stereo_frame

SAMPLES = noisy_imu(np.random.default_rng(1), 6.5, IMU, np.array([0.01, -0.02, 0.015]), np.array([0.1, -0.1, 0.2]))


def fault(by_accel: Array | float, away: Array | None = None) -> str:
    """What is found in six seconds; away (6,): sigma of the images' motion from frame to frame."""
    check, rng = AccelerometerCheck(np.eye(4)), np.random.default_rng(2)
    changed = np.eye(3) * by_accel if np.ndim(by_accel) < 2 else by_accel
    imu = replace(SAMPLES, accel_mps2=SAMPLES.accel_mps2 @ changed)
    for k in range(1, 120):
        moved = moved_between((k - 1) * FRAME_NS * 1e-9, k * FRAME_NS * 1e-9)
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
    imu: ImuSamples, *, seen_sigma_rad: float = 0.0005, turns: float = 1.0, ahead_s: float = 0.01, limit_s: float = 0.06
) -> float | None:
    """What is found in six seconds; turns: the images' share of the true ones, ahead_s: of samples, when a frame comes."""
    clock, rng = GyroClock(limit_s), np.random.default_rng(2)
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


@pytest.mark.parametrize("limit_s", [0.0, 0.003, 0.01])
def test_clocks_that_are_said_to_be_exact_are_not_accused_of_nothing(limit_s: float) -> None:
    assert found(samples(), limit_s=limit_s) is None
    assert found(samples(0.1), limit_s=limit_s) == pytest.approx(0.1, abs=0.02)


@pytest.mark.parametrize(("wrong", "frames"), [("accelerometer", 80), ("clock", 50)])
def test_the_odometry_goes_on_without_what_is_wrong(wrong: str, frames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    odometry = Odometry(mounted(IMU), OdometrySettings())
    imu = replace(SAMPLES, accel_mps2=-SAMPLES.accel_mps2) if wrong == "accelerometer" else SAMPLES

    def spoil(_: Odometry, frame: RectifiedFrame) -> None:
        if frame.stamp_ns == 30 * FRAME_NS and wrong == "clock":
            monkeypatch.setattr(GyroClock, "_judge", lambda clock, _: setattr(clock, "off_s", 0.1))

    estimates = driven(odometry, (stereo_frame(k * FRAME_NS) for k in range(1, frames + 1)), imu, spoil)
    assert ("wrong sign" in odometry.accelerometer.fault) == (wrong == "accelerometer")
    assert odometry.refuses_imu == (wrong == "clock")
    assert odometry.clock.off_s == (0.1 if wrong == "clock" else None)
    assert estimates[25].inertial or wrong == "accelerometer"
    assert not estimates[-1].inertial
    moved = se3_inverse(estimates[-10].odom_from_body) @ estimates[-1].odom_from_body
    truth = moved_between((frames - 9) * FRAME_NS * 1e-9, frames * FRAME_NS * 1e-9)
    np.testing.assert_allclose(moved, truth, atol=0.03)


STILL = np.eye(4)


def turned(rad: float) -> np.ndarray:
    return se3(so3_exp(np.array([0.0, rad, 0.0])), np.zeros(3))


def stepped(metres: float) -> np.ndarray:
    return se3(np.eye(3), np.array([0.0, 0.0, metres]))


def test_an_imu_is_given_up_when_it_contradicts_more_often_than_it_agrees() -> None:
    doubts = DivergenceMonitor(0.02)
    assert not any(doubts.is_wrong_imu(STILL, turned(0.05)) for _ in range(7))
    assert not any(doubts.is_wrong_imu(STILL, turned(0.01)) for _ in range(5))
    assert not doubts.is_wrong_imu(None, turned(0.05))
    found = [doubts.is_wrong_imu(STILL, turned(0.05)) for _ in range(6)]
    assert found == [False] * 5 + [True]  # 7 - 5 + 6 = 8


def test_a_start_is_wrong_where_it_strays_three_times_in_a_row_or_the_clocks_are_impossible() -> None:
    doubts = DivergenceMonitor(0.02)
    strays = [doubts.is_wrong_start(0.0, off_mps) for off_mps in (7.0, 7.0, 1.0, 7.0, 7.0, 7.0)]
    assert strays == [False] * 5 + [True]
    doubts.begin_again()
    assert not doubts.is_wrong_start(0.0, 7.0)
    assert not doubts.is_wrong_start(0.059, 0.0)
    assert doubts.is_wrong_start(-0.061, 0.0)


def test_pictures_stand_still_only_after_a_whole_window_of_it() -> None:
    pictures, ids = ZeroVelocityDetector(0.3, 0.5), np.arange(30)
    pixels = np.random.default_rng(1).uniform(0, 300, (30, 3))
    found = [pictures.since(k * 100_000_000, ids, pixels + 0.01 * k) for k in range(6)]
    assert found[:3] == [None] * 3
    assert found[3] == (0, 200_000_000)
    assert found[5] == (200_000_000, 400_000_000)
    assert pictures.since(600_000_000, ids, pixels + 4.0) is None
    assert pictures.since(700_000_000, ids[:9], pixels[:9]) is None, "nine points are too few to tell"
