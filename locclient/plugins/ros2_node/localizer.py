"""Localization as a managed ROS 2 node, a drop-in for nav2's localizer: topics, services, lifecycle, bond, diagnostics."""

import logging
import threading
import time
import uuid
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import partial

import numpy as np

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import FleetmapError, RecordingError, UsageError
from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import Array, se3_inverse, so3_log
from fleetmap.messages import Status
from fleetmap.odometry.estimate import OdometryStatus
from fleetmap.recordings.ros2 import messages
from fleetmap.recordings.ros2.cdr import pack, unpack
from fleetmap.recordings.ros2.messages import FrameLink, decode_frame_links, encode_frame_links, encode_prior
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import UNSAID_SIGMAS, PositionPrior
from fleetmap.sensors.source_settings import Topics
from fleetmap.sources.intake import Intake
from fleetmap.version_grid import OccupancyGrid
from locclient.hooks import OutputHook
from locclient.localization.estimate import Estimate
from locclient.localization.place import transport_cov
from locclient.outputs import OutputSection, Publisher
from locclient.plugins.ros2_node.driver_odometry import DriverOdometry
from locclient.plugins.ros2_node.keys import LATCHED, Qos, key_layout
from locclient.plugins.ros2_node.node import Ros2Node
from locclient.robot.continuous_odom import PublishedPose


class LifecycleState(IntEnum):
    """State ids of lifecycle_msgs/State; those from 10 on are transition states."""

    UNKNOWN = 0
    UNCONFIGURED = 1
    INACTIVE = 2
    ACTIVE = 3
    FINALIZED = 4
    CONFIGURING = 10
    CLEANINGUP = 11
    SHUTTINGDOWN = 12
    ACTIVATING = 13
    DEACTIVATING = 14
    ERRORPROCESSING = 15


@dataclass(frozen=True, slots=True)
class Transition:
    """lifecycle_msgs/TransitionDescription: start state, transition state and goal state."""

    id: int
    label: str
    start: LifecycleState
    through: LifecycleState
    goal: LifecycleState
    success_id: int

    @property
    def steps(self) -> tuple["Step", "Step"]:
        """Return those into the transition state, and out of it."""
        into = (self.id, self.label, self.start, self.through)
        return into, (self.success_id, "transition_success", self.through, self.goal)


Step = tuple[int, str, LifecycleState, LifecycleState]  # number, label, start and goal
_S = LifecycleState
TRANSITIONS = (
    Transition(1, "configure", _S.UNCONFIGURED, _S.CONFIGURING, _S.INACTIVE, 10),
    Transition(2, "cleanup", _S.INACTIVE, _S.CLEANINGUP, _S.UNCONFIGURED, 20),
    Transition(3, "activate", _S.INACTIVE, _S.ACTIVATING, _S.ACTIVE, 30),
    Transition(4, "deactivate", _S.ACTIVE, _S.DEACTIVATING, _S.INACTIVE, 40),
    Transition(5, "shutdown", _S.UNCONFIGURED, _S.SHUTTINGDOWN, _S.FINALIZED, 50),
    Transition(6, "shutdown", _S.INACTIVE, _S.SHUTTINGDOWN, _S.FINALIZED, 50),
    Transition(7, "shutdown", _S.ACTIVE, _S.SHUTTINGDOWN, _S.FINALIZED, 50),
)


def requested(request: bytes, state: LifecycleState) -> Transition | None:
    """Return the transition requested by lifecycle_msgs/srv/ChangeState: by its label, which has priority, or its id.

    None for a transition that does not begin at this state. ValueError for an invalid request.
    """
    number, label = unpack("lifecycle_msgs/srv/ChangeState_Request", request)
    here = [transition for transition in TRANSITIONS if transition.start is state]
    return next((one for one in here if (one.label == label if label else one.id == number)), None)


