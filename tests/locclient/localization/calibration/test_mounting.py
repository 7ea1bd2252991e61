"""Mounting of the cameras: gravity, the driving direction and the floor say how it differs from the calibration."""

from dataclasses import replace

import numpy as np

from fleetmap.geometry import Array, se3, se3_inverse, so3_exp
from fleetmap.relocalization.relocalizer import Fix
from fleetmap.sensors.samples import WheelSample
from locclient.localization.calibration import mounting
from locclient.localization.calibration.mounting import BasePose, WheelTravel
from support.fleet.estimates import estimate

COVARIANCE = np.diag([0.001**2] * 3 + [0.005**2] * 3)


def base_at(
    x_m: float, y_m: float, yaw_rad: float, by_wheels: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> BasePose:
    map_from_base = se3(so3_exp(np.array([0, 0, yaw_rad])), np.array([x_m, y_m, 0.0]))
    return BasePose(map_from_base, COVARIANCE, np.array(by_wheels))


def test_a_turned_camera_tilts_gravity_and_a_tilted_map_turns_with_the_robot() -> None:
    turn, map_tilt = np.radians([0.8, -0.5, 0.0]), np.radians([0.2, 0.3, 0.0])
    normal, right_side = np.zeros((4, 4)), np.zeros(4)
    for yaw_rad in np.linspace(0, 5, 12):
        odom_from_body = so3_exp(np.array([0, 0, yaw_rad])) @ so3_exp(np.array([0.03, -0.02, 0.0]))
        map_from_body = so3_exp(map_tilt) @ odom_from_body @ so3_exp(turn)  # as the wrong calibration makes it
        odometry = replace(estimate(0.0).odometry, odom_from_body=se3(odom_from_body, np.zeros(3)), inertial=True)
        jacobian, measured = mounting.tilt(
            Fix(se3(map_from_body, np.zeros(3)), COVARIANCE, 50, 12), np.eye(4), odometry
        )
        normal += jacobian.T @ jacobian
        right_side += jacobian.T @ measured
    found = np.linalg.solve(normal, right_side)
    assert np.allclose(found, [*turn[:2], *map_tilt[:2]], atol=np.radians(0.03))


def test_a_step_against_the_wheels_shows_a_turned_camera() -> None:
    """Straight, along an arc, along one whose turn the wheels do not tell, and with the turn before the way."""
    error_rad = np.radians(1.0)
    turned = se3(so3_exp(np.array([0, 0, error_rad])), np.zeros(3))
    arc = (np.cos(0.06), np.sin(0.06), 0.12)
    early = (np.cos(0.12), np.sin(0.12), 0.12)
    for way, by_wheels in (((1.0, 0.0, 0.0), (1.0, 0.0, 0.0)), (arc, arc), (arc, (1.0, 0.0, 0.0)), (early, early)):
        before, now = base_at(0, 0, 0.0), base_at(*way, by_wheels)
        believed = [end._replace(map_from_base=end.map_from_base @ turned) for end in (before, now)]
        right = mounting.heading(before, now)
        wrong = mounting.heading(*believed)
        assert right is not None
        assert wrong is not None
        assert abs(right[0]) < 1e-3
        assert abs(wrong[0] - error_rad) < 1e-3
        assert 0.004 < wrong[1] < (0.01 if way[2] == by_wheels[2] else 0.04)


def test_a_turn_that_the_wheels_do_not_tell_may_have_come_at_one_end() -> None:
    for x_m, y_m in ((1.0, 0.0), (np.cos(0.12), np.sin(0.12))):
        found = mounting.heading(base_at(0, 0, 0), base_at(x_m, y_m, 0.12, (1.0, 0.0, 0.0)))
        assert found is not None
        assert abs(found[0]) < 2 * found[1]


def test_a_step_that_shows_no_direction_says_nothing() -> None:
    assert mounting.heading(base_at(0, 0, 0), base_at(0.1, 0, 0, (0.1, 0, 0))) is None  # short
    assert mounting.heading(base_at(0, 0, 0), base_at(1, 0, 0.5, (1, 0, 0.5))) is None  # a turn
    assert mounting.heading(base_at(0, 0, 0), base_at(1, 0, 0)) is None  # carried
    assert mounting.heading(base_at(0, 0, 0), base_at(1, 0, 0, (np.nan, np.nan, np.nan))) is None  # no wheels then


def test_wheels_sum_up_along_their_turns() -> None:
    travel = WheelTravel()
    assert not travel.is_heard
    travel.handle([WheelSample(k * 100_000_000, np.array([1.0, 0.2, 0.0]), 0.0, 0.01, 0.01) for k in range(11)])
    assert travel.is_heard
    assert np.allclose(travel.at(1_000_000_000), [1.0, 0.2, 0.0])
    assert np.allclose(travel.at(250_000_000), [0.25, 0.05, 0.0])  # between two samples
    assert np.isnan(travel.at(1_000_000_001)).all()
    quarter = [WheelSample(k * 10_000_000, np.array([0.5 * np.pi, 0, 0]), 0.5 * np.pi, 0.01, 0.01) for k in range(101)]
    around = WheelTravel()
    around.handle(quarter)
    assert np.allclose(around.at(1_000_000_000), [1.0, 1.0, 0.5 * np.pi], atol=1e-3)


def landmarks(rng: np.random.Generator, on_floor: int) -> Array:
    """Racks around, from the floor up, and so many landmarks on the floor, of which some are reflections below."""
    racks = rng.uniform([-4, -4, 0.1], [4, 4, 3.0], (300, 3))
    floor = np.column_stack([rng.uniform(-4, 4, (on_floor, 2)), rng.normal(0, 0.01, on_floor)])
    return np.vstack([racks, floor, [[0, 1, -0.6], [1, 0, -0.4]]])


def test_the_height_above_the_floor() -> None:
    points = landmarks(np.random.default_rng(0), 60)
    lifted = base_at(0, 0, 0.3)._replace(map_from_base=se3(np.eye(3), np.array([0.0, 0, 0.07])))
    found = mounting.height(lifted, points)
    assert found is not None
    assert abs(found[0] - 0.07) < 0.015
    assert mounting.height(lifted, landmarks(np.random.default_rng(0), 0)) is None  # no floor to be seen
    assert mounting.height(lifted, np.zeros((0, 3))) is None
    assert np.allclose(se3_inverse(lifted.map_from_base)[2, 3], -0.07)
