"""Where a robot is: a pose in the map of one floor, and first-order algebra of its covariance. Pure.

Covariances are rotation first, in map axes, about the body. A perturbation (6,) rotates a pose from the left and shifts its position,
independently of each other: SO(3) x R^3. Sources: Barfoot and Furgale 2014 for compounding, Hertzberg et al. 2013 for boxplus and boxminus.
"""

from typing import NamedTuple

import numpy as np

from fleetmap import core
from fleetmap.geometry import Array, se3, se3_inverse, so3_exp, so3_log, transport_cov, turn_both


def boxminus(measured: Array, predicted: Array) -> Array:
    """Return the perturbation (6,) that leads from `predicted` to `measured`. Source: Hertzberg et al. 2013."""
    return np.concatenate([so3_log(measured[:3, :3] @ predicted[:3, :3].T), measured[:3, 3] - predicted[:3, 3]])


def boxplus(map_from_body: Array, rot_trans: Array) -> Array:
    """Return `map_from_body` perturbed by `rot_trans` (6,), the inverse of `boxminus`. Source: Hertzberg et al. 2013."""
    return se3(so3_exp(rot_trans[:3]) @ map_from_body[:3, :3], map_from_body[:3, 3] + rot_trans[3:])


def bounded_turn(covariance: Array) -> Array:
    """Return the covariance (6, 6) with each rotation sigma limited to pi; it remains positive semidefinite."""
    scale = np.ones(6)
    scale[:3] = np.pi / np.maximum(np.sqrt(np.diag(covariance)[:3]), np.pi)
    return scale[:, None] * covariance * scale


class Place(NamedTuple):
    """Pose of the body, map_from_body (4, 4), with cov_rot_trans (6, 6).

    floor: the site whose map it is in, of the robot's building; empty for the robot's own.
    """

    map_from_body: Array
    cov_rot_trans: Array
    floor: str = ""

    @property
    def is_finite(self) -> bool:
        return bool(np.isfinite(self.cov_rot_trans).all() and np.isfinite(self.map_from_body).all())

    def shares_map(self, other: "Place") -> bool:
        return self.floor == other.floor

    @property
    def position_m(self) -> Array:
        """Return (3,), in the map."""
        return self.map_from_body[:3, 3]

    def moved(self, body_from_next: Array, cov_step: Array) -> "Place":
        """Return the place after a step. cov_step: a left perturbation in the body's axes about the body."""
        step = map(np.ascontiguousarray, (*self[:2], body_from_next, cov_step))
        return Place(*core.compose_pose(*step), self.floor)

    def at_end_of(self, way: "Place") -> "Place":
        """As `moved`, with the covariance of the way about its end, as for a hypothesis whose map is the body."""
        turn = turn_both(self.map_from_body[:3, :3])
        lever_m = self.map_from_body[:3, :3] @ way.position_m
        covariance = transport_cov(self.cov_rot_trans, lever_m) + turn @ way.cov_rot_trans @ turn.T
        return Place(self.map_from_body @ way[0], covariance, self.floor)

    def before(self, way: "Place") -> "Place":
        """Return the place from which the way led here, the inverse of `at_end_of`."""
        map_from_earlier = self.map_from_body @ se3_inverse(way.map_from_body)
        turn = turn_both(map_from_earlier[:3, :3])
        cov_way = turn @ transport_cov(way.cov_rot_trans, -way.position_m) @ turn.T
        lever_m = map_from_earlier[:3, 3] - self.position_m
        return Place(map_from_earlier, transport_cov(self.cov_rot_trans, lever_m) + cov_way, self.floor)

    def of_point(self, body_from_point: Array) -> "Place":
        """Return the place of another frame of the same rigid body."""
        map_from_point = self.map_from_body @ body_from_point
        lever_m = map_from_point[:3, 3] - self.position_m
        return Place(map_from_point, transport_cov(self.cov_rot_trans, lever_m), self.floor)

    def innovation_of(self, measured: "Place") -> tuple[Array, float]:
        """Return the innovation (6,) of a measured place, and its squared Mahalanobis distance."""
        error = boxminus(measured.map_from_body, self.map_from_body)
        return error, float(error @ np.linalg.solve(self.cov_rot_trans + measured.cov_rot_trans, error))

    def updated(self, measured: "Place") -> "Place":
        """Return the place updated by a measured one. Source: Bucy and Joseph 1968."""
        gain = np.linalg.solve(self.cov_rot_trans + measured.cov_rot_trans, self.cov_rot_trans).T  # K = P (P + R)^-1
        rest = np.eye(6) - gain
        covariance = rest @ self.cov_rot_trans @ rest.T + gain @ measured.cov_rot_trans @ gain.T
        error = boxminus(measured.map_from_body, self.map_from_body)
        return Place(boxplus(self.map_from_body, gain @ error), covariance, self.floor)


ORIGIN = Place(np.eye(4), np.zeros((6, 6)))  # of motions from a frame on
