"""Derivatives of the invariant filter against numeric ones, and its process noise against scatter."""

import numpy as np
import pytest

from fleetmap.geometry import Array, se3_inverse, so3_exp, transform_points
from fleetmap.inertial import imu_intervals
from fleetmap.odometry.filter import msckf_kernels, propagation_kernels
from fleetmap.odometry.filter.nav_state import NavState
from fleetmap.sensors.samples import ImuSamples
from support.worlds.inertial_motion import analytic_motion, sample_motion
from support.worlds.point_world import BODY_FROM_CAM, CAMERA, NOISE, error_of, perturbed, true_state

GRAVITY = np.array([0.0, 0.0, -9.81])
INTRINSICS = np.array([CAMERA.focal_px, CAMERA.cx_px, CAMERA.cy_px, CAMERA.focal_px * CAMERA.baseline_m])
WEIGHTS = np.array([1 / 0.6, 1 / 0.35])
DENSITIES = np.array(
    [NOISE.gyro_noise_radps_rthz, NOISE.accel_noise_mps2_rthz, NOISE.gyro_walk_radps2_rthz, NOISE.accel_walk_mps3_rthz]
)


def moved(state: NavState, steps_s: Array, gyro: Array, accel: Array) -> tuple[NavState, Array, Array]:
    """The state after the intervals, transition and process noise."""
    s = state.copy()
    phi, processes = np.empty((15, 15)), np.empty((1, 15, 15))
    propagation_kernels.propagate(s.arrays, GRAVITY, steps_s, gyro, accel, DENSITIES[None], phi, processes)
    return s, phi, processes[0]


@pytest.fixture(scope="module")
def intervals() -> tuple[Array, Array, Array]:
    return imu_intervals(sample_motion(rate_hz=200.0, duration_s=1.0), 3_000_000, 503_000_000)


def test_transition_is_the_derivative_of_the_invariant_error(intervals: tuple[Array, Array, Array]) -> None:
    truth = true_state(0.003, np.array([0.02, -0.01, 0.03]), np.array([0.1, 0.2, -0.1]))
    end, phi, _ = moved(truth, *intervals)
    step = 1e-5
    for k in range(15):
        error = step * np.eye(15)[k]
        sides = [moved(perturbed(truth, so3_exp(sign * error[:3]), sign * error), *intervals)[0] for sign in (1, -1)]
        numeric = (error_of(sides[0], end) - error_of(sides[1], end)) / (2 * step)
        np.testing.assert_allclose(phi[:, k], numeric, atol=2e-4 if k >= 9 else 1e-8, err_msg=f"column {k}")


def test_process_noise_is_the_scatter_of_noisy_runs(intervals: tuple[Array, Array, Array]) -> None:
    """Mean normalised error squared of 300 runs and 15 dof: 1 within 0.065 at three sigmas."""
    rng = np.random.default_rng(5)
    steps_s, gyro, accel = (a[:40] for a in intervals)
    start = true_state(0.003)
    clean, _, process = moved(start, steps_s, gyro, accel)
    inverse = np.linalg.inv(process)
    root = np.sqrt(steps_s)[:, None]
    total = 0.0
    for _ in range(300):
        white = [rng.normal(size=gyro.shape) for _ in range(4)]
        walks = [np.cumsum(density * root * w, axis=0) for density, w in zip(DENSITIES[2:], white[2:], strict=True)]
        noisy_gyro = gyro + DENSITIES[0] / root * white[0] + np.vstack([np.zeros(3), walks[0][:-1]])
        noisy_accel = accel + DENSITIES[1] / root * white[1] + np.vstack([np.zeros(3), walks[1][:-1]])
        state, _, _ = moved(start, steps_s, noisy_gyro, noisy_accel)
        truth = NavState(clean.rotation, clean.velocity_mps, clean.position_m, walks[0][-1], walks[1][-1])
        # here the samples' true biases walked away from the state's, which stayed at zero
        error = error_of(state, truth)
        total += error @ inverse @ error / 15
    assert 0.9 < total / 300 < 1.1


