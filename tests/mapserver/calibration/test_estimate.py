"""Recovery of calibrations from a simulated drive without pictures: landmarks with known errors, IMU and wheels."""

from dataclasses import replace

import numpy as np
import pytest

from fleetsim.recorder import Order
from fleetsim.sensors import LENSES
from mapserver.calibration import CalibrationEstimate, CalibrationParameter
from mapserver.calibration.estimate import estimate_from
from mapserver.calibration.image_rows import Observations
from mapserver.calibration.parameters import COLUMNS, DISTORTION, INDEX, UNKNOWNS, corrected_rig
from support.worlds.calibration_scene import Stretch, make_stretch, measured, with_errors

P = CalibrationParameter
# What a calibration may be off by: each at least ten sigmas of what a loop of half a minute shows.
ERRORS = {
    P.BASELINE: 0.05,
    P.FOCAL: 0.02,
    P.FOCAL_RATIO: 0.01,
    P.PRINCIPAL_X: 8.0,
    P.PRINCIPAL_Y: -8.0,
    P.PAIR_PITCH: 0.003,
    P.PAIR_YAW: -0.003,
    P.PAIR_ROLL: 0.004,
    P.CAMERA_IMU_Y: 0.03,
    P.TIME_OFFSET: 0.01,
}
LARGE = {P.BASELINE: -0.2, P.FOCAL: 0.2}


@pytest.fixture(scope="module")
def loop() -> Stretch:
    """Most of a loop, with its turns."""
    return make_stretch(Order("small-loop", seed=1), 5.0, 24.0, step_s=0.4, per_frame=60)


@pytest.fixture(scope="module")
def straight() -> Stretch:
    """Two seconds along an aisle at nearly constant speed."""
    return make_stretch(Order("small-loop", seed=1), 3.0, 2.0, step_s=0.09, per_frame=60)


def estimated(stretch: Stretch, errors: dict[P, float], seed: int = 1, **sensors: bool) -> CalibrationEstimate:
    theta = np.zeros(len(COLUMNS))
    for name, value in errors.items():
        theta[INDEX[name]] = value
    return estimate_from([measured(stretch, with_errors(stretch.session.true, theta), seed, **sensors)])


@pytest.mark.parametrize("errors", [{}, ERRORS, LARGE], ids=["none", "many", "large"])
def test_errors_are_found_within_their_sigma(loop: Stretch, errors: dict[P, float]) -> None:
    found = estimated(loop, errors)
    for p in found.parameters[: len(COLUMNS)]:
        error = errors.get(p.name, 0.0)
        true = error if p.name.unit else 1.0 / (1.0 - error) - 1.0
        if p.name is P.WHEEL_SCALE:  # the simulated robot has an error of its own
            continue
        beside = 0.0002 * len(errors) * (p.name.unit == "rad")  # angles of several errors add to first order only
        assert abs(p.estimate - true) < 4.0 * p.sigma + 0.01 * abs(true) + beside, p
        if error:
            assert p.is_judged, p
            assert abs(true) > 10.0 * p.sigma, p


def test_targets_of_a_drive_with_turns(loop: Stretch) -> None:
    found = estimated(loop, {})
    assert found.get(P.FOCAL).sigma < 0.001
    assert found.get(P.BASELINE).sigma < 0.003
    assert found.get(P.TIME_OFFSET).sigma < 0.0005
    assert found.get(P.ACCEL_NOISE).estimate == pytest.approx(0.0, abs=0.5)
    assert found.get(P.GYRO_NOISE).estimate == pytest.approx(0.0, abs=0.5)


def test_a_straight_drive_leaves_open_what_turns_would_show(straight: Stretch) -> None:
    found = estimated(straight, {P.BASELINE: 0.05}, inertial=False, wheels=False)
    for name in (P.BASELINE, P.FOCAL, P.PRINCIPAL_X, P.TIME_OFFSET, P.CAMERA_IMU_Y, P.WHEEL_SCALE):
        assert not found.get(name).is_judged, found.get(name)
        assert found.get(name).reason
    assert "wheels" in found.get(P.BASELINE).reason
    assert found.get(P.PAIR_PITCH).is_judged
    rig = straight.session.true
    assert np.array_equal(found.corrected(rig).cameras[0].intrinsics_px[:2], rig.cameras[0].intrinsics_px[:2])


