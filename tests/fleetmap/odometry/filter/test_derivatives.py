"""Derivatives of the invariant filter against numeric ones, and its process noise against scatter."""

import numpy as np
import pytest

from fleetmap import core
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, transform_points
from fleetmap.inertial import imu_intervals
from fleetmap.odometry.filter.msckf import InvariantFilter, NavState
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples
from support.worlds.inertial_motion import analytic_motion, sample_motion
from support.worlds.point_world import BODY_FROM_CAM, CAMERA, CAMERAS, NOISE, SETTINGS, error_of, perturbed, true_state

WEIGHTS = 1 / 0.6, 1 / 0.35
EXACT = ImuNoise(0.0, 0.0, 0.0, 0.0)
SPAN = 3_000_000, 503_000_000


def moved(state: NavState, covariance: Array, imu: ImuSamples, noise: ImuNoise) -> InvariantFilter:
    """A filter after half a second."""
    estimate = InvariantFilter(state, covariance, SETTINGS, CAMERAS)
    estimate.propagate(imu, *SPAN, noise)
    return estimate


def test_transition_is_the_derivative_of_the_invariant_error() -> None:
    """The error of one number alone, and what becomes of it: its covariance is a column of the transition times itself."""
    imu, nothing = sample_motion(rate_hz=200.0, duration_s=1.0), np.zeros((15, 15))
    truth = true_state(0.003, np.array([0.02, -0.01, 0.03]), np.array([0.1, 0.2, -0.1]))
    end, step = moved(truth, nothing, imu, EXACT).state, 1e-5
    for k, unit in enumerate(np.eye(15)):
        sides = [perturbed(truth, so3_exp(sign * step * unit[:3]), sign * step * unit) for sign in (1, -1)]
        plus, minus = (error_of(moved(side, nothing, imu, EXACT).state, end) for side in sides)
        numeric = (plus - minus) / (2 * step)
        found = moved(truth, np.outer(unit, unit), imu, EXACT).covariance[:15, :15]
        accuracy = 2e-4 if k >= 9 else 1e-8
        np.testing.assert_allclose(found, np.outer(numeric, numeric), atol=accuracy, err_msg=f"column {k}")


def test_process_noise_is_the_scatter_of_noisy_runs() -> None:
    """Mean normalised error squared of 300 runs and 15 dof: 1 within 0.065 at three sigmas."""
    rng, rate_hz = np.random.default_rng(5), 200.0
    imu, start = sample_motion(rate_hz=rate_hz, duration_s=1.0), true_state(0.003)
    clean = moved(start, np.zeros((15, 15)), imu, NOISE)
    inverse, first, end = np.linalg.inv(clean.covariance[:15, :15]), *np.searchsorted(imu.stamps_ns, SPAN)
    total, shape = 0.0, imu.gyro_radps.shape
    for _ in range(300):
        white = np.sqrt(rate_hz) * rng.normal(size=(2, *shape))
        walks = np.cumsum(rng.normal(size=(2, *shape)) / np.sqrt(rate_hz), axis=1)
        walks -= walks[:, first, None]
        gyro_walk, accel_walk = NOISE.gyro_walk_radps2_rthz * walks[0], NOISE.accel_walk_mps3_rthz * walks[1]
        gyro = imu.gyro_radps + NOISE.gyro_noise_radps_rthz * white[0] + gyro_walk
        accel = imu.accel_mps2 + NOISE.accel_noise_mps2_rthz * white[1] + accel_walk
        state = moved(start, np.zeros((15, 15)), ImuSamples(imu.stamps_ns, gyro, accel), NOISE).state
        motion = clean.state[:3]
        # here the samples' true biases walked away from the state's, which stayed at zero
        error = error_of(state, NavState(*motion, gyro_walk[end - 1], accel_walk[end - 1]))
        total += error @ inverse @ error / 15
    assert 0.9 < total / 300 < 1.1


