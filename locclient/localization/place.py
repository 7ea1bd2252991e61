"""Where a robot is: a pose with its covariance, in the map of one floor. Pure."""

from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array
from locclient.localization.pose_covariance import compose_cov, compose_end_cov, transport_cov


class Place(NamedTuple):
    """Pose of the body, map_from_body (4, 4), with cov_rot_trans (6, 6; map axes, rotation first, about the body).

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
        """Return the place after a step, by `compose_cov`."""
        return Place(*compose_cov(self.map_from_body, self.cov_rot_trans, body_from_next, cov_step), self.floor)

    def at_end_of(self, way: "Place") -> "Place":
        """Return the place after a way from here, by `compose_end_cov`."""
        end = compose_end_cov(self.map_from_body, self.cov_rot_trans, way.map_from_body, way.cov_rot_trans)
        return Place(*end, self.floor)

    def of_point(self, body_from_point: Array) -> "Place":
        """Return the place of another frame of the same rigid body."""
        map_from_point = self.map_from_body @ body_from_point
        lever_m = map_from_point[:3, 3] - self.map_from_body[:3, 3]
        return Place(map_from_point, transport_cov(self.cov_rot_trans, lever_m), self.floor)


ORIGIN = Place(np.eye(4), np.zeros((6, 6)))  # of motions from a frame on
