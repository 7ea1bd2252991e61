"""VDA 5050 adapter: instant actions and the robot program's part of the state in, the state out. Without MQTT; thread-safe."""

import threading
import time
from collections import deque
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from fleetmap.encoding import to_plain
from fleetmap.errors import FleetmapError, LinkError
from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import se3, se3_inverse, so3_exp
from fleetmap.mapformat.building import Floor
from fleetmap.messages import Status, WantedVersion
from fleetmap.sensors.samples import PositionPrior
from fleetmap.threads import Clock
from locclient.hooks import LinkedRobot
from locclient.plugins.vda5050.actions import MAP_ACTIONS, ActionBook, RefusedActionError, parameters
from locclient.plugins.vda5050.fleet_maps import FleetMaps
from locclient.plugins.vda5050.localization import Localization, Position
from locclient.plugins.vda5050.messages import Action, Error, InstantActions, Order, RobotPart, decode
from locclient.plugins.vda5050.settings import Vda5050Section
from locclient.robot.robot import Outcome
from locclient.robot.version_trial import Change, VersionChange

_MOST_JOBS = 16
_ENABLE_S = 120.0  # for the trial of a version, and that of the previous one after a failure
_TILT_SIGMA_RAD, _HEIGHT_SIGMA_M = 0.05, 0.2  # of flat ground, as x, y and theta define neither
_SIGMAS = 3.7  # maximum distance from the fleet manager's pose for agreement
_UNKNOWN: dict[str, Any] = {
    "operatingMode": "STARTUP",
    "powerSupply": {"stateOfCharge": 0.0, "charging": False},
    "safetyState": {"activeEmergencyStop": "NONE", "fieldViolation": True},
}
"""State before the first message of the robot's own program: the standard allows incomplete or invalid values in STARTUP."""
_EMPTY: dict[str, Any] = {
    **{"orderId": "", "orderUpdateId": 0, "lastNodeId": "", "lastNodeSequenceId": 0},
    **{"nodeStates": [], "edgeStates": [], "actionStates": []},
}