@pytest.mark.parametrize(
    "lens", ["pinhole", "radial-tangential", "plumb-bob", "rational", "equidistant", "omni", "double-sphere"]
)
def test_lenses_of_any_number_of_coefficients_can_be_adjusted(straight: Stretch, lens: str) -> None:
    """Slopes are there for the four coefficients that are left open; those beyond four are held."""
    model, distortion, _ = LENSES[lens]
    cameras = [replace(c, model=model, distortion=np.array(distortion)) for c in straight.session.true.cameras]
    rig = replace(straight.session.true, cameras=tuple(cameras))
    seen = Observations.of(measured(straight, rig, 1))
    theta = np.zeros(UNKNOWNS)
    corrected = corrected_rig(rig, seen.axes, theta)
    assert corrected.cameras[0].distortion.tolist() == [*distortion, *[0.0] * (4 - len(distortion))]
    slopes = seen.measured_slopes(theta).rows[:, :, len(COLUMNS) : len(COLUMNS) + 2 * DISTORTION]
    assert np.isfinite(slopes).all()
    assert (np.abs(slopes).max(axis=(0, 1)) > 0.1).all()


def test_a_wide_fisheye_is_not_judged_by_how_its_edges_are_stretched() -> None:
    """An error of a raw pixel is several times as large at the rectified image's edge, and less so by a longer focal length."""
    scene = make_stretch(Order("small-loop", seed=1, lens="fisheye"), 0.5, 7.0, step_s=0.15, per_frame=60)
    found = estimated(scene, {})
    for parameter in (found.get(P.FOCAL), found.get(P.BASELINE)):
        assert parameter.is_judged
        assert abs(parameter.estimate) < 3.0 * parameter.sigma, "3 % were seen, ten times the sigma"


def test_a_short_stretch_says_nothing() -> None:
    short = make_stretch(Order("small-loop", seed=1), 5.0, 3.0, step_s=0.4, per_frame=60)
    found = estimated(short, {})
    assert found.keyframes < 20
    assert not any(p.is_judged for p in found.parameters)
    assert "too short" in found.get(P.FOCAL).reason
    blind = estimated(short, {}, inertial=False, wheels=False).get(P.BASELINE).reason
    assert blind.startswith("too short: ")
    assert "neither an IMU nor wheels measure metres" in blind  # a longer drive alone would not help


def test_wheels_alone_give_the_baseline_as_well_as_they_know_themselves(loop: Stretch) -> None:
    baseline = estimated(loop, {P.BASELINE: 0.05}, inertial=False).get(P.BASELINE)
    assert baseline.is_judged
    assert 0.004 < baseline.sigma < 0.008
    assert abs(baseline.estimate - (1.0 / 0.95 - 1.0)) < 3.0 * baseline.sigma


def test_a_corrected_baseline_does_not_take_over_the_error_of_the_wheels(loop: Stretch) -> None:
    """Also where nothing but the baseline is corrected, as a build does."""
    found = estimated(loop, {P.BASELINE: 0.02})
    wheels, baseline = found.get(P.WHEEL_SCALE), found.get(P.BASELINE)
    across = found.covariance[INDEX[P.WHEEL_SCALE], INDEX[P.BASELINE]]
    only = replace(found, parameters=tuple(replace(p, is_judged=p.name is P.BASELINE) for p in found.parameters))
    correction = only.corrections()[INDEX[P.BASELINE]]
    assert abs(across) > 0.5 * wheels.sigma * baseline.sigma  # they would, if the wheels were taken to be right
    assert abs(wheels.estimate) > wheels.sigma
    assert correction == pytest.approx(baseline.estimate, abs=0.5 * baseline.sigma)


def test_two_drives_say_more_than_one(loop: Stretch) -> None:
    one = estimated(loop, {})
    two = estimate_from([measured(loop, loop.session.true, seed) for seed in (1, 2)])
    assert two.get(P.FOCAL).sigma < 0.8 * one.get(P.FOCAL).sigma


def test_the_same_data_give_the_same_bits(straight: Stretch) -> None:
    first, second = (estimated(straight, {}) for _ in range(2))
    assert first.parameters == second.parameters
    assert np.array_equal(first.covariance, second.covariance)