def encode_transitions(transitions: Sequence[Transition], *, with_success: bool = False) -> bytes:
    """Encode the response of lifecycle_msgs/srv/GetAvailableTransitions; with_success: include those out of transition states."""
    both = [[one.steps[number] for one in transitions] for number in range(1 + with_success)]
    steps = dict.fromkeys(step_values(step) for listed in both for step in listed)
    return pack("lifecycle_msgs/srv/GetAvailableTransitions_Response", steps)


def named(state: LifecycleState) -> tuple[int, str]:
    """Return the values of a lifecycle_msgs/State."""
    return state.value, state.name.lower()


def step_values(step: Step) -> tuple[int | str, ...]:
    """Return the values of a lifecycle_msgs/TransitionDescription."""
    number, label, start, goal = step
    return number, label, *named(start), *named(goal)


EMPTY = pack("std_srvs/srv/Empty_Response", 0)
_BOND_PERIOD_S, _BOND_TIMEOUT_S = 0.1, 4.0  # as in nav2
_STUCK_S = 3.0  # without a sign of life from the localizing thread, after which the bond is not renewed
_OK, _WARN, _ERROR = 0, 1, 2
_LEVELS = {Status.TRACKING: _OK, Status.LOST: _ERROR}
_OWN_TF = 256  # last sent messages, to recognize them when they are received back
_OTHER_S = 5.0  # another publisher is reported for so long after its last transform
# Odometry sigmas between two frames, tracking and not: radians, metres, share of the distance.
_MEASURED, _GUESSED = (0.0005, 0.001, 0.02), (0.02, 0.05, 0.1)
_log = logging.getLogger(__name__)


