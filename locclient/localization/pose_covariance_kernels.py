"""Pose covariances that every frame composes, see `pose_covariance`."""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel
from fleetmap.numerics.linear_kernels import matmul, rotate, skew
from fleetmap.numerics.transform_kernels import copy_into


@kernel
def compose(map_from_body: Array, covariance: Array, body_from_next: Array, cov_step: Array) -> tuple[Array, Array]:
    """As `pose_covariance.compose_cov`."""
    rotation, turn, carry = np.empty((3, 3)), np.zeros((6, 6)), np.eye(6)
    copy_into(rotation, map_from_body[:3, :3])
    lever = skew(rotate(rotation, body_from_next[:3, 3]))
    for a in range(3):
        for b in range(3):
            turn[a, b] = turn[3 + a, 3 + b] = rotation[a, b]
            carry[3 + a, b] = -lever[a, b]
    total = matmul(matmul(turn, cov_step), turn.T)
    for a in range(6):
        for b in range(6):
            total[a, b] = covariance[a, b] + total[a, b]
    return matmul(map_from_body, body_from_next), matmul(matmul(carry, total), carry.T)
