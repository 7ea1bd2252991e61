"""A robot drives or stands, by its wheels, its velocity, or how far its cameras moved; docks are the truth that a robot in service meets:
compared once for each arrival, with places that it had claimed."""

from dataclasses import replace

import numpy as np
import pytest

from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.messages import Status
from fleetmap.odometry.estimate import OdometryStatus
from fleetmap.sensors.samples import PositionPrior, WheelSample
from locclient.localization.estimate import Estimate
from locclient.robot.motion_checks import DockCheck, SpeedGauge
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


BASE_FROM_BODY = se3(so3_exp(np.array([0.0, 0.0, np.pi / 2])), np.array([0.3, 0.0, 1.0]))


def dock(stamp_s: float, x_m: float, y_m: float = 0.0, sigma_m: float = 0.05) -> PositionPrior:
    """Says where the base is; knows no heading."""
    covariance = np.diag([np.inf, np.inf, np.inf, sigma_m**2, sigma_m**2, np.inf])
    return PositionPrior(round(stamp_s * 1e9), se3(np.eye(3), np.array([x_m, y_m, 0.0])), covariance)


def at(stamp_s: float, x_m: float, status: Status = Status.TRACKING, speed_mps: float = 0.0) -> Estimate:
    said = estimate(stamp_s, status, x_m=x_m, known=status is not Status.LOST)
    return replace(said, odometry=replace(said.odometry, velocity_odom_mps=np.array([speed_mps, 0.0, 0.0])))


def arrived(watch: DockCheck, stamp_s: float, x_m: float, *docks: PositionPrior) -> float | None:
    """What two frames at a place bring, the second with what docks say."""
    watch.handle([], at(stamp_s - 0.1, x_m))
    return watch.handle(docks, at(stamp_s, x_m))


def test_the_error_is_that_of_the_base() -> None:
    """The body stands at x = 2 and the base beside it, as the calibration says."""
    watch = DockCheck(BASE_FROM_BODY)
    # map_from_base = map_from_body @ inverse(base_from_body): the base's origin is 0.3 m along the body's y.
    assert arrived(watch, 1.0, 2.0, dock(1.0, 2.0, 0.3)) == pytest.approx(0.0, abs=1e-9)
    assert arrived(DockCheck(BASE_FROM_BODY), 1.0, 2.0, dock(1.0, 2.3, 0.7)) == pytest.approx(0.5)


def test_a_dock_of_another_floor_says_nothing_here() -> None:
    elsewhere = replace(dock(1.0, 2.3, 0.7), floor="hall-2")
    assert arrived(DockCheck(BASE_FROM_BODY), 1.0, 2.0, elsewhere) is None


def test_an_arrival_counts_once_and_the_next_one_again() -> None:
    watch = DockCheck(np.eye(4))
    assert arrived(watch, 1.0, 0.0, dock(1.0, 0.1)) == pytest.approx(0.1)
    assert arrived(watch, 2.0, 0.0, dock(2.0, 0.1)) is None
    assert arrived(watch, 3.0, 0.5, dock(3.0, 0.6)) is None, "it has hardly moved"
    assert arrived(watch, 4.0, 2.5) is None
    assert arrived(watch, 5.0, 0.0, dock(5.0, 0.2)) == pytest.approx(0.2)


def test_zones_and_operators_are_no_docks() -> None:
    watch = DockCheck(np.eye(4))
    assert arrived(watch, 1.0, 0.0, dock(1.0, 0.6, sigma_m=1.0)) is None
    unknown = replace(dock(1.1, 0.6), cov_rot_trans=np.full((6, 6), np.inf))
    assert arrived(watch, 1.1, 0.0, unknown) is None
    assert arrived(watch, 1.2, 0.0, dock(1.2, 0.6)) == pytest.approx(0.6), "they were no arrival either"


@pytest.mark.parametrize("before", [Status.LOST, Status.DEGRADED, Status.AMBIGUOUS, Status.INITIALISING])
def test_who_had_claimed_nothing_was_not_wrong(before: Status) -> None:
    """A robot that is told its place by the dock agrees with it afterwards."""
    watch = DockCheck(np.eye(4))
    watch.handle([], at(0.9, 0.0, before))
    assert watch.handle([dock(1.0, 0.5)], at(1.0, 0.0)) is None


def test_a_word_that_is_old_is_not_compared_while_the_robot_drives() -> None:
    for speed_mps, expected in ((0.0, pytest.approx(0.1)), (1.0, None)):
        watch = DockCheck(np.eye(4))
        watch.handle([], at(0.9, 0.0, speed_mps=speed_mps))
        assert watch.handle([dock(0.9, 0.1)], at(1.0, 0.0, speed_mps=speed_mps)) == expected


def test_odometry_that_begins_anew_is_no_way() -> None:
    watch, change = DockCheck(np.eye(4)), se3(np.eye(3), np.array([50.0, 0.0, 0.0]))
    assert arrived(watch, 1.0, 0.0, dock(1.0, 0.1)) == pytest.approx(0.1)
    said = at(1.1, 0.0)
    redefined = replace(said.odometry, odom_from_body=_moved(change, said), new_odom_from_old_odom=change)
    assert watch.handle([dock(1.1, 0.1)], replace(said, odometry=redefined)) is None


def _moved(change: Array, said: Estimate) -> Array:
    return np.asarray(change @ said.odometry.odom_from_body)