class Ros2Localizer(Publisher):
    """A Publisher whose node is visible in the graph from the start, and publishes while active.

    Localization runs in every state, so an activated node has a pose at once. Commands reach the robot through its intake.
    """

    def __init__(
        self, section: OutputSection, bus: Bus, _site: str, robot: str, calibration: RigCalibration, intake: Intake
    ) -> None:
        """See `OutputHook`. Raises UsageError for invalid names."""
        self._section, self._robot, self._calibration, self._intake = section, robot, calibration, intake
        self.grid_height_m = section.robot_height_m if section.map_topic else None
        self._grid: OccupancyGrid | None = None
        self._map_words = "none yet"
        self._state = LifecycleState.ACTIVE if section.autostart else LifecycleState.UNCONFIGURED
        self._lock = threading.Lock()  # of the state
        self._last: tuple[Estimate, PublishedPose] | None = None
        self._fix_refused = ""  # by the newest finished query: most frames finish none
        self._refused: deque[str] = deque(maxlen=1)
        self._alive_s = time.monotonic()
        self._bond = ""  # id of our side while there is one
        self._building_from_map: Array | None = None
        self._sent_tf: deque[bytes] = deque(maxlen=_OWN_TF)
        self._other_s, self._other = -_OTHER_S, ""
        self._has_faulty_tf = False
        offset_s = calibration.cameras[0].imu_minus_cam_s
        self._driver = DriverOdometry(section.odom_frame, section.base_frame, offset_s, self._send_map_link)
        self._ended = threading.Event()
        self._node = node = Ros2Node(bus, key_layout(section.keys, section.domain), section.node, section.namespace)
        try:
            self._declare(node)
        except FleetmapError:
            node.close()
            raise
        self._beats = threading.Thread(target=self._beat, name="bond", daemon=True)
        self._beats.start()
        if section.autostart:
            self._send_latched()

    def _declare(self, node: Ros2Node) -> None:
        section = self._section
        stamped = "geometry_msgs/PoseWithCovarianceStamped"
        self._send_placement = node.publisher(section.pose_topic, stamped, LATCHED)
        self._put_tf = node.publisher(section.tf_topic, "tf2_msgs/TFMessage", Qos(100))
        self._send_tf_static = node.publisher(f"{section.tf_topic}_static", "tf2_msgs/TFMessage", LATCHED)
        self._send_odom = node.publisher(section.odom_topic, "nav_msgs/Odometry")
        self._send_status = node.publisher(section.status_topic, "std_msgs/String")
        if section.map_topic:
            self._send_map = node.publisher(section.map_topic, "nav_msgs/OccupancyGrid", LATCHED)
        self._send_diagnostics = node.publisher("/diagnostics", "diagnostic_msgs/DiagnosticArray")
        self._send_bond = node.publisher("bond", "bond/Status")
        self._send_event = node.publisher("~/transition_event", "lifecycle_msgs/TransitionEvent")
        node.subscribe("bond", "bond/Status", self._hear_bond)
        node.subscribe(section.initial_pose_topic, stamped, self._take_initial_pose)
        node.subscribe(section.tf_topic, "tf2_msgs/TFMessage", self._hear_tf, Qos(100))
        if not section.publish_odom:
            node.subscribe(f"{section.tf_topic}_static", "tf2_msgs/TFMessage", self._driver.handle_tf_static, LATCHED)
        state, states = "lifecycle_msgs/srv/GetState", "lifecycle_msgs/srv/GetAvailableStates"
        known = pack(f"{states}_Response", [named(one) for one in LifecycleState])
        node.serve("~/get_state", state, lambda _: pack(f"{state}_Response", *named(self._state)))
        node.serve("~/change_state", "lifecycle_msgs/srv/ChangeState", self._change_state)
        node.serve("~/get_available_states", states, lambda _: known)
        transitions = "lifecycle_msgs/srv/GetAvailableTransitions"
        node.serve(
            "~/get_available_transitions",
            transitions,
            lambda _: encode_transitions([one for one in TRANSITIONS if one.start is self._state]),
        )
        graph = encode_transitions(TRANSITIONS, with_success=True)
        node.serve("~/get_transition_graph", transitions, lambda _: graph)
        node.serve("set_initial_pose", "nav2_msgs/srv/SetInitialPose", self._take_initial_pose)
        node.serve("reinitialize_global_localization", "std_srvs/srv/Empty", self._search_anew)
        node.serve("request_nomotion_update", "std_srvs/srv/Empty", lambda _: EMPTY)

    # --- called by the thread that localizes --------------------------------------------------------------------------

    def publish(self, estimate: Estimate, published: PublishedPose, base_from_body: Array) -> None:
        """Send the pose of the base in the map; only with its covariance."""
        before, self._last = self._last, (estimate, published)
        if estimate.fix is not None or estimate.refused:
            self._fix_refused = estimate.refused
        if self._state is not LifecycleState.ACTIVE:
            return
        section, stamp_ns = self._section, estimate.stamp_ns
        if section.building_frame:
            known, new = self._building_from_map, published.building_from_map
            if new is not None and (known is None or not np.array_equal(known, new)):
                self._building_from_map = new  # stays in tf: static transforms are never withdrawn
                self._send_static_frames()
        map_from_odom, map_from_base = published.map_from_odom, published.map_from_base
        if map_from_odom is not None and map_from_base is not None:
            if section.publish_odom:
                self._send_map_link(stamp_ns, map_from_odom)
            else:
                self._driver.handle_frame(stamp_ns, map_from_base)
            if published.cov_rot_trans is not None:
                prior = PositionPrior(stamp_ns, map_from_base, published.cov_rot_trans)
                self._send_placement(encode_prior(prior, section.map_frame))
        odometry_frame = section.odom_frame
        if section.publish_odom:
            self._send_tf(stamp_ns, FrameLink(section.odom_frame, section.base_frame, published.odom_from_base))
        else:  # the driver's frame differs from that of our odometry
            odometry_frame = f"{section.sensor_frames or OutputSection().sensor_frames}odom"
        if before is not None and estimate.odometry.scale_known and stamp_ns > before[0].stamp_ns:
            motion = motion_between(before, (estimate, published), base_from_body)
            self._send_odom(messages.encode_motion(stamp_ns, odometry_frame, section.base_frame, *motion))
        self._send_status(pack("std_msgs/String", estimate.status.value))

    def _send_map_link(self, stamp_ns: int, map_from_odom: Array) -> None:
        if self._state is not LifecycleState.ACTIVE:  # deactivated while the frame waited for the driver's pose
            return
        ahead_ns = stamp_ns + int(self._section.transform_tolerance_s * 1e9)
        self._send_tf(ahead_ns, FrameLink(self._section.map_frame, self._section.odom_frame, map_from_odom))

    def _send_tf(self, stamp_ns: int, link: FrameLink) -> None:
        message = encode_frame_links(stamp_ns, [link])
        self._sent_tf.append(message)
        self._put_tf(message)

    def alive(self, is_silent: bool) -> None:
        self._alive_s = time.monotonic()
        level, words, values = self._diagnosis(is_silent)
        status = (level, f"{self._section.node}: localization", words, self._robot, values.items())
        self._send_diagnostics(pack("diagnostic_msgs/DiagnosticArray", time.time_ns(), "", [status]))

    def _diagnosis(self, is_silent: bool) -> tuple[int, str, dict[str, str]]:
        """Return level, message and values of a diagnostic_msgs/DiagnosticStatus."""
        estimate = None if self._last is None else self._last[0]
        level, words = _WARN, "no frame yet"
        values = {"lifecycle": self._state.name.lower(), "map": self._map_words}
        if estimate is not None:
            level = _LEVELS.get(estimate.status, _WARN)
            words = f"{estimate.status.value}: {estimate.cause.value}" if estimate.cause else estimate.status.value
            values |= {
                "status": estimate.status.value,
                "cause": estimate.cause.value,
                "map_version": "none" if estimate.map_version is None else str(estimate.map_version),
                "refused": self._fix_refused,
                "calibration": estimate.calibration.text,
            }
            if estimate.views_in_words:
                values["views"] = estimate.views_in_words
            if self._last is not None and self._last[1].level:
                floors = sorted({hypothesis.floor or "own" for hypothesis in estimate.hypotheses})
                values |= {"floor": estimate.floor or "own", "level": self._last[1].level}
                values |= {"hypothesis_floors": ", ".join(floors)} if floors else {}
            if estimate.cov_rot_trans is not None:
                values["radius_95_m"] = f"{radius_95_m(estimate.cov_rot_trans):.3f}"
        if fault := self._tf_fault():
            level, words = _ERROR, f"{words}; {fault}"
        if is_silent:
            level, words = _ERROR, "no frames come"
        if self._refused:
            values["refused_initial_pose"] = self._refused[0]
        return level, words, values

    def _tf_fault(self) -> str:
        """Return the reason why /tf is unusable for planners, empty if it is usable. Log its begin and end."""
        fault = ""
        if time.monotonic() - self._other_s < _OTHER_S:
            fault = f"another program publishes {self._other} too: stop it, or see publish_odom in docs/ros2.md"
        elif not self._section.publish_odom and self._last is not None:
            missing = self._driver.fault(self._last[0].stamp_ns)
            fault = missing and f"{self._section.map_frame} -> {self._section.odom_frame} is not sent: {missing}"
        if bool(fault) != self._has_faulty_tf:
            self._has_faulty_tf = bool(fault)
            _log.warning("%s", fault or "/tf is whole again")
        return fault

    def show_grid(self, version: int, grid: OccupancyGrid | None, why: str) -> None:
        """Publish the grid. Without one the last grid stays on the topic: all versions of a site share the map's frame."""
        self._map_words = why if grid is None else f"grid of version {version}"
        if grid is None:
            _log.warning("planners get no new map: %s", why)
            return
        self._grid = grid
        if self._state is LifecycleState.ACTIVE:
            self._send_latched()

    def close(self) -> None:
        self._ended.set()
        self._beats.join()
        self._break_bond()
        self._node.close()

    # --- called by threads of the bus ---------------------------------------------------------------------------------

    def _hear_tf(self, message: bytes) -> None:
        """Handle transforms of other programs; those sent here are received back as well."""
        section = self._section
        if message in self._sent_tf:
            return
        links = [link for link in decode_frame_links(message) if link.is_usable]
        for link in links:
            is_ours = link.child == section.odom_frame or (link.child == section.base_frame and section.publish_odom)
            if is_ours and self._state is LifecycleState.ACTIVE:
                self._other_s, self._other = time.monotonic(), f"{link.parent} -> {link.child}"
        if not section.publish_odom:
            self._driver.handle_tf(links)

    def _change_state(self, request: bytes) -> bytes:
        with self._lock:
            transition = requested(request, self._state)
            if transition is None:
                _log.warning("a requested transition does not begin at %s", self._state.name.lower())
                return pack("lifecycle_msgs/srv/ChangeState_Response", False)
            if transition.start is LifecycleState.ACTIVE:
                self._break_bond()
            self._state = transition.goal
            if transition.goal is LifecycleState.ACTIVE:
                self._send_latched()
                self._bond = str(uuid.uuid4())
        for step in transition.steps:
            self._send_event(pack("lifecycle_msgs/TransitionEvent", time.time_ns(), *step_values(step)))
        _log.info("the node is %s", transition.goal.name.lower())
        return pack("lifecycle_msgs/srv/ChangeState_Response", True)

    def _take_initial_pose(self, message: bytes) -> bytes:
        try:
            prior = decode_initial_pose(message, self._section.map_frame)
        except (FleetmapError, ValueError) as error:
            self._refused.append(str(error))
            raise
        self._refused.clear()
        self._intake.put_prior(prior)
        return EMPTY

    def _search_anew(self, _: bytes) -> bytes:
        self._intake.put_forget()
        return EMPTY

    def _send_latched(self) -> None:
        self._send_static_frames()
        if self._grid is not None:
            self._send_map(encode_grid(time.time_ns(), self._section.map_frame, self._grid))

    def _send_static_frames(self) -> None:
        """Send all static frames in one message: late subscribers receive only the last message."""
        section = self._section
        links = sensor_links(section, self._calibration) if section.sensor_frames else []
        if self._building_from_map is not None:
            links.append(FrameLink(section.building_frame, section.map_frame, self._building_from_map))
        if links:
            self._send_tf_static(encode_frame_links(time.time_ns(), links))

    # --- bond ---------------------------------------------------------------------------------------------------------

    def _beat(self) -> None:
        while not self._ended.wait(_BOND_PERIOD_S):
            bond = self._bond
            if bond and time.monotonic() - self._alive_s < _STUCK_S:
                self._tell_bond(bond, is_active=True)

    def _hear_bond(self, message: bytes) -> None:
        """Acknowledge the end of the other side, as bondcpp does; the node stays active."""
        _, _, name, instance, is_active, *_ = unpack("bond/Status", message)
        if self._bond and name == self._section.node and instance != self._bond and not is_active:
            self._break_bond()

    def _break_bond(self) -> None:
        bond, self._bond = self._bond, ""
        if bond:
            self._tell_bond(bond, is_active=False)

    def _tell_bond(self, bond: str, *, is_active: bool) -> None:
        said = time.time_ns(), "", self._section.node, bond, is_active, _BOND_TIMEOUT_S, _BOND_PERIOD_S
        try:
            self._send_bond(pack("bond/Status", *said))
        except FleetmapError as error:
            _log.debug("the bond was not renewed: %s", error)


