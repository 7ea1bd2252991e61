"""Localization as a managed ROS 2 node, a drop-in for nav2's localizer: topics, services, lifecycle, bond, diagnostics."""

import logging
import threading
import time
from array import array
from collections import deque
from importlib.util import find_spec
from typing import Any

import msgspec
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid as GridMessage
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.lifecycle.managed_entity import ManagedEntity
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from std_srvs.srv import Empty
from tf2_msgs.msg import TFMessage

from fleetmap.errors import FleetmapError
from fleetmap.failure_definition import radius_95_m
from fleetmap.geometry import Array
from fleetmap.messages import Status
from fleetmap.recordings.ros2 import messages
from fleetmap.recordings.ros2.messages import FrameLink, decode_frame_links, encode_frame_links, encode_prior
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import PositionPrior
from fleetmap.sources.intake import Intake
from fleetmap.version_grid import OccupancyGrid
from locclient.localization.estimate import Estimate
from locclient.outputs import OutputSection, Publisher
from locclient.plugins.ros2_node import check_frames
from locclient.plugins.ros2_node.conversions import decode_initial_pose, motion_between, sensor_links
from locclient.plugins.ros2_node.driver_odometry import DriverOdometry
from locclient.plugins.ros2_node.node import (
    LATCHED,
    Feed,
    MessageReader,
    ensure_ros,
    ros_errors,
    ros_sends,
    unconnected,
)
from locclient.robot.continuous_odom import PublishedPose

_IDLE_S = 0.1
_SERVICES_IDLE_S = 1.0  # a wait of rclpy's executor costs 1.2 ms CPU; the end wakes it
_STUCK_S = 3.0  # without a sign of life from the localizing thread, after which the bond is not renewed
_OK, _WARN, _ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
_LEVELS = {Status.TRACKING: _OK, Status.LOST: _ERROR}
_CHANGEABLE = "output.transform_tolerance_s"
_OWN_TF = 256  # last sent messages, to recognize them when they are received back
_OTHER_S = 5.0  # another publisher is reported for so long after its last transform
_log = logging.getLogger(__name__)


