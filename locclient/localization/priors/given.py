"""Prior source of what others tell a robot: docks, zones, a fleet manager, an operator by the server or an option. Pure."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fleetmap.errors import LinkError, UsageError
from fleetmap.geometry import Array, se3, so3_exp
from fleetmap.messages import InitialPoseMessage
from fleetmap.sensors.samples import UNSAID_SIGMAS, PositionPrior
from locclient.localization.perception import Percept
from locclient.localization.pose_tracker import PoseTracker
from locclient.localization.priors.prior import Prior, agrees


class GivenPrior:
    """The last prior given since the frame before, in force from the next frame on.

    An operator's replaces a confirmed pose that it contradicts, until fixes outweigh it; an exact one, such as a dock's, waits until no
    pose is confirmed. Without a floor, an operator's is of the floor that the robot was on; a dock's, while that is not known, and any
    after a ride, is of any.
    """

    def __init__(self, tracker: PoseTracker) -> None:
        self._tracker = tracker
        self.waiting: PositionPrior | None = None

    def prior(self, percept: Percept) -> Prior | None:
        """Return the given prior at the present frame; None for one of a floor that the building had a moment ago."""
        given, tracker, self.waiting = self.waiting, self._tracker, None
        maps = tracker.maps
        if given is None or (given.floor and given.floor not in maps.plan_from_map.keys() | maps.by_floor.keys()):
            return None
        confirmed, before = tracker.confirmed, tracker.prior
        if given.is_revisable and confirmed is not None:
            if agrees(given, confirmed.now, tracker.base_from_body):
                return None
            tracker.forget()
            confirmed = before = None
        floors: Mapping[str, Array | None] = {}
        is_open = not given.is_revisable or (before is not None and not before.names_floor)
        building = maps.plan_from_map
        if given.floor is None and confirmed is None and is_open and len(building) > 1:
            floors = dict.fromkeys(sorted(building))
        given = replace(given, floor=tracker.floor if given.floor is None else given.floor)
        how = {"travelled_m": tracker.step_m, "floors": floors}  # it was given between the last two frames
        return Prior.given(given, percept.odometry, tracker.base_from_body, tracker.settings, **how)


def parse_prior(text: str | None, name: str = "prior") -> PositionPrior | None:
    """Parse a prior of the base in `map`, with unconstrained heading; None for None; UsageError for invalid text."""
    if text is None:
        return None
    try:
        x_m, y_m, yaw_rad, sigma_m = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UsageError(f"{name} {text!r} is not X,Y,YAW,SIGMA_M: four numbers, metres and radians") from error
    if not np.isfinite([x_m, y_m, yaw_rad, sigma_m]).all() or not sigma_m > 0:
        raise UsageError(f"{name} {text!r}: all four must be finite numbers and SIGMA_M positive metres")
    covariance = np.diag([np.inf, np.inf, np.inf, sigma_m**2, sigma_m**2, np.inf])
    return PositionPrior(0, se3(so3_exp(np.array([0.0, 0.0, yaw_rad])), np.array([x_m, y_m, 0.0])), covariance)


def told_prior(told: InitialPoseMessage) -> PositionPrior:
    """Return an operator's pose, on the robot's own site, as a prior that overrides the tracked pose until fixes outweigh it.

    LinkError for an invalid one.
    """
    values = [told.x_map_m, told.y_map_m, told.heading_rad or 0.0, told.sigma_m]
    if not np.isfinite(values).all() or not told.sigma_m >= 1e-3:  # nobody knows a place better than to a millimetre
        raise LinkError(f"invalid initial pose: {values[:2]} m, heading {told.heading_rad} rad, sigma {told.sigma_m} m")
    sigmas = UNSAID_SIGMAS.copy()
    sigmas[3:5] = told.sigma_m
    if told.heading_rad is None:
        sigmas[2] = np.inf
    map_from_base = se3(so3_exp(np.array([0.0, 0.0, told.heading_rad or 0.0])), np.array([*values[:2], 0.0]))
    return PositionPrior(0, map_from_base, np.diag(sigmas**2), True, "")