def motion_between(
    before: tuple[Estimate, PublishedPose], after: tuple[Estimate, PublishedPose], base_from_body: Array
) -> tuple[Array, Array, Array, Array]:
    """Return a frame's odom_from_base (4, 4) with its covariance (6, 6), and the mean velocity of the base since the frame before, in its
    own axes (6,), linear m/s, then angular rad/s, with its covariance (6, 6); all in the order of ROS, translation first."""
    (earlier, then), (estimate, now) = before, after
    odometry, seconds = estimate.odometry, (estimate.stamp_ns - earlier.stamp_ns) * 1e-9
    step = se3_inverse(then.odom_from_base) @ now.odom_from_base
    twist = np.concatenate([step[:3, 3], so3_log(step[:3, :3])]) / seconds
    turn_rad, floor_m, share = _GUESSED if odometry.status is OdometryStatus.DEGRADED else _MEASURED
    sigma_m = floor_m + share * float(np.linalg.norm(step[:3, 3]))
    twist_cov = np.diag([(sigma_m / seconds) ** 2] * 3 + [(turn_rad / seconds) ** 2] * 3)
    # The odometry's frame may be rotated against the published one.
    published_from_odometry = (now.odom_from_base @ base_from_body)[:3, :3] @ odometry.odom_from_body[:3, :3].T
    both = np.kron(np.eye(2), published_from_odometry)
    lever_m = now.odom_from_base[:3, :3] @ base_from_body[:3, 3]
    covariance = transport_cov(both @ odometry.cov_rot_trans @ both.T, -lever_m)
    return now.odom_from_base, covariance[messages.HALVES_SWAPPED], twist, twist_cov


