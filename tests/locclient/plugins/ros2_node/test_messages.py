"""Every ROS 2 message that the project writes is read by rosbags, an independent library, with the values that went in; keys and
attachments are those of ROS 2's own middleware."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from zenoh.ext import Int64, z_deserialize

from fleetmap.errors import UsageError
from fleetmap.geometry import quat_wxyz_from_rotation, se3, so3_exp
from fleetmap.recordings.images import grey_image, png_image
from fleetmap.recordings.ros2 import messages
from fleetmap.recordings.ros2.cdr import pack
from fleetmap.sensors.samples import PositionPrior, WheelSample
from fleetmap.version_grid import OccupancyGrid
from locclient.plugins.ros2_node.keys import (
    DEFINITIONS,
    LATCHED,
    BridgedDdsKeys,
    Endpoint,
    NodeName,
    Qos,
    RmwZenohKeys,
    attachment,
    service_definitions,
    type_hash,
)
from locclient.plugins.ros2_node.localizer import (
    EMPTY,
    TRANSITIONS,
    LifecycleState,
    encode_grid,
    encode_transitions,
    named,
    step_values,
)
from support.fleet.nav2_client import message_name, typestore
from support.recordings.realdata import real_data
from support.recordings.recording_samples import calibration

STAMP_NS = 1_700_000_000_123_456_789
PLACE = se3(so3_exp(np.array([0.1, -0.2, 0.7])), np.array([1.5, -2.5, 0.25]))
COV = np.diag([1.0, 2, 3, 4, 5, 6])
MOTION = PLACE, COV[messages.HALVES_SWAPPED], np.arange(6.0), np.diag(np.arange(6.0))
GRID = OccupancyGrid(np.array([[0, 100, -1], [50, 0, 0]], np.int8), 0.05, PLACE)
DIAGNOSES = [(2, "a", "bc", "r1", [("k", "v"), ("", "ü")]), (0, "", "", "", [])]
STORE = typestore()


@dataclass(frozen=True)
class Written:
    """Bytes of one message, its type, and what must be read from it, by path."""

    type_name: str
    data: bytes
    expected: dict[str, object]


def response(service: str) -> str:
    return message_name(service, "Response")


def stamped(type_name: str, data: bytes, frame: str, /, **expected: object) -> Written:
    wanted = {"header.stamp.sec": 1_700_000_000, "header.stamp.nanosec": 123_456_789, "header.frame_id": frame}
    return Written(type_name, data, wanted | {key.replace("__", "."): value for key, value in expected.items()})


def written() -> list[Written]:
    camera, wheel = calibration().cameras[0], WheelSample(STAMP_NS, np.array([1.0, 2, 3]), 0.5, 0.1, 0.2)
    link = messages.FrameLink("map", "odom", PLACE)
    xyzw = quat_wxyz_from_rotation(PLACE[:3, :3])[[1, 2, 3, 0]]
    image, prior = grey_image(np.arange(6, dtype=np.uint8).reshape(2, 3)), PositionPrior(STAMP_NS, PLACE, COV)
    event = pack("lifecycle_msgs/TransitionEvent", STAMP_NS, *step_values(TRANSITIONS[2].steps[0]))
    transitions = encode_transitions(TRANSITIONS, with_success=True)
    return [
        stamped("sensor_msgs/msg/Image", messages.encode_image(STAMP_NS, "c", image), "c", width=3, height=2, data=np.arange(6)),
        stamped(
            "sensor_msgs/msg/CompressedImage",
            messages.encode_compressed_image(STAMP_NS, "c", png_image(np.eye(3, dtype=np.uint8)), "png"), "c", format="png",
        ),
        stamped("sensor_msgs/msg/CameraInfo", messages.encode_camera_info(STAMP_NS, "c", camera), "c", width=camera.width_px),
        stamped(
            "sensor_msgs/msg/Imu", messages.encode_imu(STAMP_NS, "i", np.arange(3.0), np.arange(3.0, 6.0)), "i",
            angular_velocity__z=2.0, linear_acceleration__x=3.0,
        ),
        stamped("nav_msgs/msg/Odometry", messages.encode_odometry(wheel, "o", "b"), "o", twist__twist__linear__y=2.0),
        stamped(
            "nav_msgs/msg/Odometry", messages.encode_motion(STAMP_NS, "o", "b", *MOTION), "o", child_frame_id="b",
            pose__pose__position__y=-2.5, pose__pose__orientation__z=xyzw[2],
            pose__covariance=np.diag([4.0, 5, 6, 1, 2, 3]).ravel(), twist__twist__linear__z=2.0,
            twist__twist__angular__z=5.0, twist__covariance=np.diag(np.arange(6.0)).ravel(),
        ),
        stamped(
            "geometry_msgs/msg/PoseWithCovarianceStamped", messages.encode_prior(prior, "map"), "map",
            pose__pose__orientation__w=xyzw[3], pose__covariance=np.diag([4.0, 5, 6, 1, 2, 3]).ravel(),
        ),
        stamped("geometry_msgs/msg/PoseStamped", messages.encode_pose(STAMP_NS, "map", PLACE), "map", pose__position__x=1.5),
        Written("tf2_msgs/msg/TFMessage", messages.encode_frame_links(STAMP_NS, [link]), {"transforms.0.child_frame_id": "odom"}),
        Written("std_msgs/msg/String", pack("std_msgs/String", "LOST"), {"data": "LOST"}),
        stamped(
            "nav_msgs/msg/OccupancyGrid", encode_grid(STAMP_NS, "map", GRID), "map", info__width=3, info__height=2,
            info__resolution=np.float32(0.05), info__origin__orientation__x=xyzw[0], data=np.array([0, 100, -1, 50, 0, 0]),
        ),
        stamped(
            "diagnostic_msgs/msg/DiagnosticArray", pack("diagnostic_msgs/DiagnosticArray", STAMP_NS, "", DIAGNOSES), "",
            status__0__message="bc",
            status__0__values__1__value="ü", status__1__hardware_id="",
        ),
        stamped(
            "bond/msg/Status", pack("bond/Status", STAMP_NS, "", "n", "i", True, 4.0, 0.5), "", id="n",
            instance_id="i", active=True, heartbeat_timeout=4.0, heartbeat_period=0.5,
        ),
        Written("lifecycle_msgs/msg/TransitionEvent", event, {"timestamp": STAMP_NS, "goal_state.label": "activating"}),
        Written(
            response("lifecycle_msgs/srv/GetState"), pack("lifecycle_msgs/srv/GetState_Response", *named(LifecycleState.ACTIVE)),
            {"current_state.id": 3, "current_state.label": "active"},
        ),
        Written(
            response("lifecycle_msgs/srv/GetAvailableStates"),
            pack("lifecycle_msgs/srv/GetAvailableStates_Response", [named(one) for one in LifecycleState]),
            {"available_states.10.label": "errorprocessing"},
        ),
        Written(
            response("lifecycle_msgs/srv/GetAvailableTransitions"), transitions,
            {"available_transitions.0.goal_state.id": 10, "available_transitions.7.transition.label": "transition_success"},
        ),
        Written(response("std_srvs/srv/Empty"), EMPTY, {}),
    ]  # fmt: skip


def at(message: Any, path: str) -> Any:
    for part in path.split("."):
        message = message[int(part)] if part.isdecimal() else getattr(message, part)
    return message


@pytest.mark.parametrize("one", written(), ids=lambda one: one.type_name)
def test_an_independent_library_reads_what_is_written(one: Written) -> None:
    message = STORE.deserialize_cdr(one.data, one.type_name)
    for path, value in one.expected.items():
        if isinstance(value, np.ndarray | float):
            np.testing.assert_allclose(at(message, path), value, atol=1e-12)
        else:
            assert at(message, path) == value, path
    assert bytes(STORE.serialize_cdr(message, one.type_name)) == one.data, "to the byte"


def test_hashes_of_messages_are_those_of_an_independent_library() -> None:
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    # rosbags has no bond; it takes service_msgs' char for another type than rosidl's, as the services below show.
    names = [
        name
        for name in DEFINITIONS
        if name.count("/") == 1 and name not in ("bond/Status", "service_msgs/ServiceEventInfo")
    ]
    assert len(names) >= 30
    wrong = {name for name in names if jazzy.hash_rihs01(name.replace("/", "/msg/")) != f"RIHS01_{type_hash(name)}"}
    assert wrong == set()
    assert STORE.hash_rihs01("bond/msg/Status") == f"RIHS01_{type_hash('bond/Status')}"


def test_hashes_of_services_are_those_that_ros_announces(monkeypatch: pytest.MonkeyPatch) -> None:
    """AddTwoInts: rmw_zenoh's design document. BasicTypes: a bag that rosbag2's own tests recorded."""
    numbers = " ".join(f"{kind}{bits} {kind}{bits}_value\n" for bits in (8, 16, 32, 64) for kind in ("int", "uint"))
    basic = "bool bool_value\nbyte byte_value\nuint8 char_value\nfloat32 float32_value\nfloat64 float64_value\n"
    basic += "\n".join(line.strip() for line in numbers.splitlines()) + "\nstring string_value"
    for name, fields in {
        "example_interfaces/srv/AddTwoInts": ("int64 a\nint64 b", "int64 sum"),
        "test_msgs/srv/BasicTypes": (basic, basic),
    }.items():
        for key, text in service_definitions(name, *fields).items():
            monkeypatch.setitem(DEFINITIONS, key, text)
    assert type_hash("example_interfaces/srv/AddTwoInts").startswith(
        "e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30"
    )
    assert type_hash("test_msgs/srv/BasicTypes_Event").startswith(
        "5b9988a4805a06ae22dff12903a774ccda710e9514926b826ffc8"
    )


def test_hashes_of_the_localizers_services_are_those_of_ros() -> None:
    """As ROS 2 Jazzy's own packages state them: share/lifecycle_msgs/srv/GetState.json and the others."""
    for name, stated in {
        "lifecycle_msgs/srv/GetState": "800a0a5aae599782b02932de0caf563f6dc4e7e94b794eadde075ba2cbef9795",
        "lifecycle_msgs/srv/ChangeState": "356fe34f0475a43acf54542013af4167b0e729f77ea22ffb045c6ad8e20668e5",
        "lifecycle_msgs/srv/GetAvailableStates": "00a07d79d2207d71e81a8cbc1880e5d924cc16d4688ea8e8e06e443dc8f8aa1d",
        "lifecycle_msgs/srv/GetAvailableTransitions": "59b7ecefce0982a8a844b9f2c4f14764c1c4543cc55e72924e2aa4adad83e9bc",
        "std_srvs/srv/Empty": "5888399dedec5ccc85ea6451949fd2c9f97bfdf963f9a588821639fcd31b5d19",
        "service_msgs/ServiceEventInfo": "41bcbbe07a75c9b52bc96bfd5c24d7f0fc0a08c0cb7921b3373c5732345a6f45",
    }.items():
        assert type_hash(name) == stated, name


