"""The localizer as nav2 sees it, over zenoh on loopback, in the configuration of rmw_zenoh, and estimates on its topics."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from fleetmap.bus.endpoints import with_free_port
from fleetmap.bus.zenoh_bus import Bus
from fleetmap.errors import UsageError
from fleetmap.geometry import se3, se3_inverse, so3_exp
from fleetmap.messages import Status
from fleetmap.recordings.ros2.cdr import unpack
from fleetmap.recordings.ros2.messages import decode_frame_links, decode_prior
from fleetmap.sensors.source_settings import SourceSection, Topics
from fleetmap.sources.intake import Intake
from fleetmap.sources.source import open_source
from fleetmap.version_grid import OccupancyGrid
from locclient.daemon.publishers import output_of
from locclient.localization.estimate import Estimate
from locclient.outputs import OutputSection
from locclient.plugins.ros2_node.keys import RmwZenohKeys
from locclient.plugins.ros2_node.localizer import OUTPUT, Ros2Localizer
from locclient.robot.continuous_odom import ContinuousOdom
from support.fleet.estimates import BASE_FROM_BODY, estimate, inputs, published
from support.fleet.memory_bus import MemoryBus, MemoryHub
from support.fleet.nav2_client import (
    ACTIVE,
    FINALIZED,
    INACTIVE,
    UNCONFIGURED,
    LifecycleManager,
    RosProgram,
    eventually,
    rmw_router,
)
from support.recordings.recording_samples import calibration

NODE = "fleetmap_localizer"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
INITIAL = (0.25, 0.25, 0.0, 0.0, 0.0, 0.0685)  # as RViz sends it


@dataclass
class Robot:
    """A localizer, its intake, and what opens programs of the same ROS 2."""

    endpoint: str
    localizer: Ros2Localizer
    intake: Intake
    open: Callable[[], LifecycleManager]
    bus: Bus

    def tell(self, *estimates: object) -> None:
        odom = ContinuousOdom(np.eye(4))
        for one in estimates:
            self.localizer.publish(one, odom.handle(one), np.eye(4))  # type: ignore[arg-type]


@pytest.fixture
def robot(request: pytest.FixtureRequest) -> Iterator[Robot]:
    settings = {"format": "ros2", "autostart": False} | getattr(request, "param", {})
    programs: list[LifecycleManager] = []
    endpoint = with_free_port("tcp/127.0.0.1:0")
    with rmw_router(endpoint), Bus.connect(endpoint, is_ros=True) as bus:
        intake = Intake(frames=2, imu_minus_cam_s=0.0, has_imu=False, imu_wait_s=0.0)
        inputs = (bus, "hall", "r1", calibration(), intake)
        localizer = OUTPUT.open(OutputSection(**settings), *inputs)
        assert isinstance(localizer, Ros2Localizer)

        def opened() -> LifecycleManager:
            programs.append(LifecycleManager(endpoint, NODE))
            return programs[-1]

        yield Robot(endpoint, localizer, intake, opened, bus)
        for program in programs:
            program.close()
        localizer.close()


def initial_pose(program: RosProgram, *, frame: str = "map", variances: tuple[float, ...] = INITIAL) -> object:
    """At (2, 1), turned by 90 degrees."""
    types, half = program.store.types, np.sqrt(0.5)
    placed = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](2.0, 1.0, 0.0), types["geometry_msgs/msg/Quaternion"](0.0, 0.0, half, half)
    )
    covariance = np.diag(np.array(variances, float)).ravel()
    return types[POSE](program.header(frame), types["geometry_msgs/msg/PoseWithCovariance"](placed, covariance))


def taken(robot: Robot) -> object:
    """What reaches the robot with its next frame."""
    from fleetmap.recordings import StoredFrame
    from fleetmap.recordings.images import grey_image

    image = grey_image(np.zeros((4, 4), np.uint8))
    robot.intake.put_frame(StoredFrame(robot.intake.counts.frames + 1, image, None, image))
    return robot.intake.take(1.0)


def test_the_graph_shows_one_node_with_all_that_nav2_asks_for(robot: Robot) -> None:
    program = robot.open()
    tokens: list[list[str]] = []

    def is_complete() -> bool:
        """The node, nine publishers, three subscriptions, eight services."""
        tokens[:] = [parts for parts in program.graph() if parts[8] == NODE]
        return len(tokens) == 21

    assert eventually(is_complete)
    (node,) = [parts for parts in tokens if parts[5] == "NN"]
    assert node[:2] + node[3:] == ["@ros2_lv", "0", "0", "0", "NN", "%", "%", NODE]
    assert {parts[2] for parts in tokens} == {str(robot.bus.session_id())}
    assert len({parts[4] for parts in tokens}) == len(tokens)
    latched, plain = ":1:,1:,:,:,,", "::,10:,:,:,,"
    qos = {(parts[5], parts[9]): parts[12] for parts in tokens if parts[5] != "NN"}
    assert {name for (kind, name), one in qos.items() if one == latched and kind == "MP"} == {
        "%amcl_pose", "%tf_static", "%map",
    }  # fmt: skip
    assert qos["MP", "%tf"] == "::,100:,:,:,,"
    assert qos["MS", "%initialpose"] == qos["SS", "%reinitialize_global_localization"] == plain
    services = {name for kind, name in qos if kind == "SS"}
    private = ("get_state", "change_state", "get_available_states", "get_available_transitions")
    assert services == {
        *(f"%{NODE}%{name}" for name in (*private, "get_transition_graph")), "%set_initial_pose",
        "%reinitialize_global_localization", "%request_nomotion_update",
    }  # fmt: skip
    store = get_typestore(Stores.ROS2_JAZZY)
    for parts in tokens:
        if parts[5] in {"MP", "MS"} and "bond" not in parts[10]:
            package, _, _, name = parts[10].split("::")
            assert parts[11] == store.hash_rihs01(f"{package}/msg/{name.removesuffix('_')}"), parts[10]
    robot.localizer.close()
    assert eventually(lambda: not [parts for parts in program.graph() if parts[8] == NODE])


def test_the_lifecycle_manager_brings_it_up_and_down(robot: Robot) -> None:
    manager = robot.open()
    events = manager.listen(f"/{NODE}/transition_event", "lifecycle_msgs/msg/TransitionEvent")
    assert manager.state() == UNCONFIGURED
    assert not manager.change(3), "activation does not begin here"
    assert not manager.change(99)
    assert not manager.change(0, "nonsense")
    assert manager.state() == UNCONFIGURED
    robot.tell(estimate(1.0), estimate(1.1))
    assert manager.startup()
    manager.tell_bond(active=True)
    assert manager.beats[0].instance_id
    assert manager.beats[0].heartbeat_period == pytest.approx(0.1)
    assert not manager.change(1), "it is configured already"
    available = manager.call(f"/{NODE}/get_available_transitions", "lifecycle_msgs/srv/GetAvailableTransitions")
    assert [one.transition.label for one in available.available_transitions] == ["deactivate", "shutdown"]
    states = manager.call(f"/{NODE}/get_available_states", "lifecycle_msgs/srv/GetAvailableStates")
    assert [(one.id, one.label) for one in states.available_states][:5] == [
        (0, "unknown"), (1, "unconfigured"), (2, "inactive"), (3, "active"), (4, "finalized"),
    ]  # fmt: skip
    assert manager.change(0, "deactivate"), "by its label"
    assert eventually(lambda: not manager.beats[-1].active), "the bond ends with the active state"
    assert manager.state() == INACTIVE
    assert manager.change(2)
    assert manager.change(5)
    assert manager.state() == FINALIZED
    assert not manager.change(1)
    assert eventually(lambda: len(events) == 10)
    assert [(one.start_state.label, one.goal_state.label) for one in events[:2]] == [
        ("unconfigured", "configuring"), ("configuring", "inactive"),
    ]  # fmt: skip


def test_the_bond_ends_with_the_manager_and_with_a_robot_that_is_stuck(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    manager = robot.open()
    assert manager.startup()
    monkeypatch.setattr("locclient.plugins.ros2_node.localizer._STUCK_S", -1.0)
    assert eventually(
        lambda: (count := len(manager.beats)) > 0 and not eventually(lambda: len(manager.beats) > count, 0.5)
    )
    assert manager.beats[-1].active, "silence, not an end: the manager finds out by its timeout"
    manager.tell_bond(active=False)
    assert eventually(lambda: not manager.beats[-1].active), "the end is acknowledged"
    assert manager.state() == ACTIVE


def test_nothing_is_told_before_activation_and_late_subscribers_get_the_last_pose(robot: Robot) -> None:
    manager = robot.open()
    early = manager.listen("/amcl_pose", POSE, is_transient_local=True)
    links = manager.listen("/tf", "tf2_msgs/msg/TFMessage")
    robot.tell(estimate(0.5), estimate(0.6))
    assert not eventually(lambda: bool(early or links), 0.5)
    assert manager.startup()
    robot.tell(estimate(1.0, x_m=1.0), estimate(1.1, x_m=2.0, sigma_m=0.1))
    assert eventually(lambda: bool(early) and early[-1].pose.pose.position.x == 2.0)
    robot.tell(estimate(2.0, Status.LOST, known=False))
    late = robot.open()
    heard = late.listen("/amcl_pose", POSE, is_transient_local=True)
    assert eventually(lambda: len(heard) == 1), "BasicNavigator waits for it"
    assert heard[0].header.frame_id == "map"
    assert heard[0].pose.pose.position.x == 2.0
    np.testing.assert_allclose(np.diag(heard[0].pose.covariance.reshape(6, 6)), [0.01] * 3 + [1e-4] * 3)
    frames = late.listen("/tf_static", "tf2_msgs/msg/TFMessage", is_transient_local=True)
    assert eventually(lambda: len(frames) == 1)
    found = [(one.header.frame_id, one.child_frame_id) for one in frames[0].transforms]
    assert found == [
        ("base_link", "fleetmap_body"),
        ("fleetmap_body", "fleetmap_cam0_optical"),
        ("fleetmap_body", "fleetmap_cam1_optical"),
    ]
    volatile = late.listen("/tf", "tf2_msgs/msg/TFMessage")
    assert not eventually(lambda: bool(volatile), 0.5)


def test_odometry_has_a_twist_in_the_axes_of_the_base(robot: Robot) -> None:
    program = robot.open()
    assert program.startup()
    heard = program.listen("/visual_odom", "nav_msgs/msg/Odometry")
    assert eventually(lambda: robot.tell(estimate(1.0), estimate(1.5, x_m=0.4)) or bool(heard), 5.0)  # type: ignore[func-returns-value]
    odometry = heard[-1]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    assert odometry.pose.pose.position.x == pytest.approx(10.4)
    assert odometry.twist.twist.linear.x == pytest.approx(0.8)
    assert odometry.twist.twist.angular.z == pytest.approx(0.0)
    variances = np.diag(odometry.twist.covariance.reshape(6, 6))
    assert (variances > 0).all()
    assert np.sqrt(variances[0]) < 0.05


def test_an_initial_pose_reaches_the_robot_by_topic_and_by_service(robot: Robot) -> None:
    program = robot.open()
    program.publish("/initialpose", POSE, initial_pose(program))
    assert eventually(lambda: bool(robot.intake._priors))
    (prior,) = taken(robot).priors  # type: ignore[attr-defined]
    assert prior.is_revisable
    np.testing.assert_allclose(prior.map_from_base[:3, 3], [2, 1, 0])
    np.testing.assert_allclose(prior.map_from_base[:2, 0], [0, 1], atol=1e-12)
    np.testing.assert_allclose(np.diag(prior.cov_rot_trans)[[2, 3, 4]], [0.0685, 0.25, 0.25])
    assert (np.diag(prior.cov_rot_trans) > 0).all(), "what is left at zero is not known exactly"
    said_nothing = initial_pose(program, variances=(0.0,) * 6)  # as BasicNavigator sends it
    assert program.call("/set_initial_pose", "nav2_msgs/srv/SetInitialPose", said_nothing) is not None
    (prior,) = taken(robot).priors  # type: ignore[attr-defined]
    assert np.diag(prior.cov_rot_trans)[3] == pytest.approx(0.25)


def test_a_behaviour_tree_may_have_it_search_anew(robot: Robot) -> None:
    program = robot.open()
    program.publish("/initialpose", POSE, initial_pose(program))
    assert eventually(lambda: bool(robot.intake._priors))
    assert program.call("/reinitialize_global_localization", "std_srvs/srv/Empty") is not None
    bundle = taken(robot)
    assert (bundle.forget, bundle.priors) == (True, [])  # type: ignore[attr-defined]
    assert program.call("/request_nomotion_update", "std_srvs/srv/Empty") is not None
    assert not taken(robot).forget  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"frame": "odom"}, "frame 'odom'"),
        ({"variances": (np.nan, 0.25, 0, 0, 0, 0.07)}, "NaN"),
        ({"variances": (np.inf, 0.25, 0, 0, 0, 0.07)}, "infinity"),
        ({"variances": (-1.0, 0.25, 0, 0, 0, 0.07)}, "positive"),
    ],
)
def test_an_initial_pose_that_cannot_be_used_is_refused_and_named(
    robot: Robot, change: dict[str, object], reason: str
) -> None:
    program = robot.open()
    message = initial_pose(program, **change)  # type: ignore[arg-type]
    assert program.call("/set_initial_pose", "nav2_msgs/srv/SetInitialPose", message) is None
    assert reason in program.errors[-1]
    assert taken(robot).priors == []  # type: ignore[attr-defined]
    heard = program.listen("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    assert eventually(lambda: robot.localizer.alive(False) or bool(heard), 5.0)  # type: ignore[func-returns-value]
    values = {one.key: one.value for one in heard[-1].status[0].values}
    assert reason in values["refused_initial_pose"]


def test_bytes_that_are_no_message_change_nothing(robot: Robot, caplog: pytest.LogCaptureFixture) -> None:
    program = robot.open()
    for raw in (b"", b"\x00\x01\x00\x00", b"nonsense", b"\x00\x01\x00\x00" + bytes(17)):
        program.publish("/initialpose", POSE, raw)
        program.publish("/bond", "bond/msg/Status", raw)
        for service in ("lifecycle_msgs/srv/ChangeState", "nav2_msgs/srv/SetInitialPose"):
            name = f"/{NODE}/change_state" if "ChangeState" in service else "/set_initial_pose"
            answer = program.call(name, service, raw=raw)
            assert answer is None or not getattr(answer, "success", False)
    assert program.state() == UNCONFIGURED
    assert taken(robot).priors == []  # type: ignore[attr-defined]
    assert "initialpose" in caplog.text


@pytest.mark.parametrize(
    ("estimates", "silent", "level", "words", "refused"),
    [
        ([], False, 1, "no frame yet", None),
        ([estimate(1.0)], False, 0, "TRACKING", ""),
        (
            [estimate(1.0, Status.AMBIGUOUS, refused="2 places"), estimate(1.1, Status.AMBIGUOUS)],
            False,
            1,
            "AMBIGUOUS",
            "2 places",
        ),
        ([estimate(1.0, Status.AMBIGUOUS, refused="2 places"), estimate(1.1, fix=True)], False, 0, "TRACKING", ""),
        ([estimate(1.0, Status.LOST)], False, 2, "LOST", ""),
        ([estimate(1.0)], True, 2, "no frames come", ""),
    ],
)
def test_diagnostics_say_status_and_cause(
    estimates: list[Estimate], silent: bool, level: int, words: str, refused: str | None
) -> None:
    hub, heard = MemoryHub(), []  # type: ignore[var-annotated]
    with MemoryBus(hub) as bus, MemoryBus(hub) as other:
        inputs = (bus, "hall", "r1", calibration(), Intake(frames=1, imu_minus_cam_s=0, has_imu=False, imu_wait_s=0))
        other.subscribe(
            RmwZenohKeys(0).key("/diagnostics", "diagnostic_msgs/DiagnosticArray"), lambda _, data: heard.append(data)
        )
        localizer = OUTPUT.open(OutputSection(format="ros2"), *inputs)
        odom = ContinuousOdom(np.eye(4))
        for one in estimates:
            localizer.publish(one, odom.handle(one), np.eye(4))
        localizer.alive(silent)
        localizer.close()
    (told,) = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr(heard[-1], "diagnostic_msgs/msg/DiagnosticArray").status
    assert (int.from_bytes(told.level) if isinstance(told.level, bytes) else told.level, told.message) == (level, words)
    assert (told.name, told.hardware_id) == (f"{NODE}: localization", "r1")
    assert {value.key: value.value for value in told.values}.get("refused") == refused  # that of the newest query


def test_planners_get_the_grid_of_the_version(robot: Robot) -> None:
    program = robot.open()
    assert program.startup()
    diagnoses = program.listen("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    early = robot.open().listen("/map", "nav_msgs/msg/OccupancyGrid", is_transient_local=True)
    robot.localizer.show_grid(4, None, "version 4 has no grid")
    assert eventually(lambda: bool(robot.localizer.alive(False) or diagnoses))
    shown = OccupancyGrid(np.array([[0, 100], [-1, 0]], np.int8), 0.05, se3(np.eye(3), np.array([-1.5, 2.0, 0.0])))
    robot.localizer.show_grid(5, shown, "")
    late = robot.open().listen("/map", "nav_msgs/msg/OccupancyGrid", is_transient_local=True)
    assert eventually(lambda: len(early) == len(late) == 1)
    assert early[0].data.tolist() == late[0].data.tolist() == [0, 100, -1, 0]
    assert (late[0].info.width, late[0].info.origin.position.x, late[0].header.frame_id) == (2, -1.5, "map")
    assert eventually(
        lambda: robot.localizer.alive(False) or "grid of version 5" in str(diagnoses[-1].status[0].values)
    )
    assert "version 4 has no grid" in str(diagnoses[0].status[0].values)


def test_names_that_are_none_are_refused_at_once() -> None:
    with MemoryBus(MemoryHub()) as bus:
        inputs = (bus, "hall", "r1", calibration(), Intake(frames=1, imu_minus_cam_s=0, has_imu=False, imu_wait_s=0))
        with pytest.raises(UsageError, match="a b"):
            OUTPUT.open(OutputSection(format="ros2", pose_topic="a b"), *inputs)
        with pytest.raises(UsageError, match="cyclone"):
            OUTPUT.open(OutputSection(format="ros2", keys="cyclone"), *inputs)
        plain = OUTPUT.open(OutputSection(format="ros2", map_topic=""), *inputs)
        assert plain.grid_height_m is None, "another program publishes the map"
        plain.close()


def test_a_source_of_topics_needs_a_calibration() -> None:
    with pytest.raises(UsageError, match="camchain"):
        open_source(SourceSection(), Topics())


def test_ros_topics_hold_the_same() -> None:
    tracked = estimate(5.0, x_m=2.0, sigma_m=0.1)
    told = published(OutputSection(format="ros2", domain=3), tracked, estimate(6.0, Status.LOST, known=False))
    expected = tracked.map_from_body @ se3_inverse(BASE_FROM_BODY)
    stamped = told[RmwZenohKeys(3).key("/amcl_pose", "geometry_msgs/PoseWithCovarianceStamped")]
    assert len(stamped) == 1
    prior = decode_prior(stamped[0])
    np.testing.assert_allclose(prior.map_from_base, expected, atol=1e-12)
    levers_m2 = np.array([0.2**2 + 0.5**2, 0.5**2, 0.2**2])  # of the base about the body, which is turned by 90 degrees
    np.testing.assert_allclose(np.diag(prior.cov_rot_trans), [*[1e-4] * 3, *(0.01 + 1e-4 * levers_m2)])
    links = [
        link
        for payload in told[RmwZenohKeys(3).key("/tf", "tf2_msgs/TFMessage")]
        for link in decode_frame_links(payload)
    ]
    assert [(link.parent, link.child) for link in links] == [("map", "odom"), *[("odom", "base_link")] * 2]
    np.testing.assert_allclose(links[0].parent_from_child @ links[1].parent_from_child, expected, atol=1e-12)
    states = told[RmwZenohKeys(3).key("/localization/status", "std_msgs/String")]
    assert [unpack("std_msgs/String", state) for state in states] == [["TRACKING"], ["LOST"]]


def test_the_building_is_told_once_the_map_says_it() -> None:
    """Beside the cameras' frames, in one message: late subscribers get the last one alone. Not again with every frame."""
    building_from_map = se3(so3_exp(np.array([0.0, 0.0, 0.5])), np.array([3.0, -4.0, 0.0]))
    section = OutputSection(format="ros2", building_frame="building")
    hub, heard = MemoryHub(), []
    key = RmwZenohKeys(0).key("/tf_static", "tf2_msgs/TFMessage")
    with MemoryBus(hub) as bus, MemoryBus(hub) as other:
        other.subscribe(key, lambda _, payload: heard.append(decode_frame_links(payload)))
        publisher = output_of(section).open(section, *inputs(bus))
        odom = ContinuousOdom(BASE_FROM_BODY)
        for known in (None, building_from_map, building_from_map.copy(), None):
            one = estimate(5.0)
            placed = replace(odom.handle(one), building_from_map=known)
            publisher.publish(one, placed, BASE_FROM_BODY)  # type: ignore[arg-type]
        publisher.close()
    assert [len(links) for links in heard] == [3, 4]
    assert (heard[1][3].parent, heard[1][3].child) == ("building", "map")
    np.testing.assert_allclose(heard[1][3].parent_from_child, building_from_map, atol=1e-12)
    told = published(OutputSection(format="ros2"), estimate(5.0))
    assert [len(decode_frame_links(payload)) for payload in told[key]] == [3]
