"""When an IMU or a start is given up, and when pictures stand still."""

import numpy as np

from fleetmap.geometry import se3, so3_exp
from fleetmap.odometry.odometry_checks import DivergenceMonitor, ZeroVelocityDetector

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
    strays = [doubts.is_wrong_start(0.0, STILL, stepped(m)) for m in (0.7, 0.7, 0.1, 0.7, 0.7, 0.7)]
    assert strays == [False] * 5 + [True]
    doubts.begin_again()
    assert not doubts.is_wrong_start(0.0, STILL, stepped(0.7))
    assert not doubts.is_wrong_start(0.059, STILL, None)
    assert doubts.is_wrong_start(-0.061, STILL, STILL)


def test_pictures_stand_still_only_after_a_whole_window_of_it() -> None:
    pictures, ids = ZeroVelocityDetector(0.3, 0.5), np.arange(30)
    pixels = np.random.default_rng(1).uniform(0, 300, (30, 3))
    found = [pictures.since(k * 100_000_000, ids, pixels + 0.01 * k) for k in range(6)]
    assert found[:3] == [None] * 3
    assert found[3] == (0, 200_000_000)
    assert found[5] == (200_000_000, 400_000_000)
    assert pictures.since(600_000_000, ids, pixels + 4.0) is None
    assert pictures.since(700_000_000, ids[:9], pixels[:9]) is None, "nine points are too few to tell"
