"""Preintegration against gtsam, against numeric derivatives and against an analytic motion."""

import gtsam
import numpy as np
import pytest

from fleetmap.geometry import so3_left_jacobian, so3_log
from fleetmap.inertial import preintegrate
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples
from support.worlds.inertial_motion import analytic_motion, predicted, sample_motion

NOISE = ImuNoise()
ZERO = np.zeros(3)
GYRO_BIAS, ACCEL_BIAS = np.array([0.01, -0.02, 0.015]), np.array([0.1, -0.05, 0.08])


def test_follows_an_analytic_motion() -> None:
    imu = sample_motion(rate_hz=400.0, duration_s=4.0, gyro_bias=GYRO_BIAS, accel_bias=ACCEL_BIAS)
    start_ns, end_ns = 313_700_000, 3_707_100_000  # between samples
    summed = preintegrate(imu, start_ns, end_ns, GYRO_BIAS, ACCEL_BIAS, NOISE)
    first, last = analytic_motion(start_ns * 1e-9), analytic_motion(end_ns * 1e-9)
    there, velocity = predicted(summed, first.map_from_body, first.velocity_map_mps, GYRO_BIAS, ACCEL_BIAS)
    assert np.linalg.norm(so3_log(there[:3, :3].T @ last.map_from_body[:3, :3])) < 5e-6
    np.testing.assert_allclose(there[:3, 3], last.map_from_body[:3, 3], atol=3e-4)
    np.testing.assert_allclose(velocity, last.velocity_map_mps, atol=2e-4)
    assert summed.max_gap_s == pytest.approx(1 / 400.0)


@pytest.mark.parametrize("walks", [False, True])
def test_agrees_with_gtsam(walks: bool) -> None:
    """gtsam's Euler steps of 0.25 ms on the interpolated signal: the same sums and covariance, to first order."""
    noise = NOISE if walks else ImuNoise(gyro_walk_radps2_rthz=0.0, accel_walk_mps3_rthz=0.0)
    imu = sample_motion(rate_hz=200.0, duration_s=2.2, gyro_bias=GYRO_BIAS, accel_bias=ACCEL_BIAS)
    summed = preintegrate(imu, 100_000_000, 2_100_000_000, GYRO_BIAS, ACCEL_BIAS, noise)
    theirs = _gtsam_sum(imu, 0.1, 2.1, noise, walks=walks)
    np.testing.assert_allclose(theirs.deltaRij().matrix(), summed.delta_rotation, atol=2e-6)
    np.testing.assert_allclose(theirs.deltaVij(), summed.delta_velocity_mps, atol=5e-4)
    np.testing.assert_allclose(theirs.deltaPij(), summed.delta_position_m, atol=5e-4)
    order = [0, 1, 2, 6, 7, 8, 3, 4, 5]  # theirs: rotation vector, position, velocity
    turned = np.eye(9)
    turned[:3, :3] = so3_left_jacobian(-so3_log(summed.delta_rotation))  # rotation vector to right perturbation
    cov = turned @ theirs.preintMeasCov()[np.ix_(order, order)] @ turned.T
    scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    np.testing.assert_allclose(summed.cov[:9, :9] / scale, cov / scale, atol=6e-3)


def test_corrections_agree_with_gtsam() -> None:
    imu = sample_motion(rate_hz=200.0, duration_s=2.2, gyro_bias=GYRO_BIAS, accel_bias=ACCEL_BIAS)
    summed = preintegrate(imu, 100_000_000, 2_100_000_000, GYRO_BIAS, ACCEL_BIAS, NOISE)
    theirs = _gtsam_sum(imu, 0.1, 2.1, NOISE, walks=False)
    gyro, accel = GYRO_BIAS + np.array([2e-3, -1e-3, 3e-3]), ACCEL_BIAS + np.array([0.02, 0.03, -0.01])
    state = gtsam.NavState(gtsam.Pose3(), np.array([0.3, -0.2, 0.1]))
    their_end = theirs.predict(state, gtsam.imuBias.ConstantBias(accel, gyro))
    ours, velocity = predicted(summed, np.eye(4), np.array([0.3, -0.2, 0.1]), gyro, accel)
    np.testing.assert_allclose(their_end.pose().matrix(), ours, atol=6e-4)
    np.testing.assert_allclose(their_end.velocity(), velocity, atol=6e-4)


