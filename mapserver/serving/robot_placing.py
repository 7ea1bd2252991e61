"""An operator's pose for a robot, checked and sent to the robot."""

import math

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import StateError, UsageError
from fleetmap.messages import InitialPoseMessage, encode_message, robot_key
from mapserver.fleet.fleet import Fleet, RobotStatus
from mapserver.store import Actor, MapStore

MOST_SIGMA_M = 20.0
# Robots report every second. One without its liveliness token has left.
_HEARD_WITHIN_S, _LEFT_S = 10.0, 3.0


class RobotPlacing:
    """Sends robots their position. bus: None if the server has none."""

    def __init__(self, store: MapStore, fleet: Fleet, bus: Bus | None) -> None:
        self._store, self._fleet, self._bus = store, fleet, bus

    def tell(self, told: InitialPoseMessage, actor: Actor) -> None:
        """Publish the pose, and log its author in the site's history.

        UsageError for an unknown site or robot and a position outside the map, StateError for a robot that is not connected.
        """
        robot = self._listening(told.site, told.robot)
        self._check_place(told, robot)
        assert self._bus is not None
        heading = "" if told.heading_rad is None else f", heading {math.degrees(told.heading_rad):.0f} degrees"
        words = f"{told.robot} is at {told.x_map_m:.2f}, {told.y_map_m:.2f} m{heading}, within {told.sigma_m:g} m"
        self._bus.publish(robot_key(told.site, told.robot, "initial_pose"), encode_message(told))
        self._store.audit("robot placed", words, actor=actor, site=told.site)

    def _listening(self, site: str, name: str) -> RobotStatus:
        self._store.current(site)  # raises for an unknown site
        robot = next((robot for robot in self._fleet.robots(site) if robot.robot == name), None)
        if robot is None:
            raise UsageError(f"site {site} has no robot {name[:64]!r}; /v1/robots lists its robots")
        if robot.seconds_since > (_LEFT_S if robot.is_present is False else _HEARD_WITHIN_S):
            raise StateError(
                f"{name} was last seen {robot.seconds_since:.0f} s ago and is not connected; try again when it is back"
            )
        if self._bus is None or self._bus.closed():
            raise StateError("this server has no bus to notify robots; start one with `mapserver serve`")
        return robot

    def _check_place(self, told: InitialPoseMessage, robot: RobotStatus) -> None:
        values = (told.x_map_m, told.y_map_m, told.heading_rad or 0.0, told.sigma_m)
        if not all(map(math.isfinite, values)) or not 0 < told.sigma_m <= MOST_SIGMA_M:
            raise UsageError(f"x, y, heading and sigma must be numbers, sigma above 0 and at most {MOST_SIGMA_M:g} m")
        current = self._store.current(told.site)
        version = robot.version if robot.version is not None else None if current is None else current.version
        if version is None:
            raise StateError(f"{told.robot} runs no map yet; publish one first")
        manifest = self._store.manifest(told.site, version)
        x, y = (value / manifest.tile_size_m for value in values[:2])
        cell = (math.floor(x), math.floor(y))
        if cell not in {(tile.x, tile.y) for tile in manifest.tiles}:
            raise UsageError(
                f"{told.x_map_m:.1f}, {told.y_map_m:.1f} m is outside of version {version}: it has no tile {cell[0]},{cell[1]}"
            )