@pytest.mark.parametrize("with_mono", [False, True])
def test_track_jacobians_are_numeric_derivatives(with_mono: bool) -> None:
    times_s = np.array([0.0, 0.2, 0.5])
    bodies = np.array([analytic_motion(t).map_from_body for t in times_s])
    point = bodies[1, :3, 3] + bodies[1, :3, :3] @ np.array([3.0, 0.4, -0.3])
    clones = np.array([2, 0, 1])

    def residuals(odom_from_bodies: Array, at: Array) -> tuple[Array, Array, Array]:
        cams = odom_from_bodies @ BODY_FROM_CAM
        pixels = np.tile([300.0, 200.0, 280.0], (3, 1))
        if with_mono:
            pixels[1, 2] = np.nan
        by_clone, by_point, residual = np.zeros((9, 18)), np.zeros((9, 3)), np.zeros(9)
        rows = msckf_kernels.linearize_track(
            at, np.ascontiguousarray(cams[:, :3, :3]), np.ascontiguousarray(cams[:, :3, 3]), clones, pixels,
            INTRINSICS, WEIGHTS, by_clone, by_point, residual,
        )  # fmt: skip
        assert rows == (8 if with_mono else 9)
        return residual, by_clone, by_point

    _, by_clone, by_point = residuals(bodies, point)
    step = 1e-6
    for k in range(18):
        index, sides = clones[k // 6], []
        for sign in (1, -1):
            error, changed = sign * step * np.eye(6)[k % 6], bodies.copy()
            turn = so3_exp(error[:3])
            changed[index, :3, :3] = turn @ bodies[index, :3, :3]
            changed[index, :3, 3] = turn @ bodies[index, :3, 3] + error[3:]
            sides.append(residuals(changed, point)[0])
        np.testing.assert_allclose(by_clone[:, k], -(sides[0] - sides[1]) / (2 * step), atol=1e-4)
    for k in range(3):
        shift = step * np.eye(3)[k]
        numeric = -(residuals(bodies, point + shift)[0] - residuals(bodies, point - shift)[0]) / (2 * step)
        np.testing.assert_allclose(by_point[:, k], numeric, atol=1e-4)


def test_error_sources_are_what_they_do_to_pixels() -> None:
    """Columns times an error against what the error makes of the whitened rows, a monocular view among them."""
    exact = np.array([[300.0, 200.0, 280.0], [310.0, 204.0, np.nan], [330.0, 190.0, 306.0]])
    disparities = np.array([20.0, 22.0, 24.0])
    columns = np.zeros((9, 5))
    msckf_kernels.add_error_sources(exact, disparities, WEIGHTS, columns)
    errors = np.array([0.3, 0.02, 0.05, -0.03, -0.4])
    rows = []
    for pixel, disparity in zip(exact, disparities, strict=True):
        way = pixel[:2] - exact[0, :2]
        slipped = errors[2] * way + errors[3] * np.array([-way[1], way[0]])
        rows += list(slipped * WEIGHTS[0])
        if np.isfinite(pixel[2]):
            rows.append((errors[0] + errors[1] * disparity + errors[4]) * WEIGHTS[1])
    np.testing.assert_allclose(columns[:8] @ errors, rows)


def test_triangulation_finds_the_point_from_a_poor_start() -> None:
    bodies = np.array([analytic_motion(t).map_from_body for t in (0.0, 0.3, 0.6)])
    cams = bodies @ BODY_FROM_CAM
    target = cams[0, :3, 3] + cams[0, :3, :3] @ np.array([0.5, -0.3, 4.0])
    pixels = np.array([CAMERA.pixel_from_point(transform_points(se3_inverse(c), target[None]))[0] for c in cams])
    for mono in (False, True):
        given = pixels.copy()
        if mono:
            given[:, 2] = np.nan
        found = cams[0, :3, 3] + cams[0, :3, :3] @ np.array([0.25, -0.15, 2.5])
        assert msckf_kernels.triangulate(
            np.ascontiguousarray(cams[:, :3, :3]), np.ascontiguousarray(cams[:, :3, 3]), np.arange(3), given, INTRINSICS,
            WEIGHTS, found,
        )  # fmt: skip
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
    np.testing.assert_allclose(msckf_kernels.share_that_passes(edge**2, sigma**2), left, rtol=1e-3)
