"""The localizer and its sensors behind zenoh-bridge-ros2dds: keys are bare names, late readers ask for what was kept."""

import json
import time
from itertools import count

import numpy as np
import pytest
import zenoh
import zenoh.ext

from fleetmap.bus.zenoh_bus import Bus
from fleetmap.recordings import Topics
from fleetmap.recordings.images import grey_image, png_image
from fleetmap.recordings.ros2.messages import encode_compressed_image, encode_image
from fleetmap.sources.intake import Intake
from locclient.daemon.publishers import output_of
from locclient.outputs import OutputSection
from locclient.plugins.ros2_node.keys import BridgedDdsKeys
from locclient.plugins.ros2_node.source import Ros2Source
from locclient.robot.continuous_odom import ContinuousOdom
from support.fleet.estimates import estimate
from support.fleet.nav2_client import eventually, message_name, typestore
from support.recordings.recording_samples import calibration

STORE, PORT = typestore(), 17449
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def bridge() -> zenoh.Session:
    config = zenoh.Config()
    entries = {"mode": "router", "listen/endpoints": [f"tcp/127.0.0.1:{PORT}"], "scouting/multicast/enabled": False}
    for key, value in entries.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def intake() -> Intake:
    return Intake(frames=2, imu_minus_cam_s=0.0, has_imu=False, imu_wait_s=0.0)


def test_nav2_on_dds_reaches_the_localizer() -> None:
    with bridge() as dds, Bus.connect(f"tcp/127.0.0.1:{PORT}", is_ros=True) as bus:
        commands = intake()
        section = OutputSection(format="ros2", keys="ros2dds", autostart=False)
        localizer = output_of(section).open(section, bus, "hall", "r1", calibration(), commands)

        def tokens() -> list[str]:
            replies = dds.liveliness().get("@/*/@ros2_lv/**", timeout=1.0)
            return [
                str(reply.ok.key_expr).split("@ros2_lv/")[1]
                for reply in replies
                if reply.ok and "@ros2_lv/" in str(reply.ok.key_expr)
            ]

        assert eventually(lambda: len(tokens()) == 20), tokens()
        announced = tokens()
        assert "SS/fleetmap_localizer§change_state/lifecycle_msgs§srv§ChangeState" in announced
        assert [
            one
            for one in announced
            if one.startswith("MP/amcl_pose/geometry_msgs§msg§PoseWithCovarianceStamped/:1:1:0,1:typehash=RIHS01_")
        ]

        def call(service: str, type_name: str, *values: object) -> object:
            kind = message_name(type_name, "Request")
            request = bytes(STORE.serialize_cdr(STORE.types[kind](*values), kind))
            # The bridge attaches 16 bytes of Cyclone DDS, and one for the byte order.
            (reply,) = dds.get(service, payload=request, attachment=bytes(17), timeout=5.0)
            return STORE.deserialize_cdr(reply.ok.payload.to_bytes(), message_name(type_name, "Response"))

        for number in (1, 3):
            transition = STORE.types["lifecycle_msgs/msg/Transition"](number, "")
            assert call("fleetmap_localizer/change_state", "lifecycle_msgs/srv/ChangeState", transition).success  # type: ignore[attr-defined]
        one = estimate(1.0, x_m=2.0)
        localizer.publish(one, ContinuousOdom(np.eye(4)).handle(one), np.eye(4))
        time.sleep(0.2)
        late: list[object] = []
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        take = lambda sample: late.append(STORE.deserialize_cdr(sample.payload.to_bytes(), POSE))  # noqa: E731
        reader = zenoh.ext.declare_advanced_subscriber(dds, "amcl_pose", take, history=history)
        assert eventually(lambda: bool(late))
        assert late[0].pose.pose.position.x == 2.0  # type: ignore[attr-defined]
        late[0].header.frame_id = "map"  # type: ignore[attr-defined]
        dds.put("initialpose", bytes(STORE.serialize_cdr(late[0], POSE)))
        assert eventually(lambda: bool(commands._priors))
        reader.undeclare()
        localizer.close()


@pytest.mark.parametrize("is_compressed", [False, True])
def test_images_come_under_bare_names(is_compressed: bool) -> None:
    with bridge() as dds, Bus.connect(f"tcp/127.0.0.1:{PORT}", is_ros=True) as bus:
        queue, topics = intake(), Topics(left="/rig/left", right="/rig/right")
        handles = Ros2Source(bus, BridgedDdsKeys(), topics, calibration()).subscribe(queue)
        grey = np.arange(48, dtype=np.uint8).reshape(6, 8)
        stamps_ns = count(5)

        def arrives() -> bool:
            stamp_ns = next(stamps_ns)
            if is_compressed:
                data, end = encode_compressed_image(stamp_ns, "c", png_image(grey), "png"), "/compressed"
            else:
                data, end = encode_image(stamp_ns, "c", grey_image(grey)), ""
            for side in ("left", "right"):
                dds.put(f"rig/{side}{end}", data)
            return queue.counts.frames > 0

        assert eventually(arrives)
        assert queue.counts.unreadable == 0
        for handle in handles:
            handle.close()