def test_covariance_is_that_of_noisy_runs() -> None:
    """800 noisy realisations with walking biases: their scatter, motion and biases together, is the covariance."""
    rng = np.random.default_rng(5)
    clean = sample_motion(rate_hz=100.0, duration_s=2.0)
    noise = ImuNoise(2e-3, 4e-3, 2e-2, 5e-2)
    nominal = preintegrate(clean, 0, 2_000_000_000, ZERO, ZERO, noise)
    errors = []
    for _ in range(800):
        walk = np.cumsum(rng.normal(size=(len(clean), 6)) * 0.1, axis=0)  # sqrt(dt) of 10 ms
        white = rng.normal(size=(len(clean), 6)) * 10.0
        gyro = clean.gyro_radps - noise.gyro_walk_radps2_rthz * walk[:, :3] - noise.gyro_noise_radps_rthz * white[:, :3]
        accel = clean.accel_mps2 - noise.accel_walk_mps3_rthz * walk[:, 3:] - noise.accel_noise_mps2_rthz * white[:, 3:]
        run = preintegrate(ImuSamples(clean.stamps_ns, gyro, accel), 0, 2_000_000_000, ZERO, ZERO, noise)
        bias = np.concatenate([noise.gyro_walk_radps2_rthz * walk[-1, :3], noise.accel_walk_mps3_rthz * walk[-1, 3:]])
        turned = so3_log(nominal.delta_rotation.T @ run.delta_rotation)
        moved = [run.delta_velocity_mps - nominal.delta_velocity_mps, run.delta_position_m - nominal.delta_position_m]
        errors.append(np.concatenate([turned, *moved, bias]))
    scatter = np.cov(np.array(errors).T)
    root = np.linalg.inv(np.linalg.cholesky(nominal.cov))
    whitened = root @ scatter @ root.T
    values = np.linalg.eigvalsh(whitened)
    assert values.min() > 0.70  # sampling alone spreads the 15 eigenvalues over (1 -+ sqrt(15 / 800))^2
    assert values.max() < 1.35


def test_missing_samples_are_told_and_widen_the_covariance() -> None:
    whole = sample_motion(rate_hz=200.0, duration_s=3.0)
    kept = (whole.stamps_ns < 800_000_000) | (whole.stamps_ns > 2_000_000_000)
    holed = ImuSamples(whole.stamps_ns[kept], whole.gyro_radps[kept], whole.accel_mps2[kept])
    healthy = preintegrate(whole, 0, 2_900_000_000, ZERO, ZERO, NOISE)
    damaged = preintegrate(holed, 0, 2_900_000_000, ZERO, ZERO, NOISE)
    assert healthy.max_gap_s == pytest.approx(0.005)
    assert damaged.max_gap_s == pytest.approx(1.21, abs=0.011)
    moved = damaged.delta_position_m - healthy.delta_position_m
    assert moved @ np.linalg.solve(damaged.cov[6:9, 6:9], moved) < 16.0
    assert moved @ np.linalg.solve(healthy.cov[6:9, 6:9], moved) > 100.0


def test_short_of_data_at_the_ends() -> None:
    imu = sample_motion(rate_hz=200.0, duration_s=1.0)
    inside = preintegrate(imu, 0, 1_000_000_000, ZERO, ZERO, NOISE)
    a_little = preintegrate(imu, 0, 1_004_000_000, ZERO, ZERO, NOISE)
    much = preintegrate(imu, 0, 1_500_000_000, ZERO, ZERO, NOISE)
    assert a_little.max_gap_s == pytest.approx(0.005)
    assert np.trace(a_little.cov) < 1.1 * np.trace(inside.cov)
    assert much.max_gap_s == pytest.approx(0.5)
    assert much.cov[0, 0] > 100 * inside.cov[0, 0]


def test_no_data_at_all() -> None:
    nothing = preintegrate(ImuSamples.empty(), 0, 500_000_000, ZERO, ZERO, NOISE)
    assert nothing.max_gap_s == pytest.approx(0.5)
    np.testing.assert_allclose(nothing.delta_rotation, np.eye(3))
    assert nothing.cov[3, 3] > (0.5 * 9.81) ** 2
    at_once = preintegrate(ImuSamples.empty(), 7, 7, ZERO, ZERO, NOISE)
    assert at_once.dt_s == 0.0
    assert np.isfinite(at_once.cov).all()
    single = ImuSamples(np.array([5_000_000]), np.zeros((1, 3)), np.array([[0.0, 0.0, 9.81]]))
    held = preintegrate(single, 0, 10_000_000, ZERO, ZERO, NOISE)
    np.testing.assert_allclose(held.delta_velocity_mps, [0, 0, 0.0981], rtol=1e-9)


def _gtsam_sum(imu: ImuSamples, start_s: float, end_s: float, noise: ImuNoise, *, walks: bool):  # type: ignore[no-untyped-def]
    kind = gtsam.PreintegrationCombinedParams if walks else gtsam.PreintegrationParams
    params = kind.MakeSharedU(9.81)
    params.setGyroscopeCovariance(noise.gyro_noise_radps_rthz**2 * np.eye(3))
    params.setAccelerometerCovariance(noise.accel_noise_mps2_rthz**2 * np.eye(3))
    params.setIntegrationCovariance(1e-18 * np.eye(3))
    bias = gtsam.imuBias.ConstantBias(ACCEL_BIAS, GYRO_BIAS)
    if walks:
        params.setBiasAccCovariance(noise.accel_walk_mps3_rthz**2 * np.eye(3))
        params.setBiasOmegaCovariance(noise.gyro_walk_radps2_rthz**2 * np.eye(3))
        summed = gtsam.PreintegratedCombinedMeasurements(params, bias)
    else:
        summed = gtsam.PreintegratedImuMeasurements(params, bias)
    steps = 8000
    dt_s = (end_s - start_s) / steps
    middles = start_s + (np.arange(steps) + 0.5) * dt_s
    times_s = imu.stamps_ns * 1e-9
    gyro = np.stack([np.interp(middles, times_s, c) for c in imu.gyro_radps.T], axis=1)
    accel = np.stack([np.interp(middles, times_s, c) for c in imu.accel_mps2.T], axis=1)
    for w, a in zip(gyro, accel, strict=True):
        summed.integrateMeasurement(a, w, dt_s)
    return summed
