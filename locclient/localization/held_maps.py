"""The maps in which a robot is localized: its own site's, and those of the other floors of its building. Pure."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fleetmap.geometry import Array
from fleetmap.mapformat.building import Floor
from fleetmap.mapformat.map_errors import UNKNOWN_ERRORS, MapErrors
from fleetmap.relocalization.map_view import ALIAS_STEP_M, LookAlikes
from fleetmap.relocalization.relocalizer import Relocalizer
from locclient.localization.place import Place

UNKNOWN_COV = np.diag(UNKNOWN_ERRORS.sigmas(np.zeros(3)) ** 2)


class HeldMap(NamedTuple):
    """A version of one floor's map: a relocalizer for each camera of the rig. The others: see `Localizer.handle_version`."""

    version: int
    relocalizers: tuple[Relocalizer, ...]
    lookalikes: LookAlikes | None = None
    alias_step_m: float = ALIAS_STEP_M
    errors: MapErrors = UNKNOWN_ERRORS


class HeldMaps:
    """Maps by their floors' sites, "" for the robot's own, whose map it may hold without a building.

    plan_from_map (4, 4): of each floor of the building, with the same coordinates for places one above the other, and z of its map.
    """

    def __init__(self) -> None:
        self.by_floor: dict[str, HeldMap] = {}
        self.plan_from_map: Mapping[str, Array] = {}

    def use_building(self, building: Mapping[str, Floor]) -> None:
        """Drop the maps of floors that are none of this building, besides the robot's own."""
        self.plan_from_map = {site: floor.frame.building_from_map for site, floor in building.items()}
        self.by_floor = {site: held for site, held in self.by_floor.items() if not site or site in building}

    @property
    def missing(self) -> set[str]:
        """Return the floors whose maps the robot does not hold."""
        return self.plan_from_map.keys() - self.by_floor.keys()

    def version_on(self, floor: str) -> int | None:
        held = self.by_floor.get(floor)
        return None if held is None else held.version

    def map_cov(self, place: Place) -> Array:
        """Return the covariance (6, 6) of the map's own error at a place, rotation first, in map axes."""
        held = self.by_floor.get(place.floor)
        return np.diag((UNKNOWN_ERRORS if held is None else held.errors).sigmas(place.position_m) ** 2)

    def with_error(self, place: Place, earlier: Place | None = None, most: Array | float = np.inf) -> Place:
        """Return a place by the map with the map's own error there, or at an earlier place if that one is larger; at most (6, 6)."""
        of_map = self.map_cov(place) if earlier is None else np.maximum(self.map_cov(place), self.map_cov(earlier))
        return place._replace(cov_rot_trans=place.cov_rot_trans + np.minimum(of_map, most))

    @property
    def lookalikes(self) -> LookAlikes | None:
        """Return those of all maps together, since a fix may be in any of them."""
        known = [held.lookalikes for held in self.by_floor.values() if held.lookalikes is not None]
        if not known:
            return None
        share = max(each.max_wrong_share for each in known) if len(known) == len(self.by_floor) else 1.0
        return LookAlikes(max(each.recall for each in known), share, max(each.inliers for each in known))

    @property
    def alias_step_m(self) -> float:
        """Return the smallest one of all maps."""
        return min((held.alias_step_m for held in self.by_floor.values()), default=ALIAS_STEP_M)
