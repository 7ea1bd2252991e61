"""Covariances between images, against the same in dense matrices."""

import numpy as np
import pytest

from fleetmap.geometry import Array
from fleetmap.odometry.filter.covariance_kernels import correct, transition, with_clone

SIZE, CONSIDERED, ROWS, KNOWN = 28, 4, 4, 15


def definite(rng: np.random.Generator, size: int) -> Array:
    root = rng.normal(size=(size, size))
    return np.asarray(root @ root.T + 0.1 * np.eye(size))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.mark.parametrize("first", [0, CONSIDERED])
def test_a_transition_moves_its_errors_alone(rng: np.random.Generator, first: int) -> None:
    covariance, phi, noise = definite(rng, SIZE), rng.normal(size=(KNOWN, KNOWN)), definite(rng, KNOWN)
    whole = np.eye(SIZE)
    whole[first : first + KNOWN, first : first + KNOWN] = phi
    expected = whole @ covariance @ whole.T
    expected[first : first + KNOWN, first : first + KNOWN] += noise
    transition(covariance, first, phi, noise)
    np.testing.assert_allclose(covariance, expected, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(covariance, covariance.T)


@pytest.mark.parametrize("first", [0, CONSIDERED])
def test_a_clone_is_the_state_moved_by_the_time_offset(rng: np.random.Generator, first: int) -> None:
    covariance, by_offset = definite(rng, SIZE), rng.normal(size=6)
    jacobian = np.zeros((6, SIZE))
    jacobian[:3, first : first + 3] = jacobian[3:, first + 6 : first + 9] = np.eye(3)
    jacobian[:, first + 15] = by_offset
    both = np.vstack([np.eye(SIZE), jacobian])
    grown = with_clone(covariance, first, first + 15, by_offset)
    np.testing.assert_allclose(grown, both @ covariance @ both.T, rtol=1e-10, atol=1e-10)
    np.testing.assert_array_equal(grown, grown.T)


@pytest.mark.parametrize("share", [0.5, 2.0])  # of the distance at the gate
def test_a_correction_is_kalmans_and_what_its_gate_refuses_changes_nothing(
    rng: np.random.Generator, share: float
) -> None:
    covariance, true_error_cov = definite(rng, SIZE), definite(rng, SIZE + CONSIDERED)
    whole, residual = rng.normal(size=(ROWS, CONSIDERED + KNOWN)), rng.normal(size=ROWS)
    noise, true_noise = definite(rng, ROWS), definite(rng, ROWS)
    full = np.hstack([whole, np.zeros((ROWS, SIZE - KNOWN))])
    distance = residual @ np.linalg.solve(full @ true_error_cov @ full.T + true_noise, residual)
    seen = full[:, CONSIDERED:]
    gain = covariance @ seen.T @ np.linalg.inv(seen @ covariance @ seen.T + noise)
    left = np.eye(SIZE + CONSIDERED)
    left[CONSIDERED:] -= gain @ full
    expected = left @ true_error_cov @ left.T
    expected[CONSIDERED:, CONSIDERED:] += gain @ true_noise @ gain.T
    weighed, true_before, correction = covariance - gain @ seen @ covariance, true_error_cov.copy(), np.empty(SIZE)
    before = covariance.copy()
    sizes = whole, CONSIDERED, residual, noise, true_noise
    found = correct(covariance, true_error_cov, *sizes, distance / share, correction)
    assert found == pytest.approx(distance, rel=1e-9)
    if share > 1.0:
        np.testing.assert_array_equal(covariance, before)
        np.testing.assert_array_equal(true_error_cov, true_before)
        return
    np.testing.assert_allclose(correction, gain @ residual, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(covariance, weighed, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(true_error_cov, expected, rtol=1e-8, atol=1e-8)
    np.testing.assert_array_equal(true_error_cov, true_error_cov.T)
