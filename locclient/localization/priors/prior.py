"""A prior of the robot's place: from a dock, an operator, a ride or an earlier pose, in force until the map has confirmed a pose. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import Array, Mask, se3_inverse, so3_log, transform_points
from fleetmap.odometry.estimate import OdometryEstimate
from fleetmap.relocalization.map_view import LookAlikes
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.hypothesis_set import HypothesisSet, Observations
from locclient.localization.place import Place
from locclient.localization.pose_hypothesis import PoseHypothesis
from locclient.localization.settings import TrackSettings

_SIGMA_M = 0.05  # added to any prior, because its moment lies between two frames
_DRIFT_SHARE = 0.2  # of the distance travelled since, also added
_CHI2_999, _BOUND_SIGMAS = 13.816, 3.7  # 0.999 of two dimensions
# Places beyond the bound are not searched, and a similar next aisle may be within: at 0.999 one start in a thousand would choose the wrong
# one. A prior's own error counts up to 0.99999 (23.026); the drift that is added to it is already a generous bound.
_WIDER = 23.026 / _CHI2_999
_PLACE_REACH_M = 3.0  # maximum distance between the robot and a place with the same view


def agrees(prior: PositionPrior, confirmed: Place, base_from_body: Array) -> bool:
    """Return True if a confirmed place lies within the bound of a prior's position and heading."""
    if prior.floor not in (None, confirmed.floor):
        return False
    map_from_base = confirmed.map_from_body @ se3_inverse(base_from_body)
    off_m = map_from_base[:2, 3] - prior.map_from_base[:2, 3]
    covariance = _WIDER * prior.cov_rot_trans + confirmed.cov_rot_trans
    turn_rad = so3_log(prior.map_from_base[:3, :3].T @ map_from_base[:3, :3])[2]
    is_near = off_m @ np.linalg.solve(covariance[3:5, 3:5] + _SIGMA_M**2 * np.eye(2), off_m) < _CHI2_999
    return bool(is_near and abs(turn_rad) < _BOUND_SIGMAS * np.sqrt(covariance[2, 2]))


