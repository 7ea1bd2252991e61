"""Messages of robots and server."""

from functools import partial

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleetmap.encoding import to_plain
from fleetmap.errors import LinkError
from fleetmap.geometry import se3_exp
from fleetmap.messages import (
    MAX_MESSAGE_BYTES,
    MAX_THUMBNAIL_BYTES,
    Cause,
    FailureReport,
    FixNote,
    PoseMessage,
    RobotAck,
    RobotHealth,
    Status,
    SurveyArea,
    Thumbnail,
    WantedVersion,
    decode_message,
    encode_message,
    robot_key,
    split_key,
)
from support.fleet.reports import blindness

WANTED = WantedVersion(site="lab", version=3, manifest_sha256="a" * 64)


def test_a_report_of_a_failure_fits_a_message_with_all_its_pictures() -> None:
    full = msgspec.structs.replace(
        blindness(), thumbnails=(Thumbnail(stamp_ns=1, kind="frame", jpeg=bytes(MAX_THUMBNAIL_BYTES)),) * 4,
        fixes=(FixNote(stamp_ns=1, status="LOST", refused="x" * 2000),) * 20,
    )  # fmt: skip
    data = encode_message(full)
    assert len(data) < MAX_MESSAGE_BYTES // 2
    assert decode_message(data, FailureReport) == full
    large = Thumbnail(stamp_ns=1, kind="frame", jpeg=bytes(100_000))
    with pytest.raises(LinkError, match="jpeg"):
        decode_message(encode_message(msgspec.structs.replace(full, thumbnails=(large,))), FailureReport)


def test_poses_keep_their_transform() -> None:
    map_from_base = se3_exp(np.array([0.1, -2.0, 0.4, 10.0, -3.0, 0.2]))
    covariance = np.arange(36.0).reshape(6, 6)
    back = decode_message(encode_message(PoseMessage.of(1, map_from_base, covariance, "LOST", None)), PoseMessage)
    np.testing.assert_allclose(back.map_from_base, map_from_base, atol=1e-12)
    assert np.array(back.cov_rot_trans).reshape(6, 6)[1, 2] == 8
    assert back.quat_wxyz[0] >= 0


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=100), st.sampled_from([WantedVersion, RobotAck, RobotHealth, PoseMessage, FailureReport]))
def test_nonsense_is_refused(data: bytes, message_type: type) -> None:
    with pytest.raises(LinkError, match=message_type.__name__):
        decode_message(data, message_type)


def test_oversized_and_foreign_messages_are_refused() -> None:
    with pytest.raises(LinkError, match="limit"):
        decode_message(bytes(2 << 20), RobotAck)
    with pytest.raises(LinkError, match="same fleetmap"):
        decode_message(encode_message(WANTED), RobotAck)
    area = SurveyArea(id="../../../outside/evil", corners_map_m=[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)])
    with pytest.raises(LinkError, match="surveys"):
        decode_message(encode_message(msgspec.structs.replace(WANTED, surveys=(area,))), WantedVersion)


def test_keys_can_be_taken_apart() -> None:
    assert split_key(robot_key("lab", "r1", "ack")) == ("lab", "r1", "ack")
    assert split_key(robot_key("lab", "r1", "manifests/3")) == ("lab", "r1", "3")
    for key in ("", "fleetmap/lab", "other/lab/robots/r1/ack", "fleetmap/lab/blobs/ab", "fleetmap/lab/robots/r1/ack/x"):
        with pytest.raises(LinkError):
            split_key(key)


def test_enums_are_text_on_the_wire() -> None:
    """The bytes are those of plain text, and what a newer robot says that this version does not know arrives as it is."""
    of = partial(RobotHealth, site="hall", robot="r", stamp_ns=1, version=None)
    health, plain = of(status=Status.LOST, flags=(Cause.DARK,)), of(status="LOST", flags=("dark",))
    assert encode_message(health) == encode_message(plain)
    assert to_plain(health) == to_plain(plain)
    newer = of(status="HOVERING")
    assert decode_message(encode_message(newer), RobotHealth).status == "HOVERING"