def test_nav2s_service_is_defined_as_nav2_defines_it() -> None:
    """No list of hashes has it: the definition is nav2's, and the way from there to a hash is tested above."""
    official = (real_data("conformance/nav2") / "nav2_msgs/srv/SetInitialPose.srv").read_text("utf-8")
    request, response = (part.strip() for part in official.split("---"))
    nothing = DEFINITIONS["std_srvs/srv/Empty_Request"]
    name = "nav2_msgs/srv/SetInitialPose"
    assert (DEFINITIONS[f"{name}_Request"], DEFINITIONS[f"{name}_Response"]) == (request, response or nothing)


def test_tokens_are_those_of_rmw_zenoh_and_of_the_bridge() -> None:
    """As the design document of the one and the plugin's own key expressions have them."""
    text, talker = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18", NodeName("8b20", "talker")
    chatter = Endpoint("MP", "/chatter", "std_msgs/String", 10, Qos(7))
    rmw, bridge = RmwZenohKeys(2), BridgedDdsKeys()
    assert rmw.node_token(talker) == "@ros2_lv/2/8b20/0/0/NN/%/%/talker"
    assert rmw.token(talker, chatter) == (
        f"@ros2_lv/2/8b20/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{text}/::,7:,:,:,,"
    )
    named = NodeName("8b20", "talker", "/robot1")
    assert "/%/%robot1/talker/%robot1%chatter/" in rmw.token(
        named, Endpoint("MS", "/robot1/chatter", "std_msgs/String", 1)
    )
    assert rmw.key("/robot1/chatter", "std_msgs/String") == f"2/robot1/chatter/std_msgs::msg::dds_::String_/{text}"
    assert rmw.key("/n/get_state", "lifecycle_msgs/srv/GetState").startswith(
        "2/n/get_state/lifecycle_msgs::srv::dds_::GetState_/"
    )
    latched = Endpoint("MP", "/robot1/chatter", "std_msgs/String", 1, LATCHED)
    assert (
        bridge.token(talker, latched)
        == f"@/8b20/@ros2_lv/MP/robot1§chatter/std_msgs§msg§String/:1:1:0,1:typehash={text};"
    )
    service = Endpoint("SS", "/n/get_state", "lifecycle_msgs/srv/GetState", 1)
    assert bridge.token(talker, service) == "@/8b20/@ros2_lv/SS/n§get_state/lifecycle_msgs§srv§GetState"
    assert bridge.key("/n/get_state", "lifecycle_msgs/srv/GetState") == "n/get_state"


def test_keys_name_domain_topic_and_type() -> None:
    key = RmwZenohKeys(3).key("/robot/imu0", "sensor_msgs/Imu")
    assert key.startswith("3/robot/imu0/sensor_msgs::msg::dds_::Imu_/RIHS01_7d9a00ff")
    assert RmwZenohKeys(0).type_of(key) == "sensor_msgs/Imu"
    assert RmwZenohKeys(3).subscription("/robot/imu0") == "3/robot/imu0/*/*"
    assert RmwZenohKeys(0).type_of("3/robot/imu0/nonsense/x") == ""
    assert RmwZenohKeys(0).type_of("short") == ""


@pytest.mark.parametrize("topic", ["", "/", "/a b", "a//b", "/a/*", "/0a"])
def test_what_is_no_topic_is_refused(topic: str) -> None:
    with pytest.raises(UsageError, match="topic"):
        RmwZenohKeys(0).subscription(topic)


def test_attachments_are_read_by_zenohs_own_deserializer() -> None:
    data = attachment(7, 5_000_000_001, bytes(range(16)))
    assert z_deserialize(tuple[Int64, Int64, bytes], __import__("zenoh").ZBytes(data)) == (
        7,
        5_000_000_001,
        bytes(range(16)),
    )