@dataclass(eq=False)
class Prior:
    """A prior, and the robot's motion since its moment.

    base: place of the base, at the frame of `since`, the origin. hypothesis: the pose of the body by both, published while the map gives
    none; None for priors with an unknown heading. contradictions: places of fixes outside a revisable prior. is_told: True for a prior from
    outside, such as a dock, a zone or an operator; else it is the robot's own estimate by odometry. floors: those on which the robot may
    be, with prior_from_map (4, 4), from each one's map to that of the prior, None for the same map; default: that of the place alone.
    is_ride: the robot may have ridden a lift to any of them. is_measured: as of `PositionPrior`.
    """

    base: Place
    since: PoseHypothesis
    hypothesis: PoseHypothesis | None
    base_from_body: Array
    settings: TrackSettings
    is_revisable: bool
    is_told: bool = False
    is_measured: bool = False
    is_ride: bool = False
    travelled_m: float = 0.0
    floors: Mapping[str, Array | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.floors = self.floors or {self.base.floor: None}
        self.contradictions = HypothesisSet(self.settings)

    @classmethod
    def given(
        cls, told: PositionPrior, odometry: OdometryEstimate, base_from_body: Array, settings: TrackSettings, **how: Any
    ) -> "Prior":
        """Return a prior from outside at a frame. how: arguments of the constructor."""
        base, known = Place(told.map_from_base, told.cov_rot_trans, told.floor or ""), None
        if np.isfinite(told.cov_rot_trans).all():
            known = PoseHypothesis.at(odometry, base.of_point(base_from_body))
        how = {"is_revisable": told.is_revisable, "is_measured": told.is_measured, "is_told": True} | how
        return cls(base, PoseHypothesis.at(odometry), known, base_from_body, settings, **how)

    @property
    def names_floor(self) -> bool:
        """True if the prior says on which floor the robot is, without pictures."""
        return not self.is_ride and len(self.floors) == 1

    def places(self) -> list[Place]:
        """Return the present place by the prior on each of its floors; empty without a heading."""
        if self.hypothesis is None:
            return []
        map_from_body, covariance, found = *self.hypothesis.now[:2], list[Place]()
        for floor, prior_from_map in self.floors.items():
            there = map_from_body if prior_from_map is None else se3_inverse(prior_from_map) @ map_from_body
            found.append(Place(there, covariance, floor))
        return found

    def tracked(self) -> list[PoseHypothesis]:
        return [*filter(None, (self.hypothesis, self.since)), *self.contradictions.hypotheses]

    def is_compatible(self, place: Place) -> bool:
        """Return True if a present place, traced back by the robot's motion, lies within the bound of the prior's position, on one of its
        floors."""
        if place.floor not in self.floors:
            return False
        prior_from_map, then = self.floors[place.floor], place.before(self.since.now)
        map_from_base, cov_m2 = then.map_from_body @ se3_inverse(self.base_from_body), then.cov_rot_trans[3:5, 3:5]
        if prior_from_map is not None:
            map_from_base = prior_from_map @ map_from_base
            cov_m2 = prior_from_map[:2, :2] @ cov_m2 @ prior_from_map[:2, :2].T
        off_m = map_from_base[:2, 3] - self.base.position_m[:2]
        return bool(off_m @ np.linalg.solve(self._cov_m2(_WIDER) + cov_m2, off_m) < _CHI2_999)

    def is_contradicted(self, observations: Observations, lookalikes: LookAlikes | None) -> bool:
        """Return True if the fixes of a query, none within the prior, and earlier ones outweigh it.

        It weighs as much as the confirmation of a pose: more fixes than that must agree, over as much distance, on one place without
        competitors or similar unmapped places. Repeated looks of a standing robot add no evidence.
        """
        found = self.contradictions
        found.lookalikes = lookalikes
        found.observe(observations, None)
        order, competitors = found.ranking()
        if not order or competitors:
            return False
        has_more = order[0].support > self.settings.confirming_fixes
        is_telling = not self.is_told and order[0].speaks_against_others(self.settings)  # as against a confirmed pose
        return has_more and (is_telling or found.is_supported(order[0])) and not found.may_be_lookalike(order[0])

    def is_near(self, positions_map: Array, floor: str = "") -> Mask:
        """Return flags (N,) of the positions (N, 3) on one of the prior's floors from which the robot may have its present view."""
        prior_from_map = self.floors[floor]
        if prior_from_map is not None:
            positions_map = transform_points(prior_from_map, positions_map)
        off_m = np.linalg.norm(positions_map[:, :2] - self.base.position_m[:2], axis=1)
        return np.asarray(off_m < _BOUND_SIGMAS * self._sigma_m(_WIDER) + self.travelled_m + _PLACE_REACH_M)

    def weighed(self, observations: Observations) -> Observations:
        """Return the fixes of a query, each weighted by an operator's prior: 0 for places outside it. Exact sources exclude other places
        instead."""
        for _, hypothesis in observations if self.is_revisable and self.is_told else ():
            if self.is_compatible(hypothesis.now):
                share = self.settings.wrong_prior_share
                hypothesis.told_log_odds = float(np.log1p(-share) - np.log(share))
        return observations

    def confirms(self, hypothesis: PoseHypothesis) -> bool:
        """Return True if the prior is told and so tight that one fix within it confirms a pose; an operator's, only at its own place."""
        is_named = self.names_floor and (not self.is_revisable or hypothesis.told_log_odds > 0.0)
        return self.is_told and is_named and self.is_tight(self.settings.tight_prior_sigma_m)

    def known_pose(self, radius_m: float) -> PoseHypothesis | None:
        """Return the pose by an exact source and the motion since, while its 95 % radius is at most `radius_m`; else None."""
        known = self.hypothesis if self.is_told and not self.is_revisable and self.names_floor else None
        return known if known is not None and radius_95_m(known.now.cov_rot_trans) <= radius_m else None

    def is_tight(self, sigma_m: float) -> bool:
        """Return True if the present horizontal sigma is at most `sigma_m`."""
        return self._sigma_m() <= sigma_m

    def _sigma_m(self, scale: float = 1.0) -> float:
        return float(np.sqrt(np.linalg.eigvalsh(self._cov_m2(scale))[-1]))

    def _cov_m2(self, scale: float = 1.0) -> Array:
        """Return the covariance (2, 2) of the horizontal position, the prior's own part times `scale`. It grows with the distance
        travelled, so that unmodelled drift, a push or an operator's error do not prevent localization forever."""
        added = _SIGMA_M**2 + (_DRIFT_SHARE * self.travelled_m) ** 2
        return np.asarray(scale * self.base.cov_rot_trans[3:5, 3:5] + added * np.eye(2))
