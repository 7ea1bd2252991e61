"""Splines against scipy, rates against numeric derivatives, the IMU integrated back, routes within limits."""

from contextlib import closing

import numpy as np
import pytest

from fleetmap.errors import UsageError
from fleetsim import motion as motions
from fleetsim.motion import CarriedMotion, Limits, Route, RouteMotion, Shake, check_clear, time_path
from fleetsim.recorder import Order, drive, prepare
from fleetsim.scenarios import SCENARIOS
from fleetsim.scene.layout import Layout

SQUARE = Route(((2.0, 2.0), (14.0, 2.0), (14.0, 9.0), (3.0, 9.0), (3.0, 3.0), (12.0, 3.0)), stops=((2, 2.0),))


def _motion(route: Route = SQUARE, *, speed_mps: float = 2.0, shake: Shake | None = None) -> RouteMotion:
    return RouteMotion(route, Limits(speed_mps, 1.2, 1.6, 0.6), 0.25, shake or Shake(), np.random.default_rng(1))


def test_rates_equal_numeric_derivatives() -> None:
    motion, step = _motion(), 1e-4
    times = np.arange(0.5, motion.duration_s - 0.5, 0.037)
    gyro, accel = motion.rates(times)
    before, at, after = (motion.map_from_body(times + shift) for shift in (-step, 0.0, step))
    spin = np.einsum("nji,njk->nik", at[:, :3, :3], (after - before)[:, :3, :3] / (2 * step))
    np.testing.assert_allclose(gyro, np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], 1), atol=1e-6)
    second = (after - 2 * at + before)[:, :3, 3] / step**2 + np.array([0, 0, 9.80665])
    np.testing.assert_allclose(accel, np.einsum("nji,nj->ni", at[:, :3, :3], second), atol=2e-5)


def test_limits_stops_and_rest_are_kept() -> None:
    motion = _motion(shake=Shake(0.0, 0.0))
    times = np.arange(0.0, motion.duration_s, 0.01)
    velocity, (gyro, force) = motion.velocity_body(times), motion.rates(times)
    assert velocity[:, 0].max() < 2.01
    assert np.abs(gyro[:, 2]).max() < 1.6 * 1.1
    assert np.abs(force[:, 0]).max() < 1.2 * 1.3
    assert np.abs(velocity[:, 1]).max() < 0.03  # a wheeled robot hardly slips sideways
    standing = np.abs(velocity[:, 0]) < 0.02
    assert standing[:100].all()
    assert standing[-100:].all()
    middle = standing[300:-300].sum() * 0.01
    assert 1.5 < middle < 3.0  # the stop of two seconds


def test_a_lift_takes_a_robot_up_a_storey_in_the_dark_to_another_hall() -> None:
    session = prepare(Order("two-floors", robot="tote-1"))
    with closing(session.renderer):
        assert isinstance(session.motion, CarriedMotion)
        ((start_s, end_s),) = session.motion.rides_s
        heights_m = session.motion.map_from_body(np.array([start_s, end_s - 1e-6, end_s]))[:, 2, 3]
        np.testing.assert_allclose(np.diff(heights_m), [motions.STOREY_M, -motions.STOREY_M], atol=2e-3)
        assert session.renderer.faults.has("camera-dark", end_s - 0.1)
        assert not session.renderer.faults.has("camera-dark", end_s)
        ((from_s, above),) = session.renderer.above
        assert from_s == end_s
        assert above._world.seed != session.world.seed


def test_a_carried_robot_is_lifted_between_its_rests_and_feels_it() -> None:
    first, second = _motion(), _motion(Route(((5.0, 5.0), (9.0, 5.0))))
    carried = CarriedMotion([first, second])
    times = first.duration_s + np.arange(0.0, 2.0 * motions.LIFT_S, 0.001)
    places, (_, force) = carried.map_from_body(times), carried.rates(times)
    jumps_m = np.linalg.norm(np.diff(places[:, :3, 3], axis=0), axis=1)
    assert np.argmax(jumps_m) == motions.LIFT_S * 1000 - 1
    assert jumps_m.max() > 1.0
    assert np.sort(jumps_m)[-2] < 0.002
    heights_m = places[:, 2, 3] - places[0, 2, 3]
    np.testing.assert_allclose(heights_m[[0, -1]], 0.0, atol=1e-3)
    assert heights_m.max() == pytest.approx(motions.LIFT_M, abs=1e-3)
    by_differences = np.gradient(np.gradient(heights_m, 0.001), 0.001)
    felt = np.einsum("ni,ni->n", places[:, 2, :3], force) - motions.GRAVITY_MPS2
    np.testing.assert_allclose(felt[2:-2], by_differences[2:-2], atol=0.05)
    np.testing.assert_allclose(carried.velocity_body(times), 0.0, atol=0.01)


def test_doubling_back_is_refused() -> None:
    with pytest.raises(UsageError, match="doubles back"):
        time_path(Route(((0.0, 0.0), (5.0, 0.0), (1.0, 0.0))), Limits())


def test_a_path_through_a_rack_is_refused() -> None:
    layout = Layout(aisles=2)
    across = np.array([[10.0, layout.aisle_y_m(0)], [10.0, layout.row_y_m(0)]])
    with pytest.raises(UsageError, match=r"passes 0\.00 m from the solid"):
        check_clear(across, layout, 0.3)


@pytest.mark.parametrize("name", list(SCENARIOS))
def test_no_scenario_drives_through_anything(name: str) -> None:
    scenario = SCENARIOS[name]()
    for run in scenario.runs.values():
        motion = drive(run, run.kind, scenario.layout, np.random.default_rng(0))
        assert motion.duration_s > 2.0
