"""Keys and attachments as ROS 2's own middleware makes them."""

import pytest
from zenoh.ext import Int64, z_deserialize

from fleetmap.errors import UsageError
from fleetmap.recordings.ros2.keys import attachment, ros_key, ros_key_expr, type_hash, type_of_key


# As ROS 2 Jazzy announces these types itself.
@pytest.mark.parametrize(
    ("type_name", "known"),
    [
        ("std_msgs/String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
        ("sensor_msgs/Imu", "7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b"),
        ("sensor_msgs/Image", "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"),
        ("tf2_msgs/TFMessage", "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"),
    ],
)
def test_hashes_of_types_are_those_of_ros(type_name: str, known: str) -> None:
    assert type_hash(type_name) == known


def test_keys_name_domain_topic_and_type() -> None:
    key = ros_key(3, "/robot/imu0", "sensor_msgs/Imu")
    assert key.startswith("3/robot/imu0/sensor_msgs::msg::dds_::Imu_/RIHS01_7d9a00ff")
    assert type_of_key(key) == "sensor_msgs/Imu"
    assert ros_key_expr(3, "/robot/imu0") == "3/robot/imu0/*/*"
    assert type_of_key("3/robot/imu0/nonsense/x") == ""
    assert type_of_key("short") == ""


@pytest.mark.parametrize("topic", ["", "/", "/a b", "a//b", "/a/*", "/0a"])
def test_what_is_no_topic_is_refused(topic: str) -> None:
    with pytest.raises(UsageError, match="topic"):
        ros_key_expr(0, topic)


def test_attachments_are_read_by_zenohs_own_deserializer() -> None:
    data = attachment(7, 5_000_000_001, bytes(range(16)))
    assert z_deserialize(tuple[Int64, Int64, bytes], __import__("zenoh").ZBytes(data)) == (
        7,
        5_000_000_001,
        bytes(range(16)),
    )