def decode_initial_pose(data: bytes, map_frame: str) -> PositionPrior:
    """geometry_msgs/PoseWithCovarianceStamped of an operator: a prior from now on, independent of its stamp.

    RecordingError for another frame, a pose or covariance that is not finite, and an invalid covariance.
    """
    _, frame_id = messages.header_of(data)
    if frame_id.lstrip("/") != map_frame:
        raise RecordingError(f"an initial pose in the frame {frame_id!r} is not used; give it in {map_frame!r}")
    try:
        prior = messages.decode_prior(data)
    except ValueError as error:
        raise RecordingError(f"an initial pose is not used: {error}; give a finite pose and a quaternion") from error
    cov = prior.cov_rot_trans
    if not np.isfinite(cov).all():
        raise RecordingError(
            "an initial pose is not used: its covariance holds NaN or infinity; give variances, or zeros"
        )
    if not np.allclose(cov, cov.T, atol=1e-6) or np.linalg.eigvalsh((cov + cov.T) / 2)[0] < -1e-6:
        raise RecordingError(
            "an initial pose is not used: its covariance is not symmetric and positive; check its order"
        )
    said = np.diag(cov) > 0
    cov = np.where(np.outer(said, said), (cov + cov.T) / 2, 0.0) + np.diag(np.where(said, 0.0, UNSAID_SIGMAS**2))
    return PositionPrior(0, prior.map_from_base, cov, is_revisable=True)


