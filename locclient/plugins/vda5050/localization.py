"""Localization in VDA 5050 terms, from a robot's estimates: position and LOCALIZATION_ERROR. Pure."""

from math import atan2, hypot, inf, pi
from typing import NamedTuple

from fleetmap.failure_definition import is_driving, radius_95_m
from fleetmap.geometry import Array
from fleetmap.messages import Cause, Status
from locclient.localization.estimate import Estimate
from locclient.plugins.vda5050.messages import Error
from locclient.robot.robot import Outcome

_NO_FRAMES = "no images come from the cameras; check them and their cables"
_NO_MAP = "no map is enabled: the fleet manager must send enableMap, or the map server publish a version"
_NO_BUILDING = "the map does not define its pose in the building; align the site and build a version, or set [vda5050] frame to map"
_WORDS = {
    Cause.DARK: "the images are dark: lights out, or a covered lens",
    Cause.GLARE: "the images are overexposed",
    Cause.FROZEN: "a camera repeats its last image",
    Cause.BLURRED: "the images are blurred; clean the lenses",
    Cause.OCCLUDED: "an object is close in front of the cameras",
    Cause.ODOMETRY: "the odometry is lost",
    Cause.UNMATCHED: "nothing in the map matches the images: changed, not mapped, or mapped from another side only",
    Cause.RIDING: "the robot is in a lift; it drives out, and pictures then tell its floor",
    Cause.CALIBRATION: "images contradict the map as only a wrong calibration does; check the cameras' mounting",
}
_STATUS_WORDS = {
    Status.AMBIGUOUS: "several places match the images; drive on, or send initializePosition",
    Status.INITIALISING: "the robot is not localized yet; drive on, or send initializePosition",
    Status.DEGRADED: "the pose is less sure than lost_radius_m or [output] stop_above_m allow; more of the map in view helps",
    Status.LOST: "the robot has lost its pose; drive on, or send initializePosition",
}


class Position(NamedTuple):
    """A pose of the base in the fleet manager's frame. radius_m: its protection level, infinite if none is promised. site: another one
    of the robot's building, whose map it is in; empty for its own.
    """

    x_m: float
    y_m: float
    theta_rad: float
    radius_m: float = float("inf")
    site: str = ""

    def away_from(self, other: "Position") -> tuple[float, float]:
        """Return the distance in metres, infinite in another map, and the angle in radians from 0 to pi."""
        if self.site != other.site:
            return float("inf"), pi
        turn = abs(self.theta_rad - other.theta_rad) % (2 * pi)
        return hypot(self.x_m - other.x_m, self.y_m - other.y_m), min(turn, 2 * pi - turn)


class Localization(NamedTuple):
    """The last estimate, None before the first. position: the last known one, also if the robot is not localized."""

    estimate: Estimate | None = None
    position: Position | None = None
    is_localized: bool = False
    is_driving: bool = False
    is_silent: bool = True
    is_aligned: bool = True

    def after(
        self, outcome: Outcome, lost_radius_m: float, fleet_from_map: Array | None, stop_above_m: float = inf
    ) -> "Localization":
        """Update by the results of one frame. Beyond lost_radius_m (95 %) a position is unusable for driving at any status, and so is one
        whose protection level is above stop_above_m.

        fleet_from_map: None if the map does not define the fleet manager's frame; there is then no position.
        """
        estimate, published, speed_mps = outcome.estimate, outcome.published, outcome.speed_mps
        position, is_localized = self.position, False
        if fleet_from_map is None:
            position = None
        elif published.map_from_odom is not None and estimate.cov_rot_trans is not None:
            fleet_from_base = fleet_from_map @ published.map_from_odom @ published.odom_from_base
            x_m, y_m = (float(value) for value in fleet_from_base[:2, 3])
            heading_rad = float(atan2(fleet_from_base[1, 0], fleet_from_base[0, 0]))
            position = Position(x_m, y_m, heading_rad, estimate.protection_m, estimate.floor)
            is_near = radius_95_m(estimate.cov_rot_trans) <= lost_radius_m and estimate.protection_m <= stop_above_m
            is_localized = estimate.status in {Status.TRACKING, Status.DEGRADED} and is_near
        drives = speed_mps is not None and is_driving(speed_mps)  # an unknown one is none: nobody may rely on it
        is_aligned = fleet_from_map is not None
        return Localization(estimate, position, is_localized, drives, is_silent=False, is_aligned=is_aligned)

    def mobile_robot_position(self, map_id: str, lost_radius_m: float) -> dict[str, object] | None:
        """Return the object of the state; None before the first pose. The score is 1 for an exact pose, 0 where its
        protection level reaches lost_radius_m or none is promised; deviationRange is that level.

        map_id: of the robot's own site; other maps are called by their sites.
        """
        place, is_localized = self.position, self.is_localized and not self.is_silent
        # A configured id that is another site: fleet managers would take it for the own.
        if place is None or place.site == map_id:
            return None
        found: dict[str, object] = {"x": place.x_m, "y": place.y_m, "theta": place.theta_rad}
        found |= {"mapId": place.site or map_id, "localized": is_localized, "localizationScore": 0.0}
        if is_localized:
            found["localizationScore"] = max(0.0, 1.0 - place.radius_m / lost_radius_m)
            found |= {"deviationRange": place.radius_m} if place.radius_m < inf else {}
        return found

    def error(self) -> Error | None:
        """Return LOCALIZATION_ERROR with the text of its cause; None for a localized robot."""
        estimate = None if self.is_silent else self.estimate
        if estimate is None:
            hint = _NO_FRAMES
        elif self.is_localized:
            return None
        elif estimate.map_version is None:
            hint = _NO_MAP
        elif not self.is_aligned:
            hint = _NO_BUILDING
        else:
            hint = _WORDS.get(estimate.cause) or _STATUS_WORDS.get(estimate.status, "the robot has no reliable pose")
        said = "no images" if estimate is None else estimate.status
        return Error(
            error_type="LOCALIZATION_ERROR",
            error_level="FATAL",
            error_description=f"the robot is not localized ({said})",
            error_hint=hint,
        )