class FleetAdapter:
    """Handles input of fleet manager, robot program and localizer, executes map actions in `work`, and returns the state.

    changed: set whenever a new state should be sent at once. factsheet_wanted: set when it is requested.
    """

    def __init__(
        self, section: Vda5050Section, maps: FleetMaps | None, robot: LinkedRobot, clock_s: Clock = time.monotonic
    ) -> None:
        """maps: None if the map server selects the version."""
        self._section, self._maps, self._robot, self._clock_s = section, maps, robot, clock_s
        self.map_id = section.map_id or robot.client.site
        self.changed, self.factsheet_wanted = threading.Event(), threading.Event()
        self._lock = threading.RLock()
        self._book = ActionBook()
        self._jobs: deque[tuple[Action, dict[str, Any]]] = deque()
        # Actions that wait for the localizer, and until when.
        self._enabling: tuple[Action, WantedVersion, float] | None = None
        self._placing: tuple[Action, Position, float] | None = None
        # Last part of the state by the robot's program, and its time; the node by initializePosition, and the program's node then.
        self._part: RobotPart | None = None
        self._part_s = 0.0
        self._order_id = ""  # the last order that the robot's program accepted
        self._last_node: tuple[str, str] | None = None
        self._localization = Localization()
        self._untold: Localization | None = None  # a loss not yet reported in a state, even if already over
        self._last_said: object = None
        self._versions: list[tuple[int, bool]] = []
        self._in_use: frozenset[int] = frozenset()
        self._building: Mapping[str, Floor] = {}  # of the robot's building
        self._visited_versions: Mapping[str, int] = {}  # of the others' maps, whose ids are their sites
        # None while the map does not define its pose in the fleet manager's frame.
        self._fleet_from_map = np.eye(4) if section.frame == "map" else None

    # --- from the fleet manager ---------------------------------------------------------------------------------------

    def instant_actions(self, payload: bytes) -> None:
        """Handle a message of the topic instantActions."""
        with self._lock:
            try:
                message = decode(payload, InstantActions)
            except LinkError as error:
                self._book.add_error("instant", "VALIDATION_FAILURE", str(error), {"topic": "instantActions"})
            else:
                for action in message.actions:
                    if action.action_id not in self._book and action.action_type not in self._section.robot_actions:
                        self._begin(action)
            self.changed.set()

    def order(self, payload: bytes) -> None:
        """Handle a message of the topic order: check only that its maps are known. The robot's program executes it and reports errors."""
        with self._lock:
            try:
                message = decode(payload, Order)
            except LinkError:
                return
            self._book.end("order")
            named = {node.node_position.map_id for node in message.nodes if node.node_position is not None}
            known = self._visited_versions.keys() | ({self.map_id} if self._versions else set())
            for map_id in sorted(named - known)[:20]:
                words = f"the order {message.order_id[:200]!r} names a map that is not on the robot: {map_id[:200]!r}"
                self._book.add_error("order", "UNKNOWN_MAP_ID", words, {"orderId": message.order_id, "mapId": map_id})
            self.changed.set()

    def robot_part(self, payload: bytes) -> None:
        """Handle the robot program's part of the state; an invalid one is refused with an error, and the last one stays."""
        with self._lock:
            self._book.end("robot")
            try:
                part = decode(payload, RobotPart)
            except LinkError as error:
                self._book.add_error("robot", "ROBOT_PART_INVALID", str(error), {"topic": "robotState"}, "CRITICAL")
            else:
                self._part, self._part_s = part, self._clock_s()
                if part.order_id not in ("", self._order_id):
                    self._order_id = part.order_id
                    if self._section.version != "3.0.0":  # which keeps action states until clearInstantActions
                        self._book.clear()
            self.changed.set()

    def _begin(self, action: Action) -> None:
        kind = action.action_type
        try:
            given = parameters(action, self._section.robot_actions)
            self._book.accepted(action)
            if kind in MAP_ACTIONS:
                self._queue(action, given)
            elif kind == "initializePosition":
                self._initialize(action, given)
            elif kind == "factsheetRequest" and self._section.factsheet is None:
                raise RefusedActionError("FACTSHEET_MISSING", "[vda5050] factsheet names no file on this robot")
            else:
                if kind == "clearInstantActions":
                    self._book.clear()
                if kind == "factsheetRequest":
                    self.factsheet_wanted.set()
                self._book.set(action, "FINISHED")
        except RefusedActionError as error:
            self._book.fail(action, error)

    # --- maps ---------------------------------------------------------------------------------------------------------

    def _queue(self, action: Action, given: dict[str, Any]) -> None:
        refused, version = partial(RefusedActionError, "MAP_ACTION_FAILED"), given["mapVersion"]
        if self._maps is None:
            raise refused('the map server selects this robot\'s map: [vda5050] versions = "map server"')
        if given["mapId"] != self.map_id or not (version.isascii() and version.isdecimal()):
            words = f"map {given['mapId'][:80]!r} version {version[:80]!r}: this robot's are {self.map_id!r} 1, 2, 3..."
            raise RefusedActionError("UNKNOWN_MAP_ID", words)
        if len(self._jobs) >= _MOST_JOBS:
            raise refused(f"{_MOST_JOBS} actions on maps wait already; send it again later")
        self._book.set(action, "WAITING")
        self._jobs.append((action, given))

    def work(self) -> None:
        """Execute one action on maps, which may take as long as a download; on the thread that owns the cache."""
        maps = self._maps
        active = self._robot.client.active()
        versions = [] if active is None or active.version is None else [(active.version, True)]
        with self._lock:
            self._versions = versions if maps is None else maps.versions()
            enabling = self._enabling
            if enabling is not None and self._clock_s() > enabling[2]:
                self._enabling = None
                words = f"after {_ENABLE_S:.0f} s the robot has not confirmed it; check its cameras"
                self._book.fail(enabling[0], LinkError(words))
                self.changed.set()
            if maps is None or not self._jobs or (self._enabling and self._jobs[0][0].action_type == "enableMap"):
                return
            action, given = self._jobs.popleft()
            self._book.set(action, "RUNNING")
            self.changed.set()
        try:
            self._act(maps, action, given)
        except Exception as error:
            with self._lock:
                self._book.fail(action, error)
            if not isinstance(error, FleetmapError):
                raise  # to the log of the thread
        with self._lock:
            self._versions = maps.versions()
            self.changed.set()

    def _act(self, maps: FleetMaps, action: Action, given: dict[str, Any]) -> None:
        version = int(given["mapVersion"][:12])
        if action.action_type == "downloadMap":
            maps.download(version, given["mapDownloadLink"], given.get("mapHash"))
        elif action.action_type == "deleteMap":
            with self._lock:
                enabling = self._enabling
                in_use = set(self._in_use) | ({enabling[1].version or 0} if enabling else set())
            maps.delete(version, in_use)
        elif (version, True) not in maps.versions():
            wanted = maps.wanted(version)
            with self._lock:
                self._enabling = (action, wanted, self._clock_s() + _ENABLE_S)
            self._robot.offer(wanted)
            return
        with self._lock:
            self._versions = maps.versions()  # before the action is finished, in any state
            self._book.set(action, "FINISHED")

    def changed_version(self, change: VersionChange) -> None:
        """Handle a version that the localizer adopted, refused or postponed, after the change on the disk; on the thread of `work`."""
        with self._lock:
            enabling = self._enabling
            if enabling is None or enabling[1].manifest_sha256 != change.wanted.manifest_sha256:
                return
            self._enabling = None
            if self._maps is not None:
                self._versions = self._maps.versions()
            if change.change is Change.ADOPTED:
                self._book.set(enabling[0], "FINISHED")
            else:
                self._book.fail(enabling[0], LinkError(f"the robot did not adopt it: {change.reason}"))
            self.changed.set()

    # --- position -----------------------------------------------------------------------------------------------------

    def _initialize(self, action: Action, given: dict[str, Any]) -> None:
        now, section = self._localization, self._section
        site = given["mapId"] if given["mapId"] in self._visited_versions.keys() - {self.map_id} else ""
        fleet_from_map = self._fleet_from_map
        if section.frame == "building" and self._building:
            fleet_from_map = self._building[site].frame.building_from_map
        refused = partial(RefusedActionError, "INITIALIZE_POSITION_FAILED")
        is_own = given["mapId"] == self.map_id and any(is_enabled for _, is_enabled in self._versions)
        if not (site or is_own):
            raise refused(f"map {given['mapId'][:80]!r} is not enabled here")
        if abs(given["theta"]) > np.pi + 1e-6:
            raise refused(f"theta = {given['theta']} is beyond -pi to pi")
        if now.estimate is None or now.is_silent:
            raise refused("no images come from the cameras")
        if fleet_from_map is None:
            raise refused("the map does not define its pose in the building, the frame of positions by [vda5050] frame")
        if self._placing is not None:
            self._book.set(self._placing[0], "FAILED", "replaced by another initializePosition")
        place = Position(float(given["x"]), float(given["y"]), float(given["theta"]), site=site)
        self._placing = (action, place, self._clock_s() + section.initialize_s)
        self._book.set(action, "RUNNING")
        if now.estimate.status is Status.TRACKING:  # a pose confirmed by fixes is not dropped for an operator's
            self._judge_position(is_last=True)
            return
        sigmas = [_TILT_SIGMA_RAD] * 2 + [section.initial_sigma_rad] + [section.initial_sigma_m] * 2 + [_HEIGHT_SIGMA_M]
        fleet_from_base = se3(so3_exp(np.array([0.0, 0.0, place.theta_rad])), np.array([place.x_m, place.y_m, 0.0]))
        map_from_base = se3_inverse(fleet_from_map) @ fleet_from_base
        covariance, soon_ns = np.diag(np.square(sigmas)), now.estimate.stamp_ns + 1
        self._robot.put_prior(PositionPrior(soon_ns, map_from_base, covariance, False, site))

    def after_frame(
        self, outcome: Outcome, in_use: frozenset[int], building: Mapping[str, Floor], visited: Mapping[str, int]
    ) -> None:
        """Handle the results of a frame, and the versions that the localizer holds; on the localizing thread.

        building: as of `Localizer.handle_building`; visited: versions of its other sites' maps.
        """
        with self._lock:
            self._in_use, self._building, self._visited_versions = in_use, building, visited
            if self._section.frame == "building":
                self._fleet_from_map = outcome.published.building_from_map
            robot = self._robot
            self._see(self._localization.after(outcome, robot.lost_radius_m, self._fleet_from_map, robot.stop_above_m))
            self._judge_position()

    def silence(self) -> None:
        """Handle missing frames."""
        with self._lock:
            self._see(self._localization._replace(is_silent=True))
            self._judge_position()

    def _see(self, localization: Localization) -> None:
        self._localization = localization
        said = localization.error(), localization.is_driving
        if said != self._last_said:
            if localization.error() is not None:
                self._untold = localization
            self._last_said = said
            self.changed.set()

    def _judge_position(self, *, is_last: bool = False) -> None:
        """Check that the robot is localized at its initial pose; is_last: the time for it is over."""
        pending, now = self._placing, self._localization
        if pending is None:
            return
        action, wanted, until_s = pending
        section, words = self._section, "the robot is not localized there; check its pose"
        if now.is_localized and not now.is_silent and now.position is not None and now.estimate is not None:
            off_m, off_rad = now.position.away_from(wanted)
            reach_m = _SIGMAS * section.initial_sigma_m + radius_95_m(now.estimate.cov_rot_trans)
            if off_m <= reach_m and off_rad <= _SIGMAS * section.initial_sigma_rad:
                said_node = "" if self._part is None else self._part.last_node_id
                self._last_node = parameters(action)["lastNodeId"], said_node
                self._placing = None
                self._book.set(action, "FINISHED")
                self.changed.set()
                return
            words = f"the robot is localized {off_m:.2f} m and {off_rad:.2f} rad from there"
        if is_last or self._clock_s() > until_s:
            self._placing = None
            self._book.fail(action, RefusedActionError("INITIALIZE_POSITION_FAILED", words))
            self.changed.set()

    # --- the state ----------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Return the state without its header."""
        with self._lock:
            now = self._untold or self._localization
            if self._untold is not None:
                self._untold = None
                self.changed.set()
            lost = now.error()
            errors = [*([lost] if lost else []), *self._book.errors]
            found: dict[str, Any] = {**_EMPTY, "driving": now.is_driving, **self._robots_own()}
            if self._last_node is not None and found["lastNodeId"] == self._last_node[1]:
                found["lastNodeId"] = self._last_node[0]
            others = [(site, number, True) for site, number in self._visited_versions.items() if site != self.map_id]
            found["maps"] = [
                {"mapId": map_id, "mapVersion": str(number), "mapStatus": "ENABLED" if on else "DISABLED"}
                for map_id, number, on in [*((self.map_id, *own) for own in self._versions), *others]
            ]
            place = now.mobile_robot_position(self.map_id, self._robot.lost_radius_m)
            if place is not None:
                found["mobileRobotPosition"] = place
            found["errors"] = to_plain(errors) + found.get("errors", [])
            found["instantActionStates"] = to_plain(self._book.tell()) + found.get("instantActionStates", [])
            return found

    def position(self) -> dict[str, Any] | None:
        """Return what the topic visualization shows, without its header; None before the first pose."""
        with self._lock:
            place = self._localization.mobile_robot_position(self.map_id, self._robot.lost_radius_m)
            part = self._part if self._clock_s() - self._part_s <= self._section.robot_silent_s else None
            velocity = None if part is None else part.velocity
            if place is None:
                return None
            return {"mobileRobotPosition": place} | ({} if velocity is None else {"velocity": to_plain(velocity)})

    def _robots_own(self) -> dict[str, Any]:
        age_s = self._clock_s() - self._part_s
        if self._part is not None and age_s <= self._section.robot_silent_s:
            own: dict[str, Any] = to_plain(self._part)
            return own
        since = "has reported nothing yet" if self._part is None else f"has reported nothing for {age_s:.0f} s"
        missing = Error(
            error_type="ROBOT_PART_MISSING",
            error_level="CRITICAL",
            error_description=f"the robot's own program {since}; battery, safety and operating mode are unknown",
            error_hint="it publishes them on the topic robotState",
        )
        return {**_UNKNOWN, "errors": to_plain([missing])}
