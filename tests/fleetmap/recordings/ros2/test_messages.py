"""Every ROS 2 message that the project writes is read by rosbags, an independent library, with the values that went in."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from fleetmap.geometry import quat_wxyz_from_rotation, se3, so3_exp
from fleetmap.recordings.images import grey_image, png_image
from fleetmap.recordings.ros2 import messages
from fleetmap.recordings.ros2.cdr import pack
from fleetmap.sensors.samples import PositionPrior, WheelSample
from support.recordings.recording_samples import calibration

STAMP_NS = 1_700_000_000_123_456_789
PLACE = se3(so3_exp(np.array([0.1, -0.2, 0.7])), np.array([1.5, -2.5, 0.25]))
COV = np.diag([1.0, 2, 3, 4, 5, 6])
MOTION = PLACE, COV[messages.HALVES_SWAPPED], np.arange(6.0), np.diag(np.arange(6.0))
STORE = get_typestore(Stores.ROS2_KILTED)


@dataclass(frozen=True)
class Written:
    """Bytes of one message, its type, and what must be read from it, by path."""

    type_name: str
    data: bytes
    expected: dict[str, object]


def stamped(type_name: str, data: bytes, frame: str, /, **expected: object) -> Written:
    wanted = {"header.stamp.sec": 1_700_000_000, "header.stamp.nanosec": 123_456_789, "header.frame_id": frame}
    return Written(type_name, data, wanted | {key.replace("__", "."): value for key, value in expected.items()})


def written() -> list[Written]:
    camera, wheel = calibration().cameras[0], WheelSample(STAMP_NS, np.array([1.0, 2, 3]), 0.5, 0.1, 0.2)
    link = messages.FrameLink("map", "odom", PLACE)
    xyzw = quat_wxyz_from_rotation(PLACE[:3, :3])[[1, 2, 3, 0]]
    image, prior = grey_image(np.arange(6, dtype=np.uint8).reshape(2, 3)), PositionPrior(STAMP_NS, PLACE, COV)
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
        stamped(
            "nav_msgs/msg/OccupancyGrid",
            pack("nav_msgs/OccupancyGrid", STAMP_NS, "map", STAMP_NS, 0.25, 3, 2, messages.position_quat_xyzw(PLACE), b"\xff" * 6),
            "map", info__resolution=0.25, info__origin__position__y=-2.5, data=np.full(6, -1),
        ),
        Written("tf2_msgs/msg/TFMessage", messages.encode_frame_links(STAMP_NS, [link]), {"transforms.0.child_frame_id": "odom"}),
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
