"""The maps in which a robot is localized: its own site's, and those of the other floors of its building. Pure."""

from collections.abc import Mapping
from typing import NamedTuple

from fleetmap.geometry import Array
from fleetmap.mapformat.building import Floor
from fleetmap.relocalization.map_view import ALIAS_STEP_M, LookAlikes
from fleetmap.relocalization.relocalizer import Relocalizer


class HeldMap(NamedTuple):
    """A version of one floor's map: a relocalizer for each camera of the rig. lookalikes, alias_step_m: see `Localizer.handle_version`."""

    version: int
    relocalizers: tuple[Relocalizer, ...]
    lookalikes: LookAlikes | None = None
    alias_step_m: float = ALIAS_STEP_M


class HeldMaps:
    """Maps by their floors' sites, "" for the robot's own, whose map it may hold without a building.

    plan_from_map (4, 4): of each floor of the building, with the same coordinates for places one above the other, and z of its map.
    lookalikes, alias_step_m: of all maps together, since a fix may be in any of them.
    """

    def __init__(self) -> None:
        self.by_floor: dict[str, HeldMap] = {}
        self.plan_from_map: Mapping[str, Array] = {}
        self.lookalikes: LookAlikes | None = None
        self.alias_step_m = ALIAS_STEP_M

    def use(self, floor: str, held: HeldMap) -> None:
        """Use another map of a floor."""
        self.by_floor[floor] = held
        self._compare()

    def use_building(self, building: Mapping[str, Floor]) -> None:
        """Drop the maps of floors that are none of this building, besides the robot's own."""
        self.plan_from_map = {site: floor.frame.building_from_map for site, floor in building.items()}
        self.by_floor = {site: held for site, held in self.by_floor.items() if not site or site in building}
        self._compare()

    @property
    def missing(self) -> set[str]:
        """Return the floors whose maps the robot does not hold."""
        return self.plan_from_map.keys() - self.by_floor.keys()

    def version_on(self, floor: str) -> int | None:
        held = self.by_floor.get(floor)
        return None if held is None else held.version

    def _compare(self) -> None:
        known = [held.lookalikes for held in self.by_floor.values() if held.lookalikes is not None]
        self.lookalikes = None
        if known:
            shares = [each.max_wrong_share for each in known] + [1.0] * (len(self.by_floor) - len(known))
            most = max(each.recall for each in known), max(shares), max(each.inliers for each in known)
            self.lookalikes = LookAlikes(*most)
        self.alias_step_m = min((held.alias_step_m for held in self.by_floor.values()), default=ALIAS_STEP_M)
