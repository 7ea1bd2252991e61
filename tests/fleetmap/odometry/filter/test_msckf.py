"""The multi-state filter on synthetic features: consistency, observability, large corrections, relative motion."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from msgspec.structs import replace

from fleetmap.geometry import Array, se3, se3_exp, se3_inverse, se3_log, skew, so3_exp
from fleetmap.odometry.filter.msckf import InvariantFilter, NavState
from fleetmap.odometry.settings import FilterSettings
from fleetmap.sensors.calibration import ImuNoise
from fleetmap.sensors.samples import ImuSamples, WheelSample
from support.worlds.inertial_motion import analytic_motion, moved_between, sample_motion
from support.worlds.point_world import (
    CAMERAS,
    NOISE,
    SETTINGS,
    error_of,
    observe,
    perturbed,
    room,
    run_filter,
    true_state,
    use,
)

EYE = np.eye(4)
START_SIGMAS = np.repeat([0.02, 0.2, 0.05, 0.005, 0.05], 3)


def clones_at(
    times_s: list[float], seen_by: Array, rng: np.random.Generator | None, last_body_from_guess: Array = EYE, *,
    sigmas: tuple[float, float] = (0.3, 1.5),
) -> tuple[InvariantFilter, dict[int, Array]]:  # fmt: skip
    """A vision-only filter with a clone at each true place, uncertain by these sigmas in rad and m each, and what each saw.

    last_body_from_guess (4, 4) is how far off the last clone is predicted.
    """
    estimate, seen = InvariantFilter(true_state(times_s[0]), 1e-12 * np.eye(15), SETTINGS, CAMERAS), {}
    for k, time_s in enumerate(times_s):
        if k:
            step = moved_between(times_s[k - 1], time_s)
            estimate.predict_random_walk(step @ last_body_from_guess if time_s == times_s[-1] else step, *sigmas)
        estimate.add_clone(k, np.zeros(3))
        seen[k] = observe(seen_by, time_s, rng)
    return estimate, seen


def test_errors_stay_as_large_as_the_covariance_says() -> None:
    """Normalised error squared per dof over 16 runs: navigation state (15 dof) and body transform (6 dof)."""
    whole, body = [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        gyro_bias, accel_bias = np.array([0.01, -0.02, 0.005]), np.array([0.05, 0.1, -0.03])
        run = run_filter(
            rng, np.diag(START_SIGMAS**2), START_SIGMAS * rng.normal(size=15), duration_s=3.4, gyro_bias=gyro_bias,
            accel_bias=accel_bias,
        )  # fmt: skip
        error = error_of(run.filter.state, run.truth)
        whole.append(error @ np.linalg.solve(run.filter.covariance[:15, :15], error) / 15)
        # the same in the terms of the estimate: rotation in odom axes, then position
        turned = np.concatenate([error[:3], run.truth.position_m - run.filter.state.position_m])
        body.append(turned @ np.linalg.solve(run.filter.body_covariance(), turned) / 6)
        assert run.accepted_share > 0.95
    assert 0.7 < np.mean(whole) < 1.4
    assert 0.7 < np.mean(body) < 1.4


def test_yaw_and_position_never_become_known() -> None:
    """What no measurement can tell (turn about gravity, shift) keeps its variance; tilt, velocity and biases do not."""
    rng = np.random.default_rng(31)
    covariance = np.diag(START_SIGMAS**2)
    covariance[0:3, 0:3] = 0.1**2 * np.eye(3)
    run = run_filter(rng, covariance, np.zeros(15), duration_s=3.4)
    sigma = np.sqrt(np.diag(run.filter.covariance))
    assert sigma[2] >= 0.1 * (1 - 1e-6)
    assert (sigma[6:9] >= 0.05 * (1 - 1e-6)).all()
    assert (sigma[0:2] < 0.02).all()
    assert (sigma[9:12] < 0.5 * START_SIGMAS[9:12]).all()


@pytest.mark.parametrize("offset_s", [0.008, -0.008])
def test_time_offset_converges(offset_s: float) -> None:
    """With the gyro of a robot: a noisier one would blur the rates that tell one moment from another."""
    run = run_filter(
        np.random.default_rng(4), np.diag(START_SIGMAS**2), np.zeros(15), duration_s=6.0, imu_minus_cam_s=offset_s,
        noise=ImuNoise(3e-4, 1e-5, 5e-3, 1e-4), settings=replace(SETTINGS, time_offset_sigma_s=0.01),
    )  # fmt: skip
    sigma_s = float(np.sqrt(run.filter.covariance[15, 15]))
    assert sigma_s < 0.002
    assert abs(run.filter.imu_minus_cam_s - offset_s) < 2.5 * sigma_s


def test_iterated_update_recovers_from_a_bad_prediction() -> None:
    """The newest of three clones is predicted 17 degrees and 0.9 m off; vision pulls it to within a centimetre."""
    rng = np.random.default_rng(6)
    points = room(rng)
    off = se3_exp(np.array([0.1, -0.2, 0.2, 0.5, -0.6, 0.4]))
    estimate, seen = clones_at([0.0, 0.15, 0.3], points, rng, last_body_from_guess=off)
    use(estimate, seen, np.arange(len(points)), iterations=6)
    moved = se3_inverse(estimate.odom_from_clone(0)) @ estimate.odom_from_clone(2)
    off = se3_log(se3_inverse(moved_between(0.0, 0.3)) @ moved)
    assert np.linalg.norm(off[:3]) < 0.003
    assert np.linalg.norm(off[3:]) < 0.015
    np.testing.assert_allclose(estimate.odom_from_body(), estimate.odom_from_clone(2), atol=1e-6)


def test_a_hint_of_the_newest_place_adds_no_information() -> None:
    """Linearising first elsewhere ends at the same estimate and covariance once iterated."""
    rng = np.random.default_rng(7)
    points = room(rng)
    ends = []
    for hint in (None, se3_exp(np.array([0.02, -0.01, 0.03, 0.05, -0.04, 0.02]))):
        estimate, seen = clones_at([0.0, 0.15, 0.3], points, np.random.default_rng(70))
        newest = None if hint is None else hint @ estimate.odom_from_clone(2)
        use(estimate, seen, np.arange(len(points)), iterations=6, newest=newest)
        ends.append((estimate.odom_from_body(), estimate.covariance))
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=1e-5)
    np.testing.assert_allclose(ends[0][1], ends[1][1], rtol=2e-2, atol=1e-5)


def test_wrong_matches_are_refused() -> None:
    rng = np.random.default_rng(9)
    points = room(rng)
    estimate, seen = clones_at([0.0, 0.15, 0.3], points, rng, sigmas=(0.005, 0.02))
    views = np.isfinite([pixels[:, 0] for pixels in seen.values()])
    tracks = np.flatnonzero(views.sum(axis=0) > 1)
    for point in tracks[::4]:
        seen[int(views[:, point].argmax())][point] += rng.choice([-25.0, 25.0]) + np.array([0.0, 30.0, 0.0])
    used = use(estimate, seen, tracks)
    wrong = np.zeros(len(tracks), bool)
    wrong[::4] = True
    assert (used[wrong] == 1).mean() < 0.1
    assert (used[~wrong] == 1).mean() > 0.95


def test_a_point_is_looked_for_by_its_disparity_or_at_the_first_depth() -> None:
    for depth_m, columns, is_found in ((5.0, 2, True), (-5.0, 2, False), (-5.0, 3, True)):
        estimate, seen = clones_at([0.0, 0.15, 0.3], room(np.random.default_rng(1)), None)
        for pixels in seen.values():
            pixels[:, columns:] = np.nan
        assert (use(estimate, seen, np.arange(400), first_depth_m=depth_m) == 1).any() == is_found


def test_two_cameras_know_the_motion_better_and_as_well_as_they_say() -> None:
    """Of other lenses and directions; what one sees after the other, or both at once, is one track. Normalised error squared per dof."""
    points, squares, times_s = room(np.random.default_rng(3)), [], [0.0, 0.15, 0.3]
    for seed in range(20):
        covariances = []
        for cameras in (1, 2):
            rng = np.random.default_rng(seed)
            estimate, seen = clones_at(times_s, points, rng)
            for frame, time_s in enumerate(times_s[: 3 * (cameras - 1)]):
                pixels = observe(points, time_s, rng, number=1)
                visible = np.flatnonzero(np.isfinite(pixels[:, 0]))
                estimate.observe(frame, 1, visible, pixels[visible])
            used = use(estimate, seen, np.arange(len(points)), iterations=4)
            assert (used == 1).mean() > 0.98
            found, covariance = estimate.motion_since(0)
            covariances.append(covariance)
        error = se3_log(moved_between(0.0, 0.3) @ se3_inverse(found))
        squares.append(error @ np.linalg.solve(covariance, error) / 6)
        assert np.linalg.eigvalsh(covariances[0] - covariances[1]).min() > 0.0
    assert 0.7 < np.mean(squares) < 1.4


def test_relative_motion_is_the_composition_and_its_covariance_the_scatter() -> None:
    rng = np.random.default_rng(10)
    points = room(rng)
    estimate, seen = clones_at([0.0, 0.15, 0.3], points, rng)
    use(estimate, seen, np.arange(len(points)))
    earlier_from_now, covariance = estimate.motion_since(1)
    composed = se3_inverse(estimate.odom_from_clone(1)) @ estimate.odom_from_clone(2)
    np.testing.assert_allclose(earlier_from_now, composed, atol=1e-12)
    same, nothing = estimate.motion_since(2)
    np.testing.assert_allclose(same, np.eye(4), atol=1e-12)
    assert np.abs(nothing).max() < 1e-12
    # scatter of the relative motion when the clones are drawn from their joint covariance
    joint = 1e-4 * estimate.true_error_cov[20:, 20:]  # scaled down so that first order holds
    drawn = rng.multivariate_normal(np.zeros(len(joint)), joint, size=4000, method="eigh")
    offs = []
    for error in drawn.reshape(-1, 3, 6)[:, 1:]:
        lefts = (se3(so3_exp(part[:3]), part[3:]) for part in error)
        earlier, now = (left @ estimate.odom_from_clone(k) for k, left in enumerate(lefts, start=1))
        offs.append(se3_log(se3_inverse(earlier) @ now @ se3_inverse(earlier_from_now)))
    scatter = np.cov(np.array(offs).T) * 1e4
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(scatter / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.08)


def test_forgetting_a_clone_leaves_the_others_alone() -> None:
    estimate, _ = clones_at([0.0, 0.15, 0.3], room(np.random.default_rng(1)), None)
    kept = estimate.odom_from_clone(2)
    covariance = estimate.covariance.copy()
    estimate.remove_clone(1)
    assert estimate.clone_ids == [0, 2]
    np.testing.assert_array_equal(estimate.odom_from_clone(2), kept)
    rest = np.r_[0:22, 28:34]
    np.testing.assert_array_equal(estimate.covariance, covariance[np.ix_(rest, rest)])


def test_displacement_noise_is_relative_to_the_body() -> None:
    """Scatter of noisy relative motions against the covariance of the body, far from the origin."""
    rng = np.random.default_rng(12)
    state = true_state(1.0)
    step = se3_exp(np.array([0.1, 0.0, 0.2, 0.3, 0.1, 0.0]))
    estimate = InvariantFilter(state, np.zeros((15, 15)), SETTINGS, CAMERAS)
    start = estimate.odom_from_body()
    estimate.predict_random_walk(step, 0.01, 0.02)
    errors = []
    for _ in range(3000):
        noise = np.concatenate([0.01 * rng.normal(size=3), 0.02 * rng.normal(size=3)])
        off = start @ step @ se3_exp(noise) @ se3_inverse(start @ step)
        errors.append(np.concatenate([se3_log(off)[:3], (off @ start @ step - start @ step)[:3, 3]]))
    scatter = np.cov(np.array(errors).T)
    np.testing.assert_allclose(scatter, estimate.body_covariance(), atol=0.05 * scatter.diagonal().max())


def test_vision_that_contradicts_widens_and_vision_that_agrees_does_not() -> None:
    run = run_filter(np.random.default_rng(2), np.diag(START_SIGMAS**2), np.zeros(15), duration_s=0.8)
    estimate = run.filter
    newest = estimate.clone_ids[-1]
    before = estimate.covariance.copy()
    here = estimate.odom_from_body()
    assert not estimate.inflate(newest, here, 1.0)
    np.testing.assert_array_equal(estimate.covariance, before)
    away = here.copy()
    away[:3, 3] += [0.0, 2.0, 0.0]
    assert estimate.inflate(newest, away, 1.0)
    assert (np.diag(estimate.covariance)[3:9] > np.diag(before)[3:9] + 3.9).all()


def test_propagation_without_samples_stays_put() -> None:
    estimate = InvariantFilter(true_state(0.0), np.eye(15), SETTINGS, CAMERAS)
    before = estimate.odom_from_body()
    assert (estimate.propagate(ImuSamples.empty(), 0, 100, NOISE) == 0).all()
    np.testing.assert_array_equal(estimate.odom_from_body(), before)


def test_a_clone_follows_the_time_offset_as_the_motion_does() -> None:
    """Its covariance with the offset, against the invariant error between the motion a little later and now."""
    state, motion, step_s = true_state(1.3), analytic_motion(1.3), 1e-6
    estimate = InvariantFilter(state, np.zeros((15, 15)), SETTINGS, CAMERAS)
    estimate.add_clone(0, motion.gyro_radps)
    by_offset = estimate.covariance[16:22, 15] / SETTINGS.time_offset_sigma_s**2
    numeric = (error_of(state, true_state(1.3 + step_s)) - error_of(state, true_state(1.3 - step_s))) / (2 * step_s)
    np.testing.assert_allclose(by_offset, numeric[[0, 1, 2, 6, 7, 8]], atol=1e-5)


def test_wheels_and_standing_measure_what_they_say() -> None:
    """Residuals vanish at the truth, and their derivatives take a small error away."""
    motion, base_from_body = analytic_motion(1.3), se3_exp(np.array([0.1, -0.2, 0.3, 0.1, 0.2, 0.25]))
    truth = true_state(1.3)
    base_body = se3_inverse(base_from_body)[:3, 3]
    velocity_body = truth.rotation.T @ truth.velocity_mps + np.cross(motion.gyro_radps, base_body)
    turn = base_from_body[:3, :3]
    sample = WheelSample(0, turn @ velocity_body, float((turn @ motion.gyro_radps)[2]), 1e-4, 1e-4)
    settings = replace(SETTINGS, wheel_slip_mps=1e-4, wheel_sigma_scale=1.0, wheel_speed_scale_sigma=0.0)
    error = np.concatenate([np.zeros(3), 0.02 * np.array([1.0, -2.0, 1.5]), np.zeros(9)])
    covariance = np.diag(np.repeat([1e-9, 0.05, 1e-9, 1e-9, 1e-9], 3) ** 2)
    estimate = InvariantFilter(perturbed(truth, np.eye(3), error), covariance, settings, CAMERAS)
    assert estimate.correct_by_wheel_sample(sample, motion.gyro_radps, base_from_body, 100.0) < 100.0
    np.testing.assert_allclose(estimate.state.velocity_mps, truth.velocity_mps, atol=1e-4)
    slipped = WheelSample(0, 1.6 * sample.velocity_base_mps, sample.yaw_rate_radps, 1e-4, 1e-4)
    before = estimate.covariance.copy()
    assert estimate.correct_by_wheel_sample(slipped, motion.gyro_radps, base_from_body, 100.0) > 100.0
    np.testing.assert_array_equal(estimate.covariance, before)
    standing = NavState(velocity_mps=np.array([0.02, -0.01, 0.03]))
    estimate = InvariantFilter(standing, np.diag(START_SIGMAS**2), SETTINGS, CAMERAS)
    assert estimate.correct_by_rest(np.array([0.004, 0.0, -0.003]), 1e-5, 22.0) < 22.0
    assert np.linalg.norm(estimate.state.velocity_mps) < 1e-3
    np.testing.assert_allclose(estimate.state.gyro_bias_radps, [0.004, 0.0, -0.003], atol=1e-5)


def some_filter(rng: np.random.Generator, settings: FilterSettings = SETTINGS) -> InvariantFilter:
    """With covariances that have no zeros, and three clones of which one is gone."""
    roots = START_SIGMAS[:, None] * rng.normal(size=(2, 15, 15))
    covariance, true_error_cov = (np.asarray(root @ root.T) for root in roots)
    estimate = InvariantFilter(true_state(0.5), covariance, settings, CAMERAS, true_error_cov)
    imu = sample_motion(rate_hz=100.0, duration_s=2.0)
    for k in range(4):
        rate = estimate.propagate(imu, 500_000_000 + k * 10**8, 600_000_000 + k * 10**8, NOISE)
        estimate.add_clone(k, rate)
    estimate.remove_clone(1)
    return estimate


def test_a_clone_is_the_state_moved_by_the_time_offset() -> None:
    estimate = some_filter(np.random.default_rng(7))
    before, rate = (estimate.covariance, estimate.true_error_cov), np.array([0.3, -0.2, 0.1])
    state = estimate.state
    turn = state.rotation @ rate
    estimate.add_clone(9, rate)
    for covariance, grown, first in zip(before, (estimate.covariance, estimate.true_error_cov), (0, 4), strict=True):
        jacobian = np.zeros((6, len(covariance)))
        jacobian[:3, first : first + 3] = jacobian[3:, first + 6 : first + 9] = np.eye(3)
        jacobian[:, first + 15] = np.concatenate([turn, state.velocity_mps + np.cross(state.position_m, turn)])
        both = np.vstack([np.eye(len(covariance)), jacobian])
        np.testing.assert_allclose(grown, both @ covariance @ both.T, rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(grown, grown.T)


@pytest.mark.parametrize("share", [0.5, 2.0])  # of the distance at the gate
@pytest.mark.parametrize("by", ["rest", "wheels"])
def test_a_correction_is_kalmans_and_what_its_gate_refuses_changes_nothing(by: str, share: float) -> None:
    """The covariance that is weighed by, and that of the true error after the same gain."""
    rng = np.random.default_rng(8)
    settings = replace(SETTINGS, still_sigma_mps=0.3, wheel_slip_mps=0.4)
    estimate = some_filter(rng, settings)
    state, white, true = estimate.state, estimate.covariance, estimate.true_error_cov
    gyro, sigmas = rng.normal(size=3), np.array([0.2, 0.4, 0.4, 0.3])
    if by == "rest":
        full, sigmas, scale = np.zeros((6, len(true))), np.repeat([0.3, 0.2], 3), 1.0
        full[:3, 4:7], full[:3, 7:10], full[3:, 13:16] = -skew(state.velocity_mps), np.eye(3), np.eye(3)
        residual = np.concatenate([-state.velocity_mps, gyro - state.gyro_bias_radps])
    else:
        full, scale = np.zeros((4, len(true))), settings.wheel_sigma_scale
        speed = state.rotation.T @ state.velocity_mps  # the base is the body
        full[:3, 7:10], full[3, 15] = state.rotation.T, -1.0
        full[0, 2], full[3, 3] = speed[0], gyro[2] - state.gyro_bias_radps[2]
        residual = np.append(rng.normal(size=3) - speed, 0.7 - full[3, 3])
        sample = WheelSample(0, residual[:3] + speed, 0.7, 0.2, 0.3)

    def corrected(gate: float) -> float:
        if by == "rest":
            return estimate.correct_by_rest(gyro, 0.2, gate)
        return estimate.correct_by_wheel_sample(sample, gyro, np.eye(4), gate)

    noise, seen = np.diag(sigmas**2), full[:, 4:]
    distance = residual @ np.linalg.solve(full @ true @ full.T + noise, residual)
    assert corrected(distance / share) == pytest.approx(distance, rel=1e-8)
    if share > 1.0:
        np.testing.assert_array_equal(estimate.covariance, white)
        np.testing.assert_array_equal(estimate.true_error_cov, true)
        return
    gain = white @ seen.T @ np.linalg.inv(seen @ white @ seen.T + scale**2 * noise)
    left = np.eye(len(true))
    left[4:] -= gain @ full
    expected = left @ true @ left.T
    expected[4:, 4:] += gain @ noise @ gain.T
    np.testing.assert_allclose(estimate.covariance, white - gain @ seen @ white, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(estimate.true_error_cov, expected, rtol=1e-8, atol=1e-10)
    np.testing.assert_array_equal(estimate.true_error_cov, estimate.true_error_cov.T)
    assert estimate.state.gyro_bias_radps == pytest.approx(state.gyro_bias_radps + (gain @ residual)[9:12], rel=1e-8)


def everything(estimate: InvariantFilter) -> list[Array]:
    held = [estimate.odom_from_clone(number) for number in estimate.clone_ids]
    numbers = np.array([estimate.imu_minus_cam_s])
    return [*estimate.state, *held, estimate.covariance, estimate.true_error_cov, numbers]


def assert_unchanged(estimate: InvariantFilter, before: list[Array]) -> None:
    for now, then in zip(everything(estimate), before, strict=True):
        assert np.isfinite(then).all()
        np.testing.assert_array_equal(now, then)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("gate", [22.0, np.inf])
def test_what_is_no_number_corrects_nothing(bad: float, gate: float) -> None:
    estimate = some_filter(np.random.default_rng(11))
    before, gyro = everything(estimate), np.array([0.0, bad, 0.0])
    assert estimate.correct_by_rest(gyro, 1e-3, gate) == np.inf
    for velocity_mps, sigma_mps in ((np.array([bad, 0.0, 0.0]), 0.1), (np.zeros(3), bad)):
        sample = WheelSample(0, velocity_mps, 0.1, sigma_mps, 0.1)
        assert estimate.correct_by_wheel_sample(sample, np.zeros(3), np.eye(4), gate) == np.inf
    away = estimate.odom_from_body()
    away[0, 3] = bad
    assert not estimate.inflate(2, away, 1.0)
    assert_unchanged(estimate, before)
    estimate.predict_random_walk(np.eye(4), 0.3, 1.5, measured_cov=np.full((6, 6), bad))
    assert np.isfinite(estimate.covariance).all()


def test_an_update_that_would_not_be_finite_is_refused() -> None:
    """The clones are so uncertain that the product of their covariance with the images' information overflows."""
    points = room(np.random.default_rng(6))
    estimate, seen = clones_at([0.0, 0.15], points, np.random.default_rng(7))
    estimate.predict_random_walk(np.eye(4), 1e150, 1e150)
    estimate.add_clone(2, np.zeros(3))
    seen[2] = observe(points, 0.15, np.random.default_rng(8))
    before = everything(estimate)
    used = use(estimate, seen, np.arange(len(points)), iterations=4)
    assert_unchanged(estimate, before)
    assert (used == -1).any()
    assert not (used == 1).any()


