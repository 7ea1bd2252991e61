"""Localization as a managed ROS 2 node, a drop-in for nav2's localizer: topics, services, lifecycle, bond, diagnostics."""

import logging
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial, partialmethod
from importlib.util import find_spec
from queue import Empty, SimpleQueue
from typing import Any

import msgspec
import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid as GridMessage
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.lifecycle.managed_entity import ManagedEntity
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String
from std_srvs.srv import Empty as EmptyService
from tf2_msgs.msg import TFMessage

from fleetmap.errors import FleetmapError, LinkError, UsageError
from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import Array
from fleetmap.messages import Status
from fleetmap.recordings.ros2 import messages
from fleetmap.recordings.ros2.cdr import pack
from fleetmap.recordings.ros2.messages import FrameLink, decode_frame_links, encode_frame_links, encode_prior
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import PositionPrior
from fleetmap.sensors.source_settings import Topics
from fleetmap.sources.intake import Intake
from fleetmap.version_grid import OccupancyGrid
from locclient.localization.estimate import Estimate
from locclient.outputs import OutputSection, Publisher
from locclient.plugins.ros2_node import check
from locclient.plugins.ros2_node.node import LATCHED, Feed, MessageReader, faults_logged, keep_on, ros_started
from locclient.plugins.ros2_node.odometry import DriverOdometry, Localized, motion_between
from locclient.plugins.ros2_node.sensor_messages import decode_initial_pose
from locclient.robot.continuous_odom import PublishedPose

_IDLE_S, _BOND_TIMEOUT_S = 0.1, 4.0  # also the period of the bond's messages, as in nav2
_SERVICES_IDLE_S = 1.0  # a wait of rclpy's executor costs 1.2 ms CPU; the end wakes it, unless it comes just before
_WAITING = 30  # what is to be sent: of a second
_STUCK_S = 3.0  # without a sign of life from the localizing thread, after which the bond is not renewed
_OK, _WARN, _ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
_LEVELS = {Status.TRACKING: _OK, Status.LOST: _ERROR}
_CHANGEABLE, _EARLY = "transform_tolerance_s", ("format", "node", "namespace")  # keys at run time, and before the node
_OWN_TF = 256  # last sent messages, to recognize them when they are received back
_OTHER_S = 5.0  # another publisher is reported for so long after its last transform
_log = logging.getLogger(__name__)


class _Bond(ManagedEntity):
    """Our side of the bond with nav2's lifecycle manager while the node is active: signs of life, which name the node. Source: bondcpp."""

    def __init__(self, node: LifecycleNode, message_type: Any) -> None:
        self._node, self._type, self._instance, self._said_s = node, message_type, "", 0.0
        self._publisher = node.create_publisher(message_type, "bond", 10)

    def on_activate(self, _: object) -> TransitionCallbackReturn:
        self._instance = str(uuid.uuid4())
        return TransitionCallbackReturn.SUCCESS

    def beat(self) -> None:
        """Renew it if it is time."""
        instance = self._instance  # which another thread may end meanwhile
        if instance and time.monotonic() - self._said_s >= _IDLE_S:
            self._said_s = time.monotonic()
            self._say(instance, is_active=True)

    def end(self, *_: object) -> TransitionCallbackReturn:
        instance, self._instance = self._instance, ""
        if instance:
            self._say(instance, is_active=False)
        return TransitionCallbackReturn.SUCCESS

    on_deactivate = on_cleanup = on_shutdown = on_error = end

    def hear(self, _: type, message: bytes) -> None:
        """Acknowledge the end of the other side, as bondcpp does; the node stays active."""
        said: Any = deserialize_message(message, self._type)
        if said.id == self._node.get_name() and said.instance_id != self._instance and not said.active:
            self.end()

    def _say(self, instance: str, *, is_active: bool) -> None:
        said = self._type(id=self._node.get_name(), instance_id=instance, active=is_active)
        said.header.stamp = self._node.get_clock().now().to_msg()
        said.heartbeat_timeout, said.heartbeat_period = _BOND_TIMEOUT_S, _IDLE_S
        with suppress(RuntimeError):  # the other side notices
            self._publisher.publish(said)


