"""Prior source of a robot in a lift, and of one that is carried elsewhere: the building's floors to which the measured rise leads. Pure."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array, se3_inverse
from fleetmap.mapformat.building import Floor
from fleetmap.odometry.estimate import OdometryEstimate
from locclient.localization.perception import Percept
from locclient.localization.place import Place
from locclient.localization.pose_hypothesis import PoseHypothesis
from locclient.localization.pose_tracker import PoseTracker
from locclient.localization.priors.prior import Prior
from locclient.localization.priors.ride_gauge import Ride, RideGauge

_HEIGHT_SIGMA_M = 0.15  # of the recorded heights of floors
_BOUND_SIGMAS = 4.42  # 0.99999 of a normal distribution
_LIFT_SIGMAS = 3.7  # of a position that may lie in a lift: 0.999 of two dimensions
_SHORTEST_RIDE_S = 3.0  # for one storey
_CARRIED_M = 1.0  # outside of lifts: floors are farther apart, and no ramp rises while wheels rest
_PLAN_SIGMA_M = 0.3  # of one floor's map above another one's


class LiftVisit(NamedTuple):
    """A stay in one of `lifts` since it was entered on a floor, or since its place was confirmed there.

    is_ride: it has ridden, or may have, and its floor is open, also outside of the lift (is_inside: False). is_doubted: something lifted
    the robot.
    """

    lifts: frozenset[str]
    floor: str
    since_ns: int
    is_ride: bool = False
    is_doubted: bool = False
    is_inside: bool = True


def floors_after(floors: Mapping[str, Floor], visit: LiftVisit, ride: Ride) -> dict[str, Array | None]:
    """Return the floors of the lift where the robot may be, with from_map (4, 4), from each one's map along the floor to that where it
    entered; None for the same. All of the lift's while it moves and if the rise is unknown; all of the building if it leads to none of
    those: a lift may be in the map of some floors only."""
    served = {key: floor for key, floor in floors.items() if not visit.lifts.isdisjoint(floor.lifts)}
    entered = floors[visit.floor]
    if not ride.is_moving and not (visit.is_doubted and not visit.is_ride) and np.isfinite(ride.sigma_m):
        bound_m = _BOUND_SIGMAS * float(np.hypot(ride.sigma_m, _HEIGHT_SIGMA_M))
        rises_m = {key: floor.entry.height_m - entered.entry.height_m for key, floor in served.items()}
        reached = {key: floor for key, floor in served.items() if abs(rises_m[key] - ride.rise_m) <= bound_m}
        served = reached or dict(floors)
    map_from_building = se3_inverse(entered.frame.building_from_map)
    return {
        key: None if key == visit.floor else map_from_building @ floor.frame.building_from_map
        for key, floor in served.items()
    }


class LiftRide:
    """Follows a robot into lifts and out of them. After a ride it may be on those floors of the lift to which the measured rise leads; on
    all of them if that is not known.

    is_riding: no place may be confirmed now.
    """

    def __init__(self, tracker: PoseTracker, gauge: RideGauge) -> None:
        self._tracker, self._gauge = tracker, gauge
        self.building: Mapping[str, Floor] = {}
        self._visit: LiftVisit | None = None
        self.is_riding = False

    def use(self, building: Mapping[str, Floor]) -> None:
        """Use these floors; a ride by those before ends."""
        self.building, self._visit, self.is_riding = building, None, False

    @property
    def is_inside(self) -> bool:
        return self._visit is not None and self._visit.is_inside

    def doubts(self) -> bool:
        """Return True if it was a lift that lifted the robot: the gauge knows how far, or nobody does."""
        if self._visit is not None and self._visit.is_inside:
            self._visit = self._visit._replace(is_doubted=True)
        return self.is_inside

    def prior(self, percept: Percept) -> Prior | None:
        """Return the floors where the robot may be, once a ride begins; later they are those of the tracker's prior."""
        ride, tracker, visit = percept.ride, self._tracker, self._visit
        if ride is None:
            return None
        confirmed, prior = tracker.confirmed, tracker.prior
        ridden = prior if prior is not None and prior.is_ride else None
        places = [confirmed.now] if confirmed is not None else [] if prior is None else prior.places()
        lifts = frozenset[str]().union(*map(self._lifts_at, places))
        self.is_riding = ride.is_moving and (bool(lifts) or confirmed is None)
        if not lifts:
            self._visit = visit._replace(is_inside=False) if ridden is not None and visit is not None else None
            self._follow_outside(ride, ridden)
            return None
        # Until pictures have told the floor, the rises of all rides add up, also of a robot that has been outside between them.
        if visit is not None and (ridden is not None or not (visit.is_ride or visit.lifts.isdisjoint(lifts))):
            visit = visit._replace(lifts=visit.lifts | lifts, is_inside=True)
        else:
            self._gauge.reset()  # it stands on a known floor, or came in without one
            ride = ride._replace(rise_m=0.0, sigma_m=ride.sigma_m if np.isinf(ride.sigma_m) else 0.0)
            visit = LiftVisit(lifts, places[0].floor, percept.odometry.stamp_ns)
        stays_s = min(ride.rest_s, (percept.odometry.stamp_ns - visit.since_ns) * 1e-9)
        floors = floors_after(self.building, visit, ride)
        may_have_ridden = floors.keys() != {visit.floor} and (visit.is_doubted or stays_s >= _SHORTEST_RIDE_S)
        begins = ridden is None and (ride.is_moving or may_have_ridden)
        self._visit = visit._replace(is_ride=True) if begins else visit
        if begins:
            return self._after_ride(percept.odometry, floors)
        if ridden is not None and ridden.floors.keys() != floors.keys():
            tracker.move_prior(floors)
        return None

    def _after_ride(self, odometry: OdometryEstimate, floors: Mapping[str, Array | None]) -> Prior | None:
        """Return the confirmed place as one on any of these floors; without one, forget what was seen before the ride."""
        confirmed = self._tracker.confirmed
        if confirmed is None or not confirmed.now.is_finite:
            self._tracker.forget(is_carried=confirmed is not None)
            return None
        place = confirmed.now
        covariance = place.cov_rot_trans + np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 0.0]) * _PLAN_SIGMA_M**2
        known = PoseHypothesis.at(odometry, place._replace(cov_rot_trans=covariance))
        return self._tracker.prior_at(known, is_revisable=True, is_ride=True, floors=floors)

    def _follow_outside(self, ride: Ride, ridden: Prior | None) -> None:
        """Follow a robot outside of every known lift, or without a place."""
        tracker = self._tracker
        if ridden is not None:
            if ride.is_moving:  # in a lift that is in no map
                tracker.forget()
        elif self.is_riding:
            tracker.candidates.reset()
        elif ride.is_cut or abs(ride.rise_m) > max(_CARRIED_M, _LIFT_SIGMAS * ride.sigma_m):
            tracker.forget(is_carried=True)  # by a lift that is in no map, or a fork
            self._gauge.reset()
        elif not ride.rest_s:
            self._gauge.reset()

    def _lifts_at(self, place: Place) -> frozenset[str]:
        """Return the lifts in which the robot may stand, by a place's covariance."""
        floor = self.building.get(place.floor)
        if floor is None or not floor.lifts or not np.isfinite(place.cov_rot_trans).all():
            return frozenset()
        reach_m = _LIFT_SIGMAS * float(np.sqrt(np.linalg.eigvalsh(place.cov_rot_trans[3:5, 3:5])[-1]))
        return floor.lifts_at((place.map_from_body @ se3_inverse(self._tracker.base_from_body))[:2, 3], reach_m)
