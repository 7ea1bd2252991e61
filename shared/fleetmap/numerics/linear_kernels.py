"""Small dense linear algebra for kernels.

numba's own np.linalg and @ need scipy at run time, which a robot does not carry.
"""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel

SMALL_ANGLE_RAD = 1e-4  # below it the series' next term is under 1e-17


@kernel
def matmul(a: Array, b: Array) -> Array:
    """(n, m) product of (n, k) and (k, m); sums are in the order of k."""
    out = np.zeros((a.shape[0], b.shape[1]))
    whole = a.shape[1] // 4 * 4
    for i in range(a.shape[0]):
        row = out[i]
        for k in range(0, whole, 4):  # so that a row is read and written once for four additions
            x0, x1, x2, x3 = a[i, k], a[i, k + 1], a[i, k + 2], a[i, k + 3]
            if x0 != 0.0 or x1 != 0.0 or x2 != 0.0 or x3 != 0.0:
                b0, b1, b2, b3 = b[k], b[k + 1], b[k + 2], b[k + 3]
                for j in range(b.shape[1]):
                    row[j] = row[j] + x0 * b0[j] + x1 * b1[j] + x2 * b2[j] + x3 * b3[j]
        for k in range(whole, a.shape[1]):
            x, last = a[i, k], b[k]
            if x != 0.0:
                for j in range(b.shape[1]):
                    row[j] += x * last[j]
    return out


@kernel
def matmul_nt(a: Array, b: Array) -> Array:
    """(n, m) product of (n, k) and the transpose of (m, k)."""
    return matmul(a, b.T.copy())  # whole rows at once: a sum along a row waits for each of its additions


@kernel
def cholesky_in_place(a: Array) -> bool:
    """Lower factor into the lower triangle of symmetric `a` (n, n); False where it is not positive definite."""
    n = a.shape[0]
    for j in range(n):
        diagonal = a[j, j]
        for k in range(j):
            diagonal -= a[j, k] * a[j, k]
        if not diagonal > 0.0:
            return False
        diagonal = np.sqrt(diagonal)
        a[j, j] = diagonal
        for i in range(j + 1, n):
            total = a[i, j]
            for k in range(j):
                total -= a[i, k] * a[j, k]
            a[i, j] = total / diagonal
    return True


@kernel
def forward_substitute(lower: Array, b: Array) -> None:
    """Solves lower @ x = b in place, b (n,)."""
    for i in range(len(b)):
        total = b[i]
        for k in range(i):
            total -= lower[i, k] * b[k]
        b[i] = total / lower[i, i]


@kernel
def solve_spd(a: Array, b: Array) -> bool:
    """Solves a @ x = b in place for symmetric positive definite `a` (n, n), destroyed; b (n,).

    False where `a` is not definite.
    """
    if not cholesky_in_place(a):
        return False
    forward_substitute(a, b)
    for i in range(len(b) - 1, -1, -1):
        total = b[i]
        for k in range(i + 1, len(b)):
            total -= a[k, i] * b[k]
        b[i] = total / a[i, i]
    return True


@kernel
def skew_series(vector: Array, linear: float, square: float, out: Array) -> None:
    """out = I + linear skew(vector) + square skew(vector)^2."""
    x, y, z = vector[0], vector[1], vector[2]
    out[0, 0] = 1.0 - square * (y * y + z * z)
    out[1, 1] = 1.0 - square * (x * x + z * z)
    out[2, 2] = 1.0 - square * (x * x + y * y)
    out[0, 1] = square * x * y - linear * z
    out[1, 0] = square * x * y + linear * z
    out[0, 2] = square * x * z + linear * y
    out[2, 0] = square * x * z - linear * y
    out[1, 2] = square * y * z - linear * x
    out[2, 1] = square * y * z + linear * x


@kernel
def exp_into(rotvec_rad: Array, out: Array) -> None:
    """out = the rotation of a rotation vector. Source: Rodrigues' formula."""
    squared = rotvec_rad[0] ** 2 + rotvec_rad[1] ** 2 + rotvec_rad[2] ** 2
    angle = np.sqrt(squared)
    if angle < SMALL_ANGLE_RAD:
        skew_series(rotvec_rad, 1.0 - squared / 6.0, 0.5 - squared / 24.0, out)
    else:
        skew_series(rotvec_rad, np.sin(angle) / angle, (1.0 - np.cos(angle)) / squared, out)


@kernel
def exp_so3(rotvec_rad: Array) -> Array:
    """(3, 3) rotation of a rotation vector."""
    out = np.empty((3, 3))
    exp_into(rotvec_rad, out)
    return out


@kernel
def skew(v: Array) -> Array:
    """(3, 3) matrix of the cross product with v (3,)."""
    out = np.zeros((3, 3))
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]
    return out


@kernel
def rotate(rotation: Array, vector: Array) -> Array:
    """(3,) rotation @ vector."""
    out = np.zeros(3)
    for a in range(3):
        for b in range(3):
            out[a] += rotation[a, b] * vector[b]
    return out