def test_a_frame_that_begins_anew_changes_nothing_between_clones() -> None:
    """Neither what is known of the motions, nor what images then say of them; only where the frame lies is certain again."""
    points, found = room(np.random.default_rng(3)), []
    for is_anew in (False, True):
        estimate, seen = clones_at([0.0, 0.15, 0.3], points, np.random.default_rng(4))
        known, placed = [estimate.motion_since(k) for k in (0, 1)], estimate.odom_from_clone(1)
        if is_anew:
            apart = np.abs(estimate.body_covariance()).max()
            change = estimate.begin_frame_anew()
            np.testing.assert_allclose(estimate.odom_from_clone(1), change @ placed, atol=1e-12)
            np.testing.assert_allclose(estimate.state.position_m, np.zeros(3), atol=1e-12)
            left = np.abs(estimate.body_covariance()).max()
            assert left < 1e-3 * apart, "what is left is the offset of a clone's time"
            for (motion, cov), k in zip(known, (0, 1), strict=True):
                np.testing.assert_allclose(estimate.motion_since(k)[0], motion, atol=1e-12)
                np.testing.assert_allclose(estimate.motion_since(k)[1], cov, atol=1e-9)
        use(estimate, seen, np.arange(len(points)), iterations=4)
        found.append([estimate.motion_since(k) for k in (0, 1)])
    for (motion, cov), (anew, anew_cov) in zip(*found, strict=True):
        np.testing.assert_allclose(anew, motion, atol=1e-6)
        np.testing.assert_allclose(anew_cov, cov, rtol=1e-3, atol=1e-3 * np.abs(cov).max())


