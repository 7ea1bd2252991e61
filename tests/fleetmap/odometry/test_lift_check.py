"""When a robot on wheels has left its floor, and what is no lift."""

from collections.abc import Callable

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.odometry.lift_check import LiftCheck
from fleetmap.sensors.samples import WheelSample

FRAME_S, MOUNTED = 1 / 15, se3(so3_exp(np.array([0.02, 0.6, 0.0])), np.array([0.3, 0.0, 0.4]))  # base_from_body
Pose = tuple[float, float, float]  # x and z of the base in metres, pitch in radians


def ramp(t: float) -> Pose:
    """Of 8 degrees, from 1 to 4 s, at 1 m/s."""
    slope = np.radians(8.0) * np.clip((t - 1.0) / 0.3, 0, 1) * np.clip((4.0 - t) / 0.3, 0, 1)
    return t, np.tan(np.radians(8.0)) * float(np.clip(t - 1.0, 0, 3)), -float(slope)


def bump(t: float) -> Pose:
    """A cable bridge of 4 cm, a quarter of a second long."""
    u = np.clip((t - 2.0) / 0.25, 0, 1)
    return 1.2 * t, float(0.04 * np.sin(np.pi * u)), float(0.07 * np.sin(2 * np.pi * u))


def brake(t: float) -> Pose:
    """From 1.8 m/s by 4 m/s^2; it dives by 3 degrees, and its wheels lock."""
    left = np.clip(2.0 - t, -0.45, 0)
    return 1.8 * min(t, 2.0) - float(1.8 * left + 2.0 * left**2), 0.0, 0.05 if 2.0 < t < 2.45 else 0.0


def lift(t: float) -> Pose:
    u = float(np.clip(t - 2.0, 0, 1))
    return min(t, 1.8), 0.5 * (10 * u**3 - 15 * u**4 + 6 * u**5), 0.0


def tip(t: float) -> Pose:
    return min(t, 1.8), 0.0, float(np.clip(t - 2.0, 0, 0.5))


def fork(t: float) -> Pose:
    """Carried level, so gently that nothing was felt of the lift."""
    return min(t, 1.8) + 0.8 * max(t - 2.0, 0.0), 0.0, 0.0


@pytest.mark.parametrize(
    ("way", "stops_s", "within_s"),
    [(ramp, 9.0, None), (bump, 9.0, None), (brake, 2.0, None), (lift, 1.8, 0.5), (tip, 1.8, 0.5), (fork, 1.8, 0.5)],
)
@pytest.mark.parametrize("has_wheels", [True, False])
def test_what_is_a_lift(way: Callable[[float], Pose], stops_s: float, within_s: float | None, has_wheels: bool) -> None:
    check, before, told_s = LiftCheck(MOUNTED), MOUNTED, []
    for k in range(1, round(5.0 / FRAME_S)):
        x_m, z_m, pitch_rad = way(k * FRAME_S)
        odom_from_body: Array = se3(so3_exp(np.array([0.0, pitch_rad, 0.0])), np.array([x_m, 0.0, z_m])) @ MOUNTED
        stamp_ns = int(k * FRAME_S * 1e9)
        wheel = [_rolling(stamp_ns, 1.0 if k * FRAME_S < stops_s else 0.0)] if has_wheels else []
        if check.is_lifted(stamp_ns, wheel, odom_from_body, se3_inverse(before) @ odom_from_body, 0.01):
            told_s.append(k * FRAME_S)
        before = odom_from_body
    assert bool(told_s) == (within_s is not None and has_wheels)
    assert within_s is None or not told_s or 2.0 < told_s[0] < 2.0 + within_s


def test_wheels_that_never_turn_say_nothing() -> None:
    check, step = LiftCheck(np.eye(4)), se3(np.eye(3), np.array([0.05, 0.0, 0.0]))
    for k in range(30):
        assert not check.is_lifted(k * 66_000_000, [_rolling(k * 66_000_000, 0.0)], np.eye(4), step, 0.01)


def test_a_turn_on_the_spot_is_no_lift_and_a_robot_set_down_on_a_slope_is_told_once() -> None:
    """The camera is half a metre ahead of the axle; the slope is of 15 degrees, on which it stands for half a minute."""
    axle_from_base, told_s = se3(np.eye(3), np.array([0.5, 0.0, 0.0])), []
    check, before = LiftCheck(np.eye(4)), axle_from_base
    for k in range(1, round(40.0 / FRAME_S)):
        t = k * FRAME_S
        yaw_rad, pitch_rad = 2.0 * np.clip(t - 2.0, 0, 3), np.radians(15.0) * np.clip(t - 8.0, 0, 0.5) / 0.5
        axle = se3(so3_exp(np.array([0.0, 0.0, yaw_rad])), np.array([min(t, 2.0), 0.0, 0.0]))
        now: Array = axle @ axle_from_base @ se3(so3_exp(np.array([0.0, pitch_rad, 0.0])), np.zeros(3))
        wheel = [_rolling(int(t * 1e9), 1.0 if t < 2.0 else 0.0, 2.0 if 2.0 < t < 5.0 else 0.0)]
        if check.is_lifted(int(t * 1e9), wheel, now, se3_inverse(before) @ now, 0.01):
            told_s.append(t)
        before = now
    assert len(told_s) == 1
    assert 8.0 < told_s[0] < 8.6


def test_wheels_that_turned_while_frames_were_missing_have_turned() -> None:
    """Up a slope of 15 degrees for 0.3 s without a frame, and at rest at its end."""
    check, slope = LiftCheck(np.eye(4)), se3(so3_exp(np.array([0.0, -np.radians(15.0), 0.0])), np.zeros(3))
    speeds_mps, begin_ns = [1.0, 1.0, 0.0], 600_000_000
    for k in range(10):
        assert not check.is_lifted(k * 66_000_000, [_rolling(k * 66_000_000, 0.0)], slope, np.eye(4), 0.01)
    wheel = [_rolling(begin_ns + 100_000_000 * n, speed) for n, speed in enumerate(speeds_mps, start=1)]
    step = se3(np.eye(3), np.array([0.25, 0.0, 0.0]))
    assert not check.is_lifted(begin_ns + 300_000_000, wheel, slope @ step, step, 0.001)


def _rolling(stamp_ns: int, speed_mps: float, yaw_rate_radps: float = 0.0) -> WheelSample:
    return WheelSample(stamp_ns, np.array([speed_mps, 0.0, 0.0]), yaw_rate_radps, 0.02, 0.02)