class Ros2Localizer(Publisher, ManagedEntity):
    """A Publisher whose node is visible in the graph from the start, and publishes while active, on a thread of its own.

    Localization runs in every state, so an activated node has a pose at once. Commands reach the robot through its intake.
    """

    def __init__(
        self, section: OutputSection, topics: Topics, robot: str, calibration: RigCalibration, intake: Intake
    ) -> None:
        """See `OutputHook`. Raises UsageError for invalid names, and if ROS 2 does not start."""
        self._robot, self._calibration, self._intake = robot, calibration, intake
        self._grid: OccupancyGrid | None = None
        self._map_words = "none yet"
        self._lifecycle, self._is_active = "unconfigured", False
        self._last: Localized | None = None
        self._fix_refused = ""  # by the newest finished query: most frames finish none
        self._refused = ""  # why the newest initial pose was
        self._alive_s = time.monotonic()
        self._building_from_map: Array | None = None
        self._sent_tf: deque[bytes] = deque(maxlen=_OWN_TF)
        self._other_s, self._other, self._has_faulty_tf = -_OTHER_S, "", False
        self._outgoing: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._is_latched_due = False
        self._beat: Callable[[], None] = lambda: None  # of a bond
        self._ended = threading.Event()
        with ros_started(), ExitStack() as failed:
            self._node = LifecycleNode(section.node, namespace=section.namespace)
            failed.callback(self._node.destroy_node)
            self._section = section = self._declare_parameters(section, topics)
            self.grid_height_m = section.robot_height_m if section.map_topic else None
            offset_s = calibration.cameras[0].imu_minus_cam_s
            self._driver = DriverOdometry(section.odom_frame, section.base_frame, offset_s, self._send_map_link)
            self._reader = MessageReader(self._node, self._declare())
            failed.pop_all()
        self._node.add_managed_entity(self)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        works = [partial(self._reader.read, _IDLE_S), self._send, partial(self._executor.spin_once, _SERVICES_IDLE_S)]
        self._threads = [threading.Thread(target=keep_on, args=(work, self._ended.wait), daemon=True) for work in works]
        for thread, name in zip(self._threads, ("ros messages", "ros sending", "ros services"), strict=True):
            thread.name = name
            thread.start()
        if section.autostart:
            self._node.trigger_configure()
            self._node.trigger_activate()

    def _declare_parameters(self, section: OutputSection, topics: Topics) -> OutputSection:
        """Declare [output] as parameters; return it with what the node was started with instead (--ros-args)."""
        set_keys = {name: value for name, value in msgspec.structs.asdict(section).items() if value is not None}
        given = {name: self._node.declare_parameter(f"output.{name}", value).value for name, value in set_keys.items()}
        for name in _EARLY:
            if given[name] != set_keys[name]:
                hint = "set it in locclient's file, or names by -r __node:= and -r __ns:="
                raise UsageError(f"output.{name} = {given[name]!r} as a parameter of ROS comes too late: {hint}")
        self._node.add_on_set_parameters_callback(self._change_parameters)
        section, named = _changed(section, given), self._node.resolve_topic_name
        topics = msgspec.structs.replace(topics, wheel=topics.wheel and named(topics.wheel))
        check(_changed(section, {"odom_topic": named(section.odom_topic)}), topics)
        return section

    def _declare(self) -> list[Feed]:
        """Declare publishers and services; return the topics to read."""
        section, publisher, service = self._section, self._node.create_publisher, self._node.create_service
        self._placement = publisher(PoseWithCovarianceStamped, section.pose_topic, LATCHED)
        self._tf = publisher(TFMessage, section.tf_topic, 100)
        self._tf_static = publisher(TFMessage, f"{section.tf_topic}_static", LATCHED)
        self._odom = publisher(Odometry, section.odom_topic, 10)
        self._status = publisher(String, section.status_topic, 10)
        self._map = publisher(GridMessage, section.map_topic, LATCHED) if section.map_topic else None
        self._diagnostics = publisher(DiagnosticArray, "/diagnostics", 10)
        feeds = [
            Feed([(section.initial_pose_topic, PoseWithCovarianceStamped)], self._hear_initial_pose),
            Feed([(section.tf_topic, TFMessage)], self._hear_tf, 100),
        ]
        if not section.publish_odom:
            static, hear = (f"{section.tf_topic}_static", TFMessage), self._driver.handle_tf_static
            feeds.append(Feed([static], lambda _, message: hear(message), 100, LATCHED.durability))
        service(EmptyService, "reinitialize_global_localization", self._search_anew)
        service(EmptyService, "request_nomotion_update", lambda _, response: response)
        if find_spec("nav2_msgs") is not None:
            from nav2_msgs.srv import SetInitialPose

            service(SetInitialPose, "set_initial_pose", self._set_initial_pose)
        if find_spec("bond") is not None:
            from bond.msg import Status as BondStatus

            bond = _Bond(self._node, BondStatus)
            self._node.add_managed_entity(bond)
            self._beat = bond.beat
            feeds.append(Feed([("bond", BondStatus)], bond.hear))
        return feeds

    # --- called by the threads of the robot: what is to be sent waits for the thread that sends ------------------------

    def publish(self, estimate: Estimate, published: PublishedPose, base_from_body: Array) -> None:
        """Send the pose of the base in the map; only with its covariance."""
        before, self._last = self._last, (estimate, published)
        if estimate.fix is not None or estimate.refused:
            self._fix_refused = estimate.refused
        building = published.building_from_map if self._section.building_frame else None
        if building is not None and (self._building_from_map is None or (building != self._building_from_map).any()):
            self._building_from_map = building  # stays in tf: static transforms are never withdrawn
            self._is_latched_due = True
        self._post(partial(self._send_frame, before, self._last, base_from_body))

    def alive(self, is_silent: bool) -> None:
        self._alive_s = time.monotonic()
        self._post(partial(self._send_diagnosis, is_silent))

    def show_grid(self, version: int, grid: OccupancyGrid | None, why: str) -> None:
        """Publish the grid. Without one the last grid stays on the topic: all versions of a site share the map's frame."""
        self._map_words = why if grid is None else f"grid of version {version}"
        if grid is None:
            _log.warning("planners get no new map: %s", why)
        else:
            self._grid, self._is_latched_due = grid, True

    def _post(self, work: Callable[[], None]) -> None:
        if not rclpy.ok() or self._outgoing.qsize() >= _WAITING:
            raise LinkError(
                "ROS 2 did not send: was it shut down, or does a subscriber over a slow network hold it up?"
            )
        self._outgoing.put(work)

    def close(self) -> None:
        self._ended.set()
        self._executor.shutdown()
        for thread in self._threads:
            thread.join()
        while not self._outgoing.empty():
            self._send()
        with suppress(RuntimeError):  # it was shut down before
            self._node.trigger_shutdown()
        self._node.destroy_node()

    # --- called by the thread that sends ------------------------------------------------------------------------------

    def _send(self) -> None:
        with suppress(Empty), faults_logged("a message is not sent"):
            if self._is_latched_due and self._is_active:
                self._is_latched_due = False
                self._send_latched()
            self._outgoing.get(timeout=_IDLE_S)()
        if time.monotonic() - self._alive_s < _STUCK_S:
            self._beat()

    def _send_frame(self, before: Localized | None, now: Localized, base_from_body: Array) -> None:
        if not self._is_active:
            return
        section, (estimate, published) = self._section, now
        stamp_ns, odometry_frame = estimate.stamp_ns, section.odom_frame
        map_from_odom, map_from_base = published.map_from_odom, published.map_from_base
        if map_from_odom is not None and map_from_base is not None:
            if section.publish_odom:
                self._send_map_link(stamp_ns, map_from_odom)
            else:
                self._driver.handle_frame(stamp_ns, map_from_base)
            if published.cov_rot_trans is not None:
                prior = PositionPrior(stamp_ns, map_from_base, published.cov_rot_trans)
                self._placement.publish(encode_prior(prior, section.map_frame))
        if section.publish_odom:
            self._send_tf(stamp_ns, FrameLink(section.odom_frame, section.base_frame, published.odom_from_base))
        else:  # the driver's frame differs from that of our odometry
            odometry_frame = f"{section.sensor_frames or OutputSection().sensor_frames}odom"
        if before is not None and estimate.odometry.scale_known and stamp_ns > before[0].stamp_ns:
            motion = motion_between(before, now, base_from_body)
            self._odom.publish(messages.encode_motion(stamp_ns, odometry_frame, section.base_frame, *motion))
        self._status.publish(String(data=estimate.status.value))

    def _send_map_link(self, stamp_ns: int, map_from_odom: Array) -> None:
        if self._is_active:  # the frame may have waited for the driver's pose
            ahead_ns = stamp_ns + int(self._section.transform_tolerance_s * 1e9)
            self._send_tf(ahead_ns, FrameLink(self._section.map_frame, self._section.odom_frame, map_from_odom))

    def _send_tf(self, stamp_ns: int, link: FrameLink) -> None:
        message = encode_frame_links(stamp_ns, [link])
        self._sent_tf.append(message)
        self._tf.publish(message)

    def _send_latched(self) -> None:
        """Send the grid, and all static frames in one message: late subscribers receive only the last message."""
        section, grid, now_ns = self._section, self._grid, self._node.get_clock().now().nanoseconds
        body, links = f"{section.sensor_frames}body", list[FrameLink]()
        if section.sensor_frames:  # under names that no URDF uses: PREFIXbody, PREFIXcam0_optical and so on
            links.append(FrameLink(section.base_frame, body, self._calibration.base_from_body))
            for number, camera in enumerate(self._calibration.cameras):
                links.append(FrameLink(body, f"{section.sensor_frames}cam{number}_optical", camera.body_from_cam))
        if self._building_from_map is not None:
            links.append(FrameLink(section.building_frame, section.map_frame, self._building_from_map))
        if links:
            self._tf_static.publish(encode_frame_links(now_ns, links))
        if grid is not None and self._map is not None:
            height, width = grid.cells.shape
            info = now_ns, grid.resolution_m, width, height, messages.position_quat_xyzw(grid.map_from_grid)
            cells = grid.cells.astype(np.int8).tobytes()
            self._map.publish(pack("nav_msgs/OccupancyGrid", now_ns, section.map_frame, *info, cells))

    def _send_diagnosis(self, is_silent: bool) -> None:
        state = _WARN, "no frame yet"
        values = {"lifecycle": self._lifecycle, "map": self._map_words, "refused_initial_pose": self._refused or None}
        if self._last is not None:
            estimate, published = self._last
            status, cause, cov = estimate.status.value, estimate.cause.value, estimate.cov_rot_trans
            state = _LEVELS.get(estimate.status, _WARN), f"{status}: {cause}" if cause else status
            if estimate.protection_m > self._section.stop_above_m:
                state = _ERROR, f"stop: the protection level is above {self._section.stop_above_m:g} m ({state[1]})"
            values |= {
                "status": status,
                "cause": cause,
                "map_version": "none" if estimate.map_version is None else str(estimate.map_version),
                "refused": self._fix_refused,
                "calibration": estimate.calibration.text,
                "views": estimate.views_in_words or None,
                "radius_95_m": None if cov is None else f"{radius_95_m(cov):.3f}",
                **{name: "none" if level is None else f"{level:.3f}" for name, level in estimate.protection.items()},
            }
            if published.level:
                floors = sorted({hypothesis.floor or "own" for hypothesis in estimate.hypotheses})
                values |= {"floor": estimate.floor or "own", "level": published.level}
                values["hypothesis_floors"] = ", ".join(floors) or None
        findings = [(_ERROR, "no frames come") if is_silent else state]
        findings += [(_WARN, fault) for fault in (*self._reader.faults, *self._intake.source_faults)]
        findings += [(_ERROR, fault) for fault in self._tf_faults()]
        message = DiagnosticStatus(level=max(level for level, _ in findings), hardware_id=self._robot)
        message.name = f"{self._node.get_name()}: localization"
        message.message = "; ".join(words for _, words in findings)
        message.values = [KeyValue(key=key, value=value) for key, value in values.items() if value is not None]
        array = DiagnosticArray(status=[message])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def _tf_faults(self) -> list[str]:
        """Return the reason why /tf is unusable for planners, none if it is usable. Log its begin and end."""
        fault, section = "", self._section
        if time.monotonic() - self._other_s < _OTHER_S:
            fault = f"another program publishes {self._other} too: stop it, or see publish_odom in docs/ros2.md"
        elif not section.publish_odom and self._last is not None:
            missing = self._driver.fault(self._last[0].stamp_ns)
            fault = missing and f"{section.map_frame} -> {section.odom_frame} is not sent: {missing}"
        if bool(fault) != self._has_faulty_tf:
            self._has_faulty_tf = bool(fault)
            _log.warning("%s", fault or "/tf is whole again")
        return [fault] if fault else []

    # --- called by the threads that read, and that serve --------------------------------------------------------------

    def _hear_tf(self, _: type, message: bytes) -> None:
        """Handle transforms of other programs; those sent here are received back as well."""
        section = self._section
        if message in self._sent_tf:
            return
        links = [link for link in decode_frame_links(message) if link.is_usable]
        for link in links:
            is_ours = link.child == section.odom_frame or (link.child == section.base_frame and section.publish_odom)
            if is_ours and self._is_active:
                self._other_s, self._other = time.monotonic(), f"{link.parent} -> {link.child}"
        if not section.publish_odom:
            self._driver.handle_tf(links)

    def _hear_initial_pose(self, _: type, message: bytes) -> None:
        try:
            prior = decode_initial_pose(message, self._section.map_frame)
        except (FleetmapError, ValueError) as error:
            self._refused = str(error)
            raise
        self._refused = ""
        self._intake.put_prior(prior)

    def _set_initial_pose(self, request: Any, response: Any) -> Any:
        with faults_logged("set_initial_pose"):
            self._hear_initial_pose(PoseWithCovarianceStamped, serialize_message(request.pose))
        return response

    def _search_anew(self, _: Any, response: Any) -> Any:
        self._intake.put_forget()
        return response

    def _change_parameters(self, parameters: list[Parameter[Any]]) -> SetParametersResult:
        """Refuse what is read once, at the start, and a tolerance that is none."""
        given = {
            name.removeprefix("output."): each.value for each in parameters if (name := each.name).startswith("output.")
        }
        for name in given.keys() - {_CHANGEABLE}:
            why = "it is read at the start: change it in locclient's file or in the launch file, and start again"
            return SetParametersResult(successful=False, reason=f"output.{name}: {why}")
        try:
            self._section = _changed(self._section, given)
        except msgspec.ValidationError as error:
            return SetParametersResult(successful=False, reason=f"{given}: {error}")
        return SetParametersResult(successful=True)

    def _enter(self, lifecycle: str, _: object) -> TransitionCallbackReturn:
        self._lifecycle, self._is_active, self._is_latched_due = lifecycle, lifecycle == "active", True
        _log.info("the node is %s", lifecycle)
        return TransitionCallbackReturn.SUCCESS

    on_configure = on_deactivate = partialmethod(_enter, "inactive")
    on_activate = partialmethod(_enter, "active")
    on_cleanup = on_error = partialmethod(_enter, "unconfigured")
    on_shutdown = partialmethod(_enter, "finalized")


def _changed(section: OutputSection, given: dict[str, Any]) -> OutputSection:
    """Return the section with other values; ValidationError for one that the settings' file may not have either."""
    return msgspec.convert(msgspec.structs.asdict(section) | given, OutputSection)
