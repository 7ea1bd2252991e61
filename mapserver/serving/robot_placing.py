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


def place_robot(store: MapStore, fleet: Fleet, bus: Bus | None, told: InitialPoseMessage, actor: Actor) -> None:
    """Publish the pose for its robot, and log its author in the site's history. bus: None if the server has none.

    UsageError for an unknown site or robot and a position outside the map, StateError for a robot that is not connected.
    """
    store.current(told.site)  # raises for an unknown site
    robot = next((robot for robot in fleet.robots(told.site) if robot.robot == told.robot), None)
    if robot is None:
        raise UsageError(f"site {told.site} has no robot {told.robot[:64]!r}; /v1/robots lists its robots")
    if robot.seconds_since > (_LEFT_S if robot.is_present is False else _HEARD_WITHIN_S):
        last = f"{told.robot} was last seen {robot.seconds_since:.0f} s ago"
        raise StateError(f"{last} and is not connected; try again when it is back")
    if bus is None or bus.closed():
        raise StateError("this server has no bus to notify robots; start one with `mapserver serve`")
    _check_place(store, told, robot)
    heading = "" if told.heading_rad is None else f", heading {math.degrees(told.heading_rad):.0f} degrees"
    words = f"{told.robot} is at {told.x_map_m:.2f}, {told.y_map_m:.2f} m{heading}, within {told.sigma_m:g} m"
    bus.publish(robot_key(told.site, told.robot, "initial_pose"), encode_message(told))
    store.audit("robot placed", words, actor=actor, site=told.site)


def _check_place(store: MapStore, told: InitialPoseMessage, robot: RobotStatus) -> None:
    values = (told.x_map_m, told.y_map_m, told.heading_rad or 0.0, told.sigma_m)
    if not all(map(math.isfinite, values)) or not 0 < told.sigma_m <= MOST_SIGMA_M:
        raise UsageError(f"x, y, heading and sigma must be numbers, sigma above 0 and at most {MOST_SIGMA_M:g} m")
    current = store.current(told.site)
    version = robot.version if robot.version is not None else None if current is None else current.version
    if version is None:
        raise StateError(f"{told.robot} runs no map yet; publish one first")
    manifest = store.manifest(told.site, version)
    x, y = (math.floor(value / manifest.tile_size_m) for value in values[:2])
    if (x, y) not in {(tile.x, tile.y) for tile in manifest.tiles}:
        where = f"{told.x_map_m:.1f}, {told.y_map_m:.1f} m"
        raise UsageError(f"{where} is outside of version {version}: it has no tile {x},{y}")
