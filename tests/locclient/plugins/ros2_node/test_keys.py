"""Keys and attachments as ROS 2's own middleware makes them."""

import pytest
from zenoh.ext import Int64, z_deserialize

from fleetmap.errors import UsageError
from locclient.plugins.ros2_node.keys import RmwZenohKeys, attachment


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
