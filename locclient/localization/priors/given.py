"""Prior source of what others tell a robot: docks, zones, an operator, a fleet manager. Pure."""

from collections.abc import Mapping
from dataclasses import replace

from fleetmap.geometry import Array
from fleetmap.sensors.samples import PositionPrior
from locclient.localization.percept import Percept
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
        if given is None or (given.floor and not tracker.maps.knows(given.floor)):
            return None
        confirmed, before = tracker.confirmed, tracker.prior
        if given.is_revisable and confirmed is not None:
            if agrees(given, confirmed.now, tracker.base_from_body):
                return None
            tracker.forget()
            confirmed = before = None
        floors: Mapping[str, Array | None] | None = None
        is_open = not given.is_revisable or (before is not None and not before.names_floor)
        building = tracker.maps.plan_from_map
        if given.floor is None and confirmed is None and is_open and len(building) > 1:
            floors = dict.fromkeys(sorted(building))
        given = replace(given, floor=tracker.floor if given.floor is None else given.floor)
        how = {"travelled_m": tracker.step_m, "floors": floors}  # it was given between the last two frames
        return Prior.given(given, percept.odometry, tracker.base_from_body, tracker.settings, **how)
