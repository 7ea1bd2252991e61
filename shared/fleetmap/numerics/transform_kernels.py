"""Rigid transforms inside kernels: (4, 4) matrices, or a rotation (3, 3) and a position (3,)."""

import math

import numpy as np

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel
from fleetmap.numerics.linear_kernels import matmul, rotate, skew


@kernel
def copy_into(out: Array, values: Array) -> None:
    """Fills out (n, m) with values (n, m); assigned as slices, they would take a hundred times the memory of this loop."""
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            out[i, j] = values[i, j]


@kernel
def transform_of(rotation: Array, position: Array) -> Array:
    """As `geometry.se3`."""
    out = np.eye(4)
    copy_into(out, rotation)
    for a in range(3):
        out[a, 3] = position[a]
    return out


@kernel
def inverse(rotation: Array, position: Array) -> Array:
    """(4, 4) inverse of the transform of a rotation (3, 3) and a position (3,)."""
    out = np.eye(4)
    for i in range(3):
        for k in range(3):
            out[i, k] = rotation[k, i]
        out[i, 3] = -(rotation[0, i] * position[0] + rotation[1, i] * position[1] + rotation[2, i] * position[2])
    return out


@kernel
def adjoint(target_from_source: Array) -> Array:
    """As `geometry.se3_adjoint`."""
    rotation, out = target_from_source[:3, :3], np.zeros((6, 6))
    lower = matmul(skew(target_from_source[:3, 3]), rotation)
    for a in range(3):
        for b in range(3):
            out[a, b] = out[3 + a, 3 + b] = rotation[a, b]
            out[3 + a, b] = lower[a, b]
    return out


@kernel
def earlier_from_later(rotations: Array, positions: Array, earlier: int, later: int) -> Array:
    """(4, 4) between two of N bodies in one frame, rotations (N, 3, 3) and positions (N, 3)."""
    there = transform_of(rotations[later], positions[later])
    return matmul(inverse(rotations[earlier], positions[earlier]), there)


@kernel
def angle_between_rad(first: Array, second: Array) -> float:
    """Angle of the rotation between two transforms (4, 4), or two rotations."""
    between = matmul(first[:3, :3].T, second[:3, :3])
    x, y, z = between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]
    trace = between[0, 0] + between[1, 1] + between[2, 2]
    return math.atan2(math.sqrt(x * x + y * y + z * z), trace - 1.0)


@kernel
def distance_between(first: Array, second: Array) -> float:
    """Length of the translation of first @ inverse of second, both (4, 4)."""
    off = rotate(matmul(first[:3, :3], second[:3, :3].T), second[:3, 3])
    for a in range(3):
        off[a] = first[a, 3] - off[a]
    return math.sqrt(off[0] * off[0] + off[1] * off[1] + off[2] * off[2])
