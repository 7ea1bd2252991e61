"""Splines against scipy, rates against numeric derivatives, the IMU integrated back, routes within limits."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from fleetmap.errors import UsageError
from fleetsim.motion.body_motion import GRAVITY_MPS2, LIFT_M, LIFT_S, CarriedMotion, RouteMotion, Shake, UniformSpline
from fleetsim.motion.routes import Limits, Route, check_clear, time_path
from fleetsim.recorder import drive
from fleetsim.scenarios import SCENARIOS
from fleetsim.scene.layout import Layout

Array = NDArray[np.float64]
SQUARE = Route(((2.0, 2.0), (14.0, 2.0), (14.0, 9.0), (3.0, 9.0), (3.0, 3.0), (12.0, 3.0)), stops=((2, 2.0),))


def _motion(route: Route = SQUARE, *, speed_mps: float = 2.0, shake: Shake | None = None) -> RouteMotion:
    return RouteMotion(route, Limits(speed_mps, 1.2, 1.6, 0.6), 0.25, shake or Shake(), np.random.default_rng(1))


@pytest.mark.parametrize("derivative", [0, 1, 2])
def test_spline_equals_scipy(derivative: int) -> None:
    control = np.random.default_rng(0).normal(size=(30, 2))
    spline = UniformSpline(1.0, 0.1, control)
    reference = BSpline(1.0 + 0.1 * (np.arange(36) - 3.0), control, 5)
    times = np.linspace(*spline.span_s, 500)
    expected = reference(times) if derivative == 0 else reference.derivative(derivative)(times)
    np.testing.assert_allclose(spline.at(times, derivative), expected, atol=1e-10 * 100**derivative)


def test_rates_equal_numeric_derivatives() -> None:
    motion, step = _motion(), 1e-4
    times = np.arange(0.5, motion.duration_s - 0.5, 0.037)
    gyro, accel = motion.rates(times)
    before, at, after = (motion.map_from_body(times + shift) for shift in (-step, 0.0, step))
    spin = np.einsum("nji,njk->nik", at[:, :3, :3], (after - before)[:, :3, :3] / (2 * step))
    np.testing.assert_allclose(gyro, np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], 1), atol=1e-6)
    second = (after - 2 * at + before)[:, :3, 3] / step**2 + np.array([0, 0, 9.80665])
    np.testing.assert_allclose(accel, np.einsum("nji,nj->ni", at[:, :3, :3], second), atol=2e-5)


def _integrate(motion: RouteMotion, end_s: float, rate_hz: float) -> tuple[float, float]:
    """Largest position (m) and rotation (rad) error of a fourth-order integration of rates at rate_hz.

    Mid values by cubic interpolation, the rotation vector with Magnus' second term, positions by Simpson's rule.
    """
    count, dt = int(end_s * rate_hz), 1.0 / rate_hz
    times = np.arange(-1, count + 2) * dt + 0.5
    gyro, force = motion.rates(times)
    truth = motion.map_from_body(times[1:])
    rotation, place = truth[0, :3, :3], truth[0, :3, 3].copy()
    velocity = rotation @ motion.velocity_body(times[1:2])[0]
    gravity = np.array([0, 0, -9.80665])
    worst_m = worst_rad = 0.0
    for k in range(1, count + 1):
        w0, w1, f0, f1 = gyro[k], gyro[k + 1], force[k], force[k + 1]
        w_mid = (-gyro[k - 1] + 9 * w0 + 9 * w1 - gyro[k + 2 if k + 2 < len(gyro) else k + 1]) / 16
        f_mid = (-force[k - 1] + 9 * f0 + 9 * f1 - force[k + 2 if k + 2 < len(force) else k + 1]) / 16
        turn = (w0 + 4 * w_mid + w1) * dt / 6 + np.cross(w0, w1) * dt * dt / 12
        half_turn = (5 * w0 + 8 * w_mid - w1) * dt / 24
        middle, end = (
            rotation @ Rotation.from_rotvec(half_turn).as_matrix(),
            rotation @ Rotation.from_rotvec(turn).as_matrix(),
        )
        a0, a_mid, a1 = rotation @ f0 + gravity, middle @ f_mid + gravity, end @ f1 + gravity
        place = place + velocity * dt + (a0 + 2 * a_mid) * dt * dt / 6
        velocity = velocity + (a0 + 4 * a_mid + a1) * dt / 6
        rotation = end
        worst_m = max(worst_m, float(np.linalg.norm(place - truth[k, :3, 3])))
    worst_rad = float(np.linalg.norm(Rotation.from_matrix(truth[count, :3, :3].T @ rotation).as_rotvec()))
    return worst_m, worst_rad


def test_imu_integrates_back_over_a_minute() -> None:
    long_way = Route(
        tuple((x, y) for y in (2.0, 6.0, 10.0, 14.0) for x in ((2.0, 20.0) if y in (2.0, 10.0) else (20.0, 2.0)))
    )
    motion = _motion(long_way, speed_mps=1.5, shake=Shake(0.005, 0.002))
    assert motion.duration_s > 61.0
    worst_m, worst_rad = _integrate(motion, 60.0, 200.0)
    assert worst_m < 1e-4
    assert worst_rad < 1e-6


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


def test_a_carried_robot_is_lifted_between_its_rests_and_feels_it() -> None:
    first, second = _motion(), _motion(Route(((5.0, 5.0), (9.0, 5.0))))
    carried = CarriedMotion([first, second])
    times = first.duration_s + np.arange(0.0, 2.0 * LIFT_S, 0.001)
    places, (_, force) = carried.map_from_body(times), carried.rates(times)
    jumps_m = np.linalg.norm(np.diff(places[:, :3, 3], axis=0), axis=1)
    assert np.argmax(jumps_m) == LIFT_S * 1000 - 1
    assert jumps_m.max() > 1.0
    assert np.sort(jumps_m)[-2] < 0.002
    heights_m = places[:, 2, 3] - places[0, 2, 3]
    np.testing.assert_allclose(heights_m[[0, -1]], 0.0, atol=1e-3)
    assert heights_m.max() == pytest.approx(LIFT_M, abs=1e-3)
    by_differences = np.gradient(np.gradient(heights_m, 0.001), 0.001)
    felt = np.einsum("ni,ni->n", places[:, 2, :3], force) - GRAVITY_MPS2
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
