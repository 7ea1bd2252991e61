"""First-order algebra of pose covariances: rotation first, map axes, about the body. Pure.

A perturbation (6,) rotates a pose from the left and shifts its position, independently of each other: SO(3) x R^3. Sources: Barfoot and
Furgale 2014 for compounding, Hertzberg et al. 2013 for boxplus and boxminus.
"""

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array, se3, se3_inverse, skew, so3_exp, so3_log, turn_both


def boxminus(measured: Array, predicted: Array) -> Array:
    """Return the perturbation (6,) that leads from `predicted` to `measured`. Source: Hertzberg et al. 2013."""
    return np.concatenate([so3_log(measured[:3, :3] @ predicted[:3, :3].T), measured[:3, 3] - predicted[:3, 3]])


def boxplus(map_from_body: Array, rot_trans: Array) -> Array:
    """Return `map_from_body` perturbed by `rot_trans` (6,), the inverse of `boxminus`. Source: Hertzberg et al. 2013."""
    return se3(so3_exp(rot_trans[:3]) @ map_from_body[:3, :3], map_from_body[:3, 3] + rot_trans[3:])


def innovation_of(measured: Array, cov_measured: Array, predicted: Array, covariance: Array) -> tuple[Array, float]:
    """Return the innovation (6,) of a measured pose (4, 4), and its squared Mahalanobis distance."""
    error = boxminus(measured, predicted)
    return error, float(error @ np.linalg.solve(covariance + cov_measured, error))


def kalman_update(map_from_body: Array, covariance: Array, error: Array, cov_measured: Array) -> tuple[Array, Array]:
    """Return a pose and its covariance updated by a measured pose, which is off by `error` (6,). Source: Bucy and Joseph 1968."""
    gain = np.linalg.solve(covariance + cov_measured, covariance).T  # K = P (P + R)^-1
    rest = np.eye(6) - gain
    updated = rest @ covariance @ rest.T + gain @ cov_measured @ gain.T  # (I - K) P (I - K)^T + K R K^T
    return boxplus(map_from_body, gain @ error), updated


def transport_cov(cov_rot_trans: Array, lever_m: Array) -> Array:
    """Return the covariance about a point of the same rigid body at `lever_m` (map axes) from the point of `cov_rot_trans`."""
    adjoint = np.eye(6)
    adjoint[3:, :3] = -skew(lever_m)
    return np.asarray(adjoint @ cov_rot_trans @ adjoint.T)


def bounded_turn(covariance: Array) -> Array:
    """Return the covariance (6, 6) with each rotation sigma limited to pi; it remains positive semidefinite."""
    scale = np.ones(6)
    scale[:3] = np.pi / np.maximum(np.sqrt(np.diag(covariance)[:3]), np.pi)
    return scale[:, None] * covariance * scale


def compose_cov(map_from_body: Array, covariance: Array, body_from_next: Array, cov_step: Array) -> tuple[Array, Array]:
    """Return map_from_next and its covariance. cov_step: of the step, a left perturbation in the body's axes about the body."""
    a, b, c, d = map(np.ascontiguousarray, (map_from_body, covariance, body_from_next, cov_step))
    return core.compose_pose(a, b, c, d)


def compose_end_cov(
    map_from_body: Array, covariance: Array, body_from_next: Array, cov_next: Array
) -> tuple[Array, Array]:
    """As `compose_cov`, with the step's covariance about its end, as for a hypothesis whose map is the body."""
    turn = turn_both(map_from_body[:3, :3])
    lever_m = map_from_body[:3, :3] @ body_from_next[:3, 3]
    return map_from_body @ body_from_next, transport_cov(covariance, lever_m) + turn @ cov_next @ turn.T


def compose_inverse_cov(
    map_from_body: Array, covariance: Array, earlier_from_body: Array, cov_body: Array
) -> tuple[Array, Array]:
    """Return map_from_earlier and its covariance, the inverse of `compose_end_cov`. cov_body: of earlier_from_body, as there."""
    map_from_earlier = map_from_body @ se3_inverse(earlier_from_body)
    turn = turn_both(map_from_earlier[:3, :3])
    lever_m = map_from_earlier[:3, 3] - map_from_body[:3, 3]
    cov_way = turn @ transport_cov(cov_body, -earlier_from_body[:3, 3]) @ turn.T
    return map_from_earlier, transport_cov(covariance, lever_m) + cov_way
