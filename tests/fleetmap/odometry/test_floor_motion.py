"""When a floor robot without wheel odometry has left its floor, and what is no lift: slopes, thresholds, braking, flights, hands."""

from collections.abc import Callable

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.odometry.lift_check import FloorMotion

# Anywhere on the robot, by any axes: nobody has told how the body is mounted.
MOUNTED = se3(so3_exp(np.array([1.1, -0.8, 0.4])), np.array([0.3, 0.1, 0.4]))  # robot_from_body
WHEELBASE_M, SPEED_MPS, DRIVEN_S, SIGMA_MPS = 0.4, 1.0, 12.0, 0.005
Way = Callable[[float], Array]  # odom_from_robot (4, 4) at a time in seconds


def posed(x_m: float, z_m: float, pitch_rad: float = 0.0, yaw_rad: float = 0.0, y_m: float = 0.0) -> Array:
    turned = so3_exp(np.array([0.0, 0.0, yaw_rad])) @ so3_exp(np.array([0.0, -pitch_rad, 0.0]))
    return se3(turned, np.array([x_m, y_m, z_m]))


def over(height_m: Callable[[float], float], speed_mps: float = SPEED_MPS, wheelbase_m: float = WHEELBASE_M) -> Way:
    """A robot on two axles over a floor's profile."""

    def way(t: float) -> Array:
        x_m = speed_mps * t
        rear_m, front_m = height_m(x_m), height_m(x_m + wheelbase_m)
        return posed(x_m, rear_m, float(np.arctan2(front_m - rear_m, wheelbase_m)))

    return way


def slope(degrees: float) -> Callable[[float], float]:
    return lambda x_m: float(np.tan(np.radians(degrees)) * np.clip(x_m - SPEED_MPS * DRIVEN_S, 0.0, 2.0))


def bump(x_m: float) -> float:
    """A cable bridge of 4 cm."""
    return float(0.04 * np.sin(np.pi * np.clip((x_m - SPEED_MPS * DRIVEN_S) / 0.3, 0.0, 1.0)))


def brake(t: float) -> Array:
    """It dives by 5 degrees, and rocks back."""
    late_s = max(t - DRIVEN_S, 0.0)
    return posed(min(t, DRIVEN_S), 0.0, -np.radians(5.0) * float(np.exp(-3.0 * late_s) * np.sin(10.0 * late_s)))


def turn(t: float) -> Array:
    return posed(min(t, DRIVEN_S), 0.0, yaw_rad=2.0 * max(t - DRIVEN_S, 0.0))


def after(way: Callable[[float], Array]) -> Way:
    """What happens to a robot that has come to rest on its floor, for a second and a half."""
    return lambda t: posed(min(t, DRIVEN_S - 0.5), 0.0) @ way(float(np.clip(t - DRIVEN_S, 0.0, 1.5)))


def lift(t: float) -> Array:
    u = min(t, 1.0)
    return posed(0.0, 0.5 * (10 * u**3 - 15 * u**4 + 6 * u**5))


def tip(t: float) -> Array:
    return posed(0.0, 0.0, pitch_rad=min(t, 0.6))


def flight(t: float) -> Array:
    """At a level that it holds to 3 cm, tilted by its accelerations, until it climbs."""
    pitch_rad = np.radians(4.0) * np.sin(1.3 * t)
    return posed(t, 0.03 * np.sin(1.5 * t) + 0.5 * max(t - DRIVEN_S, 0.0), float(pitch_rad), 0.3 * np.sin(0.5 * t))


def walk(t: float) -> Array:
    """In a hand, by steps that raise it by 2 cm."""
    return posed(t, 0.02 * np.sin(12.0 * t) + 0.3 * max(t - DRIVEN_S, 0.0), 0.05 * np.sin(6.0 * t))


def told_s(
    way: Way, rate_hz: float = 15.0, begin_s: float = 0.0, end_s: float = DRIVEN_S + 3.0, missing_s: tuple[float, float] = (0.0, 0.0),
) -> list[float]:  # fmt: skip
    """Times after DRIVEN_S at which it is reported as lifted. missing_s: after DRIVEN_S, without frames."""
    check, rng, told = FloorMotion(), np.random.default_rng(1), []
    before = way(begin_s) @ MOUNTED
    for t in np.arange(begin_s, end_s, 1.0 / rate_hz)[1:].tolist():
        if missing_s[0] < t - DRIVEN_S < missing_s[1]:
            continue
        now = way(t) @ MOUNTED
        moved = se3_inverse(before) @ now
        moved[:3, 3] += rng.normal(0.0, SIGMA_MPS / rate_hz, 3)
        if check.is_lifted(int(t * 1e9), now[2, :3], moved, SIGMA_MPS):
            told.append(t - DRIVEN_S)
        before = now
    return told


@pytest.mark.parametrize("rate_hz", [5.0, 15.0, 30.0])
@pytest.mark.parametrize("way", [after(lift), after(lambda t: posed(0.5 * t, 0.4 * t, y_m=0.4 * t)), after(tip)])
def test_a_robot_that_leaves_its_floor_is_told_at_once(way: Way, rate_hz: float) -> None:
    assert 0.0 < told_s(way, rate_hz)[0] < 0.41 + 1.0 / rate_hz


@pytest.mark.parametrize("rate_hz", [5.0, 15.0, 30.0])
@pytest.mark.parametrize(
    "way",
    [over(slope(16.0)), over(slope(-16.0)), over(slope(16.0), 2.0), over(slope(16.0), 0.2), over(slope(30.0), 0.5, 0.8),
     over(bump), over(bump, 2.0), brake, turn],
)  # fmt: skip
def test_floors_are_no_lift(way: Way, rate_hz: float) -> None:
    end_s = 80.0 if way(1.0)[0, 3] < 0.3 else DRIVEN_S + 4.0
    assert not told_s(way, rate_hz, end_s=end_s)


def test_a_slope_that_was_driven_while_frames_were_missing_is_no_lift() -> None:
    assert not told_s(over(slope(16.0)), missing_s=(-0.2, 0.8))


@pytest.mark.parametrize("way", [flight, walk])
def test_what_flies_or_is_held_by_hand_has_no_floor(way: Way) -> None:
    assert not told_s(way)


def test_a_robot_that_has_hardly_driven_is_not_judged() -> None:
    assert not told_s(after(lift), begin_s=DRIVEN_S - 5.0)


def test_a_lift_is_told_until_it_ends_and_the_next_one_after_another_drive() -> None:
    """Nobody knows where it is set down: it may be carried on."""
    told = told_s(lambda t: after(lift)(t) if t < 16.0 else after(lift)(16.0) @ after(lift)(t - 20.0), end_s=36.0)
    first, second = [t for t in told if t < 4.0], [t for t in told if t > 4.0]
    assert max(first) < 1.5
    assert min(second) > 20.0