@pytest.mark.parametrize("with_mono", [False, True])
def test_track_jacobians_are_numeric_derivatives(with_mono: bool) -> None:
    times_s = np.array([0.0, 0.2, 0.5])
    bodies = np.array([analytic_motion(t).map_from_body for t in times_s])
    point = bodies[1, :3, 3] + bodies[1, :3, :3] @ np.array([3.0, 0.4, -0.3])
    clones, views = np.array([2, 0, 1]), np.array([4, 1, 3])  # by the first camera, and twice by the second
    lenses = np.tile([camera.lens for camera, _ in CAMERAS], (3, 1))

    def residuals(odom_from_bodies: Array, at: Array) -> tuple[Array, Array, Array]:
        cams = (odom_from_bodies[:, None] @ np.array([body_from_cam for _, body_from_cam in CAMERAS])).reshape(-1, 4, 4)
        pixels = np.tile([300.0, 200.0, 280.0], (3, 1))
        if with_mono:
            pixels[1, 2] = np.nan
        rows = core.linearise_track(at, cams, views, pixels, lenses, *WEIGHTS)
        assert len(rows) == (8 if with_mono else 9)
        return rows[:, -1], rows[:, 3:21], rows[:, :3]

    _, by_clone, by_point = residuals(bodies, point)
    step = 1e-6
    for k in range(18):
        index, sides = clones[k // 6], []
        for sign in (1, -1):
            error, changed = sign * step * np.eye(6)[k % 6], bodies.copy()
            changed[index] = se3(so3_exp(error[:3]), error[3:]) @ bodies[index]
            sides.append(residuals(changed, point)[0])
        np.testing.assert_allclose(by_clone[:, k], -(sides[0] - sides[1]) / (2 * step), atol=1e-4)
    for k in range(3):
        shift = step * np.eye(3)[k]
        numeric = -(residuals(bodies, point + shift)[0] - residuals(bodies, point - shift)[0]) / (2 * step)
        np.testing.assert_allclose(by_point[:, k], numeric, atol=1e-4)


def test_error_sources_are_what_they_do_to_pixels() -> None:
    """Columns times an error against what the error makes of the whitened rows, a monocular view among them."""
    exact = np.array([[300.0, 200.0, 280.0], [310.0, 204.0, np.nan], [330.0, 190.0, 306.0]])
    cams, point = np.tile(np.eye(4), (3, 1, 1)), np.array([0.1, 0.2, 1.5])
    cams[:, 2, 3] = 0.0, 0.1, 0.2
    rows = core.linearise_track(point, cams, np.arange(3), exact, np.tile(CAMERA.lens, (3, 1)), *WEIGHTS)
    errors, expected = np.array([0.3, 0.02, 0.05, -0.03, -0.4]), []
    for pixel, disparity in zip(exact, CAMERA.lens[3] / (point[2] - cams[:, 2, 3]), strict=True):
        way = pixel[:2] - exact[0, :2]
        slipped = errors[2] * way + errors[3] * np.array([-way[1], way[0]])
        expected += list(slipped * WEIGHTS[0])
        if np.isfinite(pixel[2]):
            expected.append((errors[0] + errors[1] * disparity + errors[4]) * WEIGHTS[1])
    np.testing.assert_allclose(rows[:, 21:26] @ errors, expected)


def test_triangulation_finds_the_point_from_a_poor_start() -> None:
    bodies = np.array([analytic_motion(t).map_from_body for t in (0.0, 0.3, 0.6)])
    cams = bodies @ BODY_FROM_CAM
    target = cams[0, :3, 3] + cams[0, :3, :3] @ np.array([0.5, -0.3, 4.0])
    pixels = np.array([CAMERA.pixel_from_point(transform_points(se3_inverse(c), target[None]))[0] for c in cams])
    for given in (pixels, pixels * [1.0, 1.0, np.nan]):
        found = cams[0, :3, 3] + cams[0, :3, :3] @ np.array([0.25, -0.15, 2.5])
        found = core.triangulate(cams, np.arange(3), given, np.tile(CAMERA.lens, (3, 1)), *WEIGHTS, found)
        np.testing.assert_allclose(found, target, atol=1e-3)


def test_intervals_hold_the_middle_of_the_samples() -> None:
    stamps = np.array([0, 10, 20, 30], np.int64) * 1_000_000
    ramp = np.arange(4.0)[:, None] * np.ones(3)
    steps_s, gyro, accel = imu_intervals(ImuSamples(stamps, ramp, 2 * ramp), 5_000_000, 45_000_000)
    np.testing.assert_allclose(steps_s, [0.005, 0.01, 0.01, 0.015])
    np.testing.assert_allclose(gyro[:, 0], [0.75, 1.5, 2.5, 3.0])
    np.testing.assert_allclose(accel, 2 * gyro)
    assert len(imu_intervals(ImuSamples.empty(), 0, 10)[0]) == 0
    assert len(imu_intervals(ImuSamples(stamps, ramp, ramp), 10, 10)[0]) == 0


@pytest.mark.parametrize("sigma", [0.1, 0.5, 1.0, 3.0, 20.0, 100.0])
def test_what_passes_a_gate_is_a_truncated_normal(sigma: float) -> None:
    """Against the integral over what lies below the gate, by sums over a fine grid."""
    edge = 2.0
    x = np.linspace(-edge, edge, 200_001)
    density = np.exp(-0.5 * (x / sigma) ** 2)
    left = (x**2 * density).sum() / density.sum() / sigma**2
    np.testing.assert_allclose(core.share_that_passes(edge**2, sigma**2), left, rtol=1e-3)
