"""Products of small matrices and rigid transforms, rounded as numpy's `@` rounds them: each addition together with its product.

So what was computed with numpy between kernels moves into them without a change of one bit.
"""

import math
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel


def _fused(_context: Any, _a: Any, _b: Any, _c: Any) -> tuple[Any, Any]:
    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, arguments: Any) -> ir.Value:
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


multiply_add = cast(Callable[[float, float, float], float], intrinsic(_fused))  # a * b + c, rounded once


@kernel
def product(a: Array, b: Array) -> Array:
    """(n, m) a @ b of (n, k) and (k, m)."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] = multiply_add(a[i, k], b[k, j], out[i, j])
    return out


@kernel
def turned(rotation: Array, vector: Array) -> Array:
    """(3,) rotation @ vector, where the rotation's rows are in order in memory."""
    out = np.empty(3)
    for i in range(3):
        out[i] = multiply_add(rotation[i, 0], vector[0], rotation[i, 1] * vector[1])
        out[i] = multiply_add(rotation[i, 2], vector[2], out[i])
    return out


@kernel
def skewed(v: Array) -> Array:
    """As `geometry.skew`."""
    out = np.zeros((3, 3))
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]
    return out


@kernel
def rotation_of(rotvec: Array) -> Array:
    """As `geometry.so3_exp`."""
    angle = math.sqrt(rotvec[0] * rotvec[0] + rotvec[1] * rotvec[1] + rotvec[2] * rotvec[2])
    cross, scaled = skewed(rotvec), np.empty((3, 3))
    linear, square = 1.0, 0.5
    if angle >= 1e-6:
        linear, square = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    for i in range(3):
        for j in range(3):
            scaled[i, j] = square * cross[i, j]
    out = product(scaled, cross)
    for i in range(3):
        for j in range(3):
            out[i, j] = ((1.0 if i == j else 0.0) + linear * cross[i, j]) + out[i, j]
    return out


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
    lower = product(skewed(target_from_source[:3, 3]), rotation)
    for a in range(3):
        for b in range(3):
            out[a, b] = out[3 + a, 3 + b] = rotation[a, b]
            out[3 + a, b] = lower[a, b]
    return out


@kernel
def earlier_from_later(rotations: Array, positions: Array, earlier: int, later: int) -> Array:
    """(4, 4) between two of N bodies in one frame, rotations (N, 3, 3) and positions (N, 3)."""
    there = transform_of(rotations[later], positions[later])
    return product(inverse(rotations[earlier], positions[earlier]), there)


@kernel
def angle_between_rad(first: Array, second: Array) -> float:
    """Angle of the rotation between two transforms (4, 4), or two rotations."""
    between = product(first[:3, :3].T, second[:3, :3])
    x, y, z = between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]
    trace = between[0, 0] + between[1, 1] + between[2, 2]
    return math.atan2(math.sqrt(x * x + y * y + z * z), trace - 1.0)


@kernel
def distance_between(first: Array, second: Array) -> float:
    """Length of the translation of first @ inverse of second, both (4, 4)."""
    off = turned(product(first[:3, :3], second[:3, :3].T), second[:3, 3])
    for a in range(3):
        off[a] = first[a, 3] - off[a]
    return math.sqrt(off[0] * off[0] + off[1] * off[1] + off[2] * off[2])
