"""Noise of the stated size, wheels that cannot feel slip, priors within their sigma, faults in their time."""

import numpy as np
import pytest
from numpy.typing import NDArray

from fleetmap.errors import UsageError
from fleetmap.sensors.samples import ImuSamples
from fleetsim import sensors
from fleetsim.motion import Limits, Route, RouteMotion, Shake
from fleetsim.sensors import START_NS, Fault, FaultPlan, ImuErrors, measure_imu, measure_priors, measure_wheels

Array = NDArray[np.float64]


def _motion() -> RouteMotion:
    route = Route(((2.0, 2.0), (30.0, 2.0), (30.0, 8.0)), stops=((1, 30.0),))
    return RouteMotion(route, Limits(), 0.25, Shake(), np.random.default_rng(0))


def _imu_residuals(seed: int) -> tuple[Array, Array, ImuSamples]:
    motion, errors = _motion(), ImuErrors()
    samples = measure_imu(motion, errors, np.random.default_rng(seed))
    gyro, accel = motion.rates((samples.stamps_ns - START_NS) * 1e-9)
    return samples.gyro_radps - gyro, samples.accel_mps2 - accel, samples


def test_imu_noise_and_walk_have_the_stated_density() -> None:
    errors = ImuErrors()
    gyro, accel, samples = _imu_residuals(1)
    assert (np.diff(samples.stamps_ns) == 5_000_000).all()
    for residual, density in ((gyro, errors.noise.gyro_noise_radps_rthz), (accel, errors.noise.accel_noise_mps2_rthz)):
        white = np.diff(residual, axis=0).std() / np.sqrt(2)
        assert white == pytest.approx(density * np.sqrt(200.0), rel=0.03)
    starts = np.array([_imu_residuals(seed)[1][:200].mean(axis=0) for seed in range(12)])
    assert 0.012 < starts.std() < 0.03
    # The walk of a second, from means over half a second, over many seeds: variance rate walk^2 per second.
    changes = np.array(
        [_imu_residuals(seed)[1][-1000:].mean(0) - _imu_residuals(seed)[1][:1000].mean(0) for seed in range(8)]
    )
    expected = errors.noise.accel_walk_mps3_rthz * np.sqrt(_motion().duration_s - 5.0)
    assert 0.6 * expected < changes.std() < 1.5 * expected


def test_wheels_report_the_base_and_not_the_slip() -> None:
    motion = _motion()
    samples = measure_wheels(motion, 0.25, np.random.default_rng(3))
    times = np.array([sample.stamp_ns - START_NS for sample in samples]) * 1e-9
    forward = np.array([sample.velocity_base_mps[0] for sample in samples])
    assert all(sample.velocity_base_mps[1] == 0.0 for sample in samples)
    truth = motion.velocity_body(times)[:, 0]
    moving = truth > 0.5
    ratio = forward[moving].mean() / truth[moving].mean()
    assert 0.98 < ratio < 1.02
    assert ratio != pytest.approx(1.0, abs=1e-5)
    assert forward[:50] == pytest.approx(0.0, abs=1e-4)
    assert forward.std() > 0.1
    yaw = np.array([sample.yaw_rate_radps for sample in samples]).sum() / 50
    assert yaw == pytest.approx(np.pi / 2, rel=0.05)


def test_priors_lie_within_their_sigma() -> None:
    motion, offset = _motion(), np.eye(4)
    offset[2, 3] = 0.25
    errors = []
    for seed in range(40):
        priors = measure_priors(motion, offset, 10.0, np.random.default_rng(seed))
        assert len(priors) == 1 + int(motion.duration_s / 10.0)
        for prior in priors:
            time_s = (prior.stamp_ns - START_NS) * 1e-9
            place = motion.map_from_body(np.array([time_s]))[0][:3, 3] - (0, 0, 0.25)
            errors.append((prior.map_from_base[:3, 3] - place) / np.sqrt(np.diag(prior.cov_rot_trans)[3:]))
        assert np.isfinite(priors[0].cov_rot_trans).all()
        assert np.isinf(priors[1].cov_rot_trans[2, 2])
    assert np.array(errors).std(axis=0) == pytest.approx(np.ones(3), abs=0.25)


def test_imu_gap_and_spike() -> None:
    _, _, samples = _imu_residuals(1)
    plan = FaultPlan((Fault("imu-gap", 4.0, 4.5), Fault("imu-spike", 6.0, 7.0)))
    spoilt = plan.spoil_imu(samples)
    assert len(samples) - len(spoilt) == 100
    assert np.diff(spoilt.stamps_ns).max() == 505_000_000
    assert (np.abs(spoilt.accel_mps2).max(axis=1) > 40).sum() == 1
    assert np.abs(samples.accel_mps2).max() < 40


@pytest.mark.parametrize("name", list(sensors.FAULTS))
def test_every_fault_can_be_asked_for(name: str) -> None:
    assert sensors.parse_fault(f"{name}@8+2.5") == Fault(name, 8.0, 10.5)


@pytest.mark.parametrize(
    "text", ["rain@1+2", "imu-gap", "imu-gap@x+1", "imu-gap@-1+1", "imu-gap@1+0", "imu-gap@nan+1", "imu-gap@1+inf"]
)
def test_nonsense_faults_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="fault"):
        sensors.parse_fault(text)
