"""What a robot was told of its place, until the map has confirmed one. Pure."""

import numpy as np
from numpy.typing import NDArray

from fleetmap.geometry import Array, se3_inverse
from fleetmap.odometry import Odometry, OdometryEstimate
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.pose_hypothesis import PoseHypothesis, led_back, moved
from locclient.localization.settings import TrackSettings

_OWN_M = 0.05  # by which any prior is doubted: it speaks of a moment between two frames
_WAY_SHARE = 0.2  # of the way since, by which it is doubted
_BOUND, _BOUND_SIGMAS = 13.816, 3.7  # 0.999 of two dimensions
_PLACE_REACH_M = 3.0  # from a place that shows the same as the robot sees


class InitialPosePrior:
    """A prior, and the robot's way since its moment.

    place: where the robot is by both, a place of its own as long as the map knows none; None for priors that leave a direction open.
    """

    def __init__(self, prior: PositionPrior, base_from_body: Array) -> None:
        self._prior, self._base_from_body = prior, base_from_body
        self._way_m = 0.0
        self._since: PoseHypothesis | None = None  # the first frame after it, as the identity
        self.place: PoseHypothesis | None = None

    def follow(self, tracker: Odometry, odometry: OdometryEstimate, step: Array, settings: TrackSettings) -> None:
        """To the present frame, by `step` (4, 4) from the last one. The place, an anchor like others, is carried with those."""
        self._way_m += float(np.linalg.norm(step[:3, 3]))
        if self._since is not None:
            self._since.carry(tracker, odometry, step, settings)
            return
        self._since = PoseHypothesis.at(odometry, np.eye(4), np.zeros((6, 6)))
        if np.isfinite(self._prior.cov_rot_trans).all():
            map_from_body = self._prior.map_from_base @ self._base_from_body
            lever_m = map_from_body[:3, 3] - self._prior.map_from_base[:3, 3]
            self.place = PoseHypothesis.at(odometry, map_from_body, moved(self._prior.cov_rot_trans, lever_m))

    def allows(self, place: PoseHypothesis) -> bool:
        """Whether the robot's way leads back from a place of the present to within the 0.999 bound of the prior's position."""
        if self._since is None:
            return True
        way, cov_way = self._since.now_map_from_body, self._since.now_cov
        map_from_then, covariance = led_back(place.now_map_from_body, place.now_cov, way, cov_way)
        map_from_base = map_from_then @ se3_inverse(self._base_from_body)
        off_m = map_from_base[:2, 3] - self._prior.map_from_base[:2, 3]
        return bool(off_m @ np.linalg.solve(self._cov_m2() + covariance[3:5, 3:5], off_m) < _BOUND)

    def is_near(self, positions_map: Array) -> NDArray[np.bool_]:
        """(N,) which positions (N, 3) may show what a robot sees now that was where the prior says."""
        off_m = np.linalg.norm(positions_map[:, :2] - self._prior.map_from_base[:2, 3], axis=1)
        return np.asarray(off_m < _BOUND_SIGMAS * self._sigma_m() + self._way_m + _PLACE_REACH_M)

    def is_tight(self, sigma_m: float) -> bool:
        """Whether it is known at least so well, now."""
        return self._sigma_m() <= sigma_m

    def _sigma_m(self) -> float:
        return float(np.sqrt(np.linalg.eigvalsh(self._cov_m2())[-1]))

    def _cov_m2(self) -> Array:
        """(2, 2) of the prior's horizontal position, wider with the way since: what odometry does not know of itself, a robot that was
        pushed and an operator who was wrong must not keep it from its place for ever."""
        wider = _OWN_M**2 + (_WAY_SHARE * self._way_m) ** 2
        return np.asarray(self._prior.cov_rot_trans[3:5, 3:5] + wider * np.eye(2))