@pytest.mark.parametrize("away_m", [0.0, 50.0, 5000.0])
@pytest.mark.parametrize("unseen_steps", [0, 30])
def test_gaps_and_distance_leave_a_covariance(away_m: float, unseen_steps: int) -> None:
    """Two pairs of frames that share no points, with seconds between them in which nothing was known, far from where the frame began."""
    points, rng = room(np.random.default_rng(3)), np.random.default_rng(4)
    state = true_state(0.0)
    there_m = state.position_m + np.array([0.8, 0.6, 0.0]) * away_m
    state = state._replace(velocity_mps=np.zeros(3), position_m=there_m)
    estimate = InvariantFilter(state, 1e-12 * np.eye(15), SETTINGS, CAMERAS)
    for pair in range(4):
        for k in (2 * pair, 2 * pair + 1):
            estimate.predict_random_walk(np.eye(4), 0.3, 1.5)
            estimate.add_clone(k, np.zeros(3))
        seen = {k: observe(points, 0.0, rng) for k in (2 * pair, 2 * pair + 1)}
        use(estimate, seen, np.arange(len(points)), iterations=4)
        for k in range(2 * pair + 1):
            least, *_, largest = np.linalg.eigvalsh(estimate.motion_since(k)[1])
            assert least > 0.0, (pair, k)
            assert largest < 1e-3 or k < 2 * pair
        for _ in range(unseen_steps):
            estimate.predict_random_walk(np.eye(4), 0.3, 1.5)


def test_threads_may_share_a_filter() -> None:
    """One call at a time: while one thread updates, without Python's lock, another adds clones and removes them."""
    rng = np.random.default_rng(3)
    points = room(rng)
    held, seen = clones_at([0.0, 0.1, 0.2, 0.3], points, rng)
    with ThreadPoolExecutor(1) as pool:
        updated = pool.submit(lambda: [use(held, seen, np.arange(len(points)), iterations=4) for _ in range(20)])
        while not updated.done():
            held.add_clone(100, np.zeros(3))
            assert len(held.covariance) == 16 + 6 * 5
            held.remove_clone(100)
    assert len(updated.result()) == 20
    assert held.clone_ids == [0, 1, 2, 3]
