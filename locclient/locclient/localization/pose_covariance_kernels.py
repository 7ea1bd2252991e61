"""Pose covariances that every frame composes, see `pose_covariance`."""

import numpy as np

from fleetmap.geometry import Array
from fleetmap.numerics.kernel import kernel
from fleetmap.numerics.transform_kernels import product, skewed, turned


@kernel
def compose(map_from_body: Array, covariance: Array, body_from_next: Array, cov_step: Array) -> tuple[Array, Array]:
    """As `pose_covariance.compose_cov`."""
    rotation, turn, carry = map_from_body[:3, :3].copy(), np.zeros((6, 6)), np.eye(6)
    turn[:3, :3] = turn[3:, 3:] = rotation
    total = covariance + product(product(turn, cov_step), turn.T)
    carry[3:, :3] = -skewed(turned(rotation, body_from_next[:3, 3]))
    return product(map_from_body, body_from_next), product(product(carry, total), carry.T)
