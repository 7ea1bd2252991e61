"""What happens to a covariance between images: motion, a new clone, a measurement of a few rows. Symmetric matrices stay so to the bit."""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel
from fleetmap.numerics.linear_kernels import cholesky_in_place, solve_spd


@kernel
def transition(covariance: Array, first: int, state_to_state: Array, noise: Array) -> None:
    """Moves the errors from number `first` on by state_to_state (K, K), and adds noise (K, K); in place."""
    count, size = len(state_to_state), len(covariance)
    carried = np.zeros((count, size))
    for a in range(count):
        row = carried[a]
        for k in range(count):
            factor, old = state_to_state[a, k], covariance[first + k]
            if factor != 0.0:
                for j in range(size):
                    row[j] += factor * old[j]
    for a in range(count):
        for j in range(size):
            covariance[first + a, j] = carried[a, j]
            covariance[j, first + a] = carried[a, j]
    for a in range(count):
        for b in range(a + 1):
            total = noise[a, b]
            for k in range(count):
                total += carried[a, first + k] * state_to_state[b, k]
            covariance[first + a, first + b] = covariance[first + b, first + a] = total


@kernel
def forget(covariance: Array, kept: float, added: Array) -> None:
    """Scales the first K errors by what is kept of them, and adds variances (K,); in place."""
    for k in range(len(added)):
        for j in range(len(covariance)):
            covariance[k, j] *= kept
    for k in range(len(added)):
        for j in range(len(covariance)):
            covariance[j, k] *= kept
        covariance[k, k] += added[k]


@kernel
def with_clone(covariance: Array, first: int, offset: int, by_offset: Array) -> Array:
    """The covariance with six more errors: rotation and position of the state that begins at `first`, as the time offset moves them.

    offset: number of that error; by_offset (6,): derivatives by it. Rotation is the state's first, position its third triple.
    """
    size = len(covariance)
    grown = np.empty((size + 6, size + 6))
    for a in range(size):
        for b in range(size):
            grown[a, b] = covariance[a, b]
    for a in range(6):
        own, shared, factor = covariance[first + a + (3 if a > 2 else 0)], covariance[offset], by_offset[a]
        for j in range(size):
            grown[size + a, j] = grown[j, size + a] = own[j] + factor * shared[j]
    for a in range(6):
        for b in range(a + 1):
            total = grown[size + a, first + b + (3 if b > 2 else 0)] + by_offset[b] * grown[size + a, offset]
            grown[size + a, size + b] = grown[size + b, size + a] = total
    return grown


@kernel
def without_errors(covariance: Array, at: int) -> Array:
    """The covariance less the six errors that begin there."""
    size = len(covariance) - 6
    kept = np.empty((size, size))
    for a in range(size):
        row, old = kept[a], covariance[a if a < at else a + 6]
        for b in range(at):
            row[b] = old[b]
        for b in range(at, size):
            row[b] = old[b + 6]
    return kept


@kernel
def correct(
    covariance: Array,
    true_error_cov: Array,
    whole: Array,
    considered: int,
    residual: Array,
    noise: Array,
    true_noise: Array,
    gate: float,
    correction: Array,
) -> float:
    """Squared Mahalanobis distance of residual (m,) by true_error_cov (n + c, n + c), whose first c errors are considered only.

    Unless it exceeds the gate, both covariances are those after the correction (n,) by covariance (n, n), which is filled in. whole
    (m, c + k): derivatives of the residual by the first errors; noise and true_noise (m, m).
    """
    rows, size, known = len(residual), len(covariance), whole.shape[1] - considered
    projected, cross = np.zeros((rows, size + considered)), np.zeros((rows, size))
    spread, innovation = true_noise.copy(), noise.copy()
    for a in range(rows):
        for k in range(considered + known):
            factor = whole[a, k]
            if factor != 0.0:
                for j in range(size + considered):
                    projected[a, j] += factor * true_error_cov[k, j]
                if k >= considered:
                    for j in range(size):
                        cross[a, j] += factor * covariance[k - considered, j]
    for a in range(rows):
        for b in range(rows):
            for k in range(considered + known):
                spread[a, b] += projected[a, k] * whole[b, k]
            for k in range(known):
                innovation[a, b] += cross[a, k] * whole[b, considered + k]
    solved = residual.copy()
    if not solve_spd(spread.copy(), solved) or not cholesky_in_place(innovation):
        return np.inf
    distance = 0.0
    for a in range(rows):
        distance += residual[a] * solved[a]
    if distance > gate:
        return distance
    for a in range(rows):
        for k in range(a):
            cross[a] -= innovation[a, k] * cross[k]
        cross[a] /= innovation[a, a]
    gain = cross.copy()  # transposed
    for a in range(rows - 1, -1, -1):
        for k in range(a + 1, rows):
            gain[a] -= innovation[k, a] * gain[k]
        gain[a] /= innovation[a, a]
    correction[:] = 0.0
    for a in range(rows):
        correction += residual[a] * gain[a]
        for b in range(rows):
            projected[a, considered:] -= 0.5 * spread[a, b] * gain[b]
    for i in range(size):
        row, true_row = covariance[i], true_error_cov[considered + i]
        for a in range(rows):
            white, share, half = cross[a, i], gain[a, i], projected[a, considered + i]
            for j in range(size):
                row[j] -= white * cross[a, j]
                true_row[considered + j] -= share * projected[a, considered + j] + half * gain[a, j]
            for j in range(considered):
                true_row[j] -= share * projected[a, j]
        for j in range(considered):
            true_error_cov[j, considered + i] = true_row[j]
    return distance
