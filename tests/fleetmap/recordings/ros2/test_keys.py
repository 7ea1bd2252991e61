"""Keys and attachments as ROS 2's own middleware makes them."""

import pytest
from zenoh.ext import Int64, z_deserialize

from fleetmap.errors import UsageError
from fleetmap.recordings.ros2.keys import attachment, ros_key, ros_key_expr, type_of_key


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
