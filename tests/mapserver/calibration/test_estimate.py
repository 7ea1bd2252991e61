import pytest

from fleetsim.recorder import Order
from mapserver.calibration import CalibrationEstimate, CalibrationParameter, estimate_from
from mapserver.calibration.parameters import INDEX
from support.worlds.calibration_scene import make_stretch, measured, with_errors, zero_theta

P = CalibrationParameter
# What a calibration may be off by: each at least twenty sigmas of what a loop of half a minute shows.
ERRORS = {
    P.BASELINE: 0.05,
    P.FOCAL: 0.02,
    P.FOCAL_RATIO: 0.01,
    P.PRINCIPAL_X: 4.0,
    P.PRINCIPAL_Y: -4.0,
    P.PAIR_PITCH: 0.003,
    P.PAIR_YAW: -0.003,
    P.PAIR_ROLL: 0.004,
    P.CAMERA_IMU_Y: 0.03,
    P.TIME_OFFSET: 0.01,
}


@pytest.fixture(scope="module")
def loop():
    """The second half of a loop, with both turns in it."""
    return make_stretch(Order("small-loop", seed=1), 5.0, 24.0, step_s=0.4, per_frame=60)


def estimated(loop, theta, seed=1, **sensors) -> CalibrationEstimate:
    return estimate_from([measured(loop, with_errors(loop.session.true, theta), seed, **sensors)])


@pytest.mark.parametrize("name", ERRORS)
def test_each_parameter_is_found_within_its_sigma(loop, name):
    theta = zero_theta()
    theta[INDEX[name]] = ERRORS[name]
    found = estimated(loop, theta).get(name)
    true = 1.0 / (1.0 - ERRORS[name]) - 1.0 if not found.unit else ERRORS[name]
    assert found.is_judged, found
    assert abs(found.estimate - true) < 4.0 * found.sigma, found
    assert abs(true) > 10.0 * found.sigma, found
