"""Rotations inside numba loops: fixed sizes, results written into arrays of the caller, no allocation.

All matrices are (3, 3) float64, all vectors (3,).
"""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel
from fleetmap.numerics.linear_kernels import skew_series


@kernel
def matmul3(left: Array, right: Array, out: Array) -> None:
    """out = left @ right; `out` must be neither of them."""
    for a in range(3):
        for b in range(3):
            out[a, b] = left[a, 0] * right[0, b] + left[a, 1] * right[1, b] + left[a, 2] * right[2, b]


@kernel
def matmul3_transposed(left: Array, right: Array, out: Array) -> None:
    """out = left.T @ right; `out` must be neither of them."""
    for a in range(3):
        for b in range(3):
            out[a, b] = left[0, a] * right[0, b] + left[1, a] * right[1, b] + left[2, a] * right[2, b]


@kernel
def matvec3(matrix: Array, vector: Array, out: Array) -> None:
    """out = matrix @ vector; `out` must not be `vector`."""
    for a in range(3):
        out[a] = matrix[a, 0] * vector[0] + matrix[a, 1] * vector[1] + matrix[a, 2] * vector[2]


@kernel
def matvec3_transposed(matrix: Array, vector: Array, out: Array) -> None:
    """out = matrix.T @ vector; `out` must not be `vector`."""
    for a in range(3):
        out[a] = matrix[0, a] * vector[0] + matrix[1, a] * vector[1] + matrix[2, a] * vector[2]


@kernel
def matmul3_skew(matrix: Array, vector: Array, out: Array) -> None:
    """out = matrix @ skew(vector); `out` must not be `matrix`."""
    x, y, z = vector[0], vector[1], vector[2]
    for a in range(3):
        out[a, 0] = matrix[a, 1] * z - matrix[a, 2] * y
        out[a, 1] = matrix[a, 2] * x - matrix[a, 0] * z
        out[a, 2] = matrix[a, 0] * y - matrix[a, 1] * x


@kernel
def right_jacobian_into(rotvec_rad: Array, out: Array) -> None:
    """out = J with Exp(r + dr) ~ Exp(r) Exp(J dr). Source: Forster et al. 2017, eq. 8."""
    squared = rotvec_rad[0] ** 2 + rotvec_rad[1] ** 2 + rotvec_rad[2] ** 2
    angle = np.sqrt(squared)
    if angle < 1e-2:
        skew_series(
            rotvec_rad,
            -0.5 + squared / 24.0 - squared**2 / 720.0,
            1.0 / 6.0 - squared / 120.0 + squared**2 / 5040.0,
            out,
        )
    else:
        skew_series(rotvec_rad, -(1.0 - np.cos(angle)) / squared, (angle - np.sin(angle)) / (squared * angle), out)


@kernel
def inverse_left_jacobian_into(rotvec_rad: Array, out: Array) -> None:
    """out = J with Log(Exp(dr) Exp(r)) ~ r + J dr; transposed, the inverse right one. Source: Forster 2017, eq. 9."""
    squared = rotvec_rad[0] ** 2 + rotvec_rad[1] ** 2 + rotvec_rad[2] ** 2
    angle = np.sqrt(squared)
    if angle < 1e-2:
        square = 1.0 / 12.0 + squared / 720.0 + squared**2 / 30240.0
    else:
        square = 1.0 / squared - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    skew_series(rotvec_rad, -0.5, square, out)


@kernel
def log_into(rotation: Array, out: Array) -> None:
    """out = the rotation vector, angle in [0, pi]. Goes through the quaternion (Shepperd 1978), stable near pi."""
    m = rotation
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    if trace > m[0, 0] and trace > m[1, 1] and trace > m[2, 2]:
        w, x, y, z = 1.0 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    elif m[0, 0] > m[1, 1] and m[0, 0] > m[2, 2]:
        w, x = m[2, 1] - m[1, 2], 1.0 + m[0, 0] - m[1, 1] - m[2, 2]
        y, z = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]
    elif m[1, 1] > m[2, 2]:
        w, y = m[0, 2] - m[2, 0], 1.0 - m[0, 0] + m[1, 1] - m[2, 2]
        x, z = m[0, 1] + m[1, 0], m[1, 2] + m[2, 1]
    else:
        w, z = m[1, 0] - m[0, 1], 1.0 - m[0, 0] - m[1, 1] + m[2, 2]
        x, y = m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = np.sqrt(x * x + y * y + z * z)
    scale = 2.0 / w if sine < 1e-9 * w else 2.0 * np.arctan2(sine, w) / sine
    out[0], out[1], out[2] = scale * x, scale * y, scale * z
