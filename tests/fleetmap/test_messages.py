"""Messages of robots and server."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleetmap.errors import LinkError
from fleetmap.geometry import se3_exp
from fleetmap.messages import (
    PoseMessage,
    RobotAck,
    RobotHealth,
    WantedVersion,
    blob_key,
    decode_message,
    encode_message,
    manifest_key,
    robot_key,
    split_key,
)

SAMPLES = [
    WantedVersion(site="lab", version=3, manifest_sha256="a" * 64),
    WantedVersion(site="lab", version=None, manifest_sha256=None),
    RobotAck(site="lab", robot="r1", stamp_ns=5, version=3, refused="tile (0, 1): damaged"),
    RobotHealth(
        site="lab", robot="r1", stamp_ns=5, version=3, status="TRACKING", flags=("dark",), metrics={"a": 1.5, "b": "x"}
    ),
    PoseMessage.of(7, np.eye(4), np.eye(6), "TRACKING", 3),
]


@pytest.mark.parametrize("message", SAMPLES, ids=lambda message: type(message).__name__)
def test_round_trip(message: object) -> None:
    assert decode_message(encode_message(message), type(message)) == message


def test_poses_keep_their_transform() -> None:
    map_from_base = se3_exp(np.array([0.1, -2.0, 0.4, 10.0, -3.0, 0.2]))
    covariance = np.arange(36.0).reshape(6, 6)
    back = decode_message(encode_message(PoseMessage.of(1, map_from_base, covariance, "LOST", None)), PoseMessage)
    np.testing.assert_allclose(back.map_from_base, map_from_base, atol=1e-12)
    assert np.array(back.cov_rot_trans).reshape(6, 6)[1, 2] == 8
    assert back.quat_wxyz[0] >= 0


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=100), st.sampled_from([WantedVersion, RobotAck, RobotHealth, PoseMessage]))
def test_nonsense_is_refused(data: bytes, message_type: type) -> None:
    with pytest.raises(LinkError, match=message_type.__name__):
        decode_message(data, message_type)


def test_oversized_and_foreign_messages_are_refused() -> None:
    with pytest.raises(LinkError, match="limit"):
        decode_message(bytes(2 << 20), RobotAck)
    with pytest.raises(LinkError, match="same fleetmap"):
        decode_message(encode_message(SAMPLES[0]), RobotAck)


def test_keys_can_be_taken_apart() -> None:
    assert split_key(robot_key("lab", "r1", "ack")) == ("lab", "r1", "ack")
    assert split_key(manifest_key("lab", 3)) == ("lab", "manifests", "3")
    assert split_key(blob_key("lab", "ab")) == ("lab", "blobs", "ab")
    for key in ("", "fleetmap/lab", "other/lab/blobs/ab", "fleetmap/lab/robots/r1/ack/x"):
        with pytest.raises(LinkError):
            split_key(key)