class Ros2Localizer(Publisher, ManagedEntity):
    """A Publisher whose node is visible in the graph from the start, and publishes while active.

    Localization runs in every state, so an activated node has a pose at once. Commands reach the robot through its intake.
    """

    def __init__(self, section: OutputSection, robot: str, calibration: RigCalibration, intake: Intake) -> None:
        """See `OutputHook`. Raises UsageError for invalid names, and if ROS 2 does not start."""
        self._robot, self._calibration, self._intake = robot, calibration, intake
        with ros_errors():
            ensure_ros()
            self._node = LifecycleNode(section.node, namespace=section.namespace or None)
            self._section = section = self._declare_parameters(section)
        check_frames(section)
        self.grid_height_m = section.robot_height_m if section.map_topic else None
        self._grid: OccupancyGrid | None = None
        self._map_words = "none yet"
        self._lifecycle = "unconfigured"
        self._last: tuple[Estimate, PublishedPose] | None = None
        self._fix_refused = ""  # by the newest finished query: most frames finish none
        self._refused = ""  # why the newest initial pose was
        self._alive_s = time.monotonic()
        self._building_from_map: Array | None = None
        self._sent_tf: deque[bytes] = deque(maxlen=_OWN_TF)
        self._other_s, self._other = -_OTHER_S, ""
        self._has_faulty_tf, self._unconnected = False, list[str]()
        offset_s = calibration.cameras[0].imu_minus_cam_s
        self._driver = DriverOdometry(section.odom_frame, section.base_frame, offset_s, self._send_map_link)
        with ros_errors():
            reader = MessageReader(self._node, self._declare())
        self._node.add_managed_entity(self)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._ended = threading.Event()
        works = {"ros messages": lambda: self._read(reader), "ros services": self._serve}
        self._threads = [threading.Thread(target=work, name=name, daemon=True) for name, work in works.items()]
        for thread in self._threads:
            thread.start()
        if section.autostart:
            self._node.trigger_configure()
            self._node.trigger_activate()

    def _declare_parameters(self, section: OutputSection) -> OutputSection:
        """Declare [output] as parameters; return it with what the node was started with instead (--ros-args)."""
        given = {name: value for name, value in msgspec.structs.asdict(section).items() if value is not None}
        given = {name: self._node.declare_parameter(f"output.{name}", value).value for name, value in given.items()}
        self._node.add_on_set_parameters_callback(self._change_parameters)
        return _changed(section, given)

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
            static = [(f"{section.tf_topic}_static", TFMessage)]
            hear = lambda _, message: self._driver.handle_tf_static(message)  # noqa: E731
            feeds.append(Feed(static, hear, 100, LATCHED.durability))
        service(Empty, "reinitialize_global_localization", self._search_anew)
        service(Empty, "request_nomotion_update", lambda _, response: response)
        self._bond = None
        if find_spec("nav2_msgs") is not None:
            from nav2_msgs.srv import SetInitialPose

            service(SetInitialPose, "set_initial_pose", self._set_initial_pose)
        if find_spec("bond") is not None:
            from locclient.plugins.ros2_node.bond import Bond

            self._bond = Bond(self._node)
            feeds.append(self._bond.feed)
        return feeds

    # --- called by the thread that localizes --------------------------------------------------------------------------

    @ros_sends()
    def publish(self, estimate: Estimate, published: PublishedPose, base_from_body: Array) -> None:
        """Send the pose of the base in the map; only with its covariance."""
        before, self._last = self._last, (estimate, published)
        if estimate.fix is not None or estimate.refused:
            self._fix_refused = estimate.refused
        if not self._is_active:
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
                self._placement.publish(encode_prior(prior, section.map_frame))
        odometry_frame = section.odom_frame
        if section.publish_odom:
            self._send_tf(stamp_ns, FrameLink(section.odom_frame, section.base_frame, published.odom_from_base))
        else:  # the driver's frame differs from that of our odometry
            odometry_frame = f"{section.sensor_frames or OutputSection().sensor_frames}odom"
        if before is not None and estimate.odometry.scale_known and stamp_ns > before[0].stamp_ns:
            motion = motion_between(before, (estimate, published), base_from_body)
            self._odom.publish(messages.encode_motion(stamp_ns, odometry_frame, section.base_frame, *motion))
        self._status.publish(String(data=estimate.status.value))

    def _send_map_link(self, stamp_ns: int, map_from_odom: Array) -> None:
        if not self._is_active:  # deactivated while the frame waited for the driver's pose
            return
        ahead_ns = stamp_ns + int(self._section.transform_tolerance_s * 1e9)
        self._send_tf(ahead_ns, FrameLink(self._section.map_frame, self._section.odom_frame, map_from_odom))

    def _send_tf(self, stamp_ns: int, link: FrameLink) -> None:
        message = encode_frame_links(stamp_ns, [link])
        self._sent_tf.append(message)
        self._tf.publish(message)

    @ros_sends()
    def alive(self, is_silent: bool) -> None:
        self._alive_s = time.monotonic()
        level, words, values = self._diagnosis(is_silent)
        status = DiagnosticStatus(level=level, message=words, hardware_id=self._robot)
        status.name = f"{self._node.get_name()}: localization"
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def _diagnosis(self, is_silent: bool) -> tuple[bytes, str, dict[str, str]]:
        """Return level, message and values of a diagnostic_msgs/DiagnosticStatus."""
        estimate = None if self._last is None else self._last[0]
        level, words = _WARN, "no frame yet"
        values = {"lifecycle": self._lifecycle, "map": self._map_words}
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
        before, self._unconnected = self._unconnected, unconnected(self._node)
        for pair in self._unconnected:
            level, words = max(level, _WARN), f"{words}; {pair}"
            if pair not in before:
                _log.warning("%s", pair)
        if fault := self._tf_fault():
            level, words = _ERROR, f"{words}; {fault}"
        if is_silent:
            level, words = _ERROR, "no frames come"
        if refused := self._refused:
            values["refused_initial_pose"] = refused
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

    @ros_sends()
    def show_grid(self, version: int, grid: OccupancyGrid | None, why: str) -> None:
        """Publish the grid. Without one the last grid stays on the topic: all versions of a site share the map's frame."""
        self._map_words = why if grid is None else f"grid of version {version}"
        if grid is None:
            _log.warning("planners get no new map: %s", why)
            return
        self._grid = grid
        if self._is_active:
            self._send_latched()

    def close(self) -> None:
        self._ended.set()
        self._executor.shutdown()
        for thread in self._threads:
            thread.join()
        self._end_bond()
        self._node.destroy_node()

    # --- called by threads of ROS 2 -----------------------------------------------------------------------------------

    def _read(self, reader: MessageReader) -> None:
        while not self._ended.is_set():
            reader.read(_IDLE_S)
            if self._bond is not None and time.monotonic() - self._alive_s < _STUCK_S:
                self._bond.beat()

    def _serve(self) -> None:
        while not self._ended.is_set():
            try:
                self._executor.spin_once(timeout_sec=_SERVICES_IDLE_S)
            except Exception:  # no request of another program ends the robot's localization
                _log.exception("a request to the node failed")

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
        try:
            self._hear_initial_pose(PoseWithCovarianceStamped, serialize_message(request.pose))
        except (FleetmapError, ValueError) as error:
            _log.warning("set_initial_pose: %s", error)
        return response

    def _search_anew(self, _: Any, response: Any) -> Any:
        self._intake.put_forget()
        return response

    def _change_parameters(self, parameters: list[Parameter[Any]]) -> SetParametersResult:
        """Refuse what is read once, at the start, and a tolerance that is none."""
        for parameter in parameters:
            if parameter.name != _CHANGEABLE and parameter.name.startswith("output."):
                why = "it is read at the start: change it in locclient's file or in the launch file, and start again"
                return SetParametersResult(successful=False, reason=f"{parameter.name}: {why}")
        given = {each.name.removeprefix("output."): each.value for each in parameters if each.name == _CHANGEABLE}
        try:
            self._section = _changed(self._section, given)
        except msgspec.ValidationError as error:
            return SetParametersResult(successful=False, reason=f"{_CHANGEABLE} = {given}: {error}")
        return SetParametersResult(successful=True)

    # --- lifecycle: called by the thread of services, in the constructor if the node starts by itself -----------------

    @property
    def _is_active(self) -> bool:
        return self._lifecycle == "active"

    def on_activate(self, _: object) -> TransitionCallbackReturn:
        self._enter("active")
        self._send_latched()
        if self._bond is not None:
            self._bond.begin()
        return TransitionCallbackReturn.SUCCESS

    def on_configure(self, _: object) -> TransitionCallbackReturn:
        return self._enter("inactive")

    on_deactivate = on_configure

    def on_cleanup(self, _: object) -> TransitionCallbackReturn:
        return self._enter("unconfigured")

    on_error = on_cleanup

    def on_shutdown(self, _: object) -> TransitionCallbackReturn:
        return self._enter("finalized")

    def _enter(self, lifecycle: str) -> TransitionCallbackReturn:
        self._lifecycle = lifecycle
        self._end_bond()
        _log.info("the node is %s", lifecycle)
        return TransitionCallbackReturn.SUCCESS

    def _end_bond(self) -> None:
        if self._bond is not None:
            self._bond.end()

    def _send_latched(self) -> None:
        self._send_static_frames()
        if self._grid is not None and self._map is not None:
            self._map.publish(grid_message(self._node.get_clock().now().to_msg(), self._section.map_frame, self._grid))

    def _send_static_frames(self) -> None:
        """Send all static frames in one message: late subscribers receive only the last message."""
        section = self._section
        links = sensor_links(section, self._calibration) if section.sensor_frames else []
        if self._building_from_map is not None:
            links.append(FrameLink(section.building_frame, section.map_frame, self._building_from_map))
        if links:
            self._tf_static.publish(encode_frame_links(self._node.get_clock().now().nanoseconds, links))


def _changed(section: OutputSection, given: dict[str, Any]) -> OutputSection:
    """Return the section with other values; ValidationError for one that the settings' file may not have either."""
    return msgspec.convert(msgspec.structs.asdict(section) | given, OutputSection)


def grid_message(stamp: Any, frame_id: str, grid: OccupancyGrid) -> GridMessage:
    """Return a nav_msgs/OccupancyGrid."""
    message = GridMessage()
    message.header.stamp, message.header.frame_id = stamp, frame_id
    info, (x_m, y_m, z_m, *xyzw) = message.info, messages.position_quat_xyzw(grid.map_from_grid).tolist()
    info.map_load_time, info.resolution, (info.height, info.width) = stamp, grid.resolution_m, grid.cells.shape
    info.origin.position.x, info.origin.position.y, info.origin.position.z = x_m, y_m, z_m
    turn = info.origin.orientation
    turn.x, turn.y, turn.z, turn.w = xyzw
    message.data = array("b", np.ascontiguousarray(grid.cells, np.int8).tobytes())
    return message