def encode_grid(stamp_ns: int, frame_id: str, grid: OccupancyGrid) -> bytes:
    """nav_msgs/OccupancyGrid."""
    height, width = grid.cells.shape
    place, cells = messages.position_quat_xyzw(grid.map_from_grid), np.ascontiguousarray(grid.cells, np.int8).tobytes()
    size = grid.resolution_m, width, height
    return pack("nav_msgs/OccupancyGrid", stamp_ns, frame_id, stamp_ns, *size, place, cells)


def sensor_links(section: OutputSection, calibration: RigCalibration) -> list[FrameLink]:
    """Return base -> body and body -> each camera, under names that no URDF uses: PREFIXbody, PREFIXcam0_optical and so on."""
    body = f"{section.sensor_frames}body"
    links = [FrameLink(section.base_frame, body, calibration.base_from_body)]
    for number, camera in enumerate(calibration.cameras):
        links.append(FrameLink(body, f"{section.sensor_frames}cam{number}_optical", camera.body_from_cam))
    return links


def _check(section: OutputSection, topics: Topics) -> None:
    """Raise UsageError for frame names that tf2 rejects, and for odometry that would come back as that of the wheels."""
    frames = (section.map_frame, section.odom_frame, section.base_frame)
    if len(set(frames)) < 3 or any(not name or name.startswith("/") for name in frames):
        raise UsageError(
            f"[output] map_frame, odom_frame and base_frame = {', '.join(map(repr, frames))}: tf2 needs three different names "
            "that do not begin with a slash"
        )
    if section.odom_topic.lstrip("/") == topics.wheel.lstrip("/"):
        raise UsageError(
            f"[output] odom_topic = {section.odom_topic!r} is also the topic of [topics] wheel: the robot would take its own "
            'odometry for that of its wheels; set wheel = "" if it has none'
        )


OUTPUT = OutputHook(Ros2Localizer, _check, partial(Bus.connect, is_ros=True))
