"""Decoding of the messages of one channel: ROS 2's CDR, ROS 1 converted to it, Foxglove's protobuf."""

import struct
from collections.abc import Sequence
from functools import cache
from typing import Any

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array
from fleetmap.recordings.bags.container import Channel
from fleetmap.recordings.bags.foxglove import FoxgloveDecoder
from fleetmap.recordings.images import StoredImage
from fleetmap.recordings.ros2 import messages as ros_messages
from fleetmap.recordings.ros2.cdr import CdrReader
from fleetmap.recordings.ros2.messages import CameraInfo, FrameLink
from fleetmap.sensors.samples import PositionPrior, Stamps, WheelSample


class RosDecoder:
    """ROS 2 messages in CDR. Methods raise ValueError for invalid messages."""

    def __init__(self, channel: Channel) -> None:
        self.channel = channel

    def cdr(self, data: bytes) -> bytes:
        """The message in CDR."""
        return data

    def stamp_ns(self, data: bytes) -> int:
        """Stamp of the measurement, from the message's header; 0 where the sender set none."""
        return CdrReader(data[:16]).stamp_ns()

    def image(self, data: bytes, where: str) -> StoredImage:
        """Image or CompressedImage, still encoded."""
        if self.channel.type_name.endswith("CompressedImage"):
            return ros_messages.decode_compressed_image(self.cdr(data), where)
        return ros_messages.decode_image(self.cdr(data), where)

    def imu(self, messages: Sequence[bytes]) -> tuple[Stamps, Array, Array, str]:
        """Stamps (N,), gyro (N, 3), accelerometer (N, 3), frame of the sensor."""
        return ros_messages.decode_imu([self.cdr(data) for data in messages])

    def pose(self, data: bytes) -> tuple[int, Array]:
        """Stamp and x y z qw qx qy qz (7,) of a PoseStamped."""
        return ros_messages.decode_pose(self.cdr(data))

    def links(self, data: bytes) -> list[FrameLink]:
        """Transforms between named frames, of a TFMessage."""
        return ros_messages.decode_frame_links(self.cdr(data))

    def camera_info(self, data: bytes) -> CameraInfo:
        return ros_messages.decode_camera_info(self.cdr(data))

    def wheel(self, data: bytes) -> WheelSample:
        return ros_messages.decode_odometry(self.cdr(data))

    def prior(self, data: bytes) -> PositionPrior:
        return ros_messages.decode_prior(self.cdr(data))


class Ros1Decoder(RosDecoder):
    """ROS 1 messages, which rosbags turns into CDR."""

    def cdr(self, data: bytes) -> bytes:
        from rosbags.serde import SerdeError

        name = self.channel.type_name
        try:
            # By ROS 2's definitions: among the types decoded here only the header differs, which rosbags handles
            return bytes(_store("ROS2_JAZZY").ros1_to_cdr(data, name.replace("/", "/msg/")))
        except (SerdeError, struct.error, ArithmeticError, LookupError, MemoryError) as error:
            raise ValueError(f"the {len(data)} bytes are not a valid {name}") from error

    def stamp_ns(self, data: bytes) -> int:
        """From the message's header, behind its sequence number."""
        if len(data) < 12:
            raise ValueError(f"a message of {len(data)} bytes has no header")
        seconds, nanoseconds = struct.unpack_from("<II", data, 4)
        return int(seconds) * 1_000_000_000 + int(nanoseconds)


Decoder = RosDecoder | FoxgloveDecoder
_DECODERS: dict[str, type[Decoder]] = {"cdr": RosDecoder, "ros1": Ros1Decoder, "protobuf": FoxgloveDecoder}
ENCODINGS = tuple(_DECODERS)


def decoder_of(channel: Channel) -> Decoder:
    """Create the decoder of a channel with one of ENCODINGS; RecordingError if a library is missing."""
    if channel.encoding == "ros1":
        _store("ROS2_JAZZY")
    return _DECODERS[channel.encoding](channel)


@cache
def _store(name: str) -> Any:
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise RecordingError(
            "ROS 1 messages need another library: pip install '.[bags]' in fleetmap's source folder"
        ) from error
    store = get_typestore(Stores[name])
    if name == "ROS1_NOETIC":  # missing in rosbags
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


@cache
def ros1_digest(type_name: str) -> str:
    """ROS 1's MD5 of the definition of a type decoded here, such as sensor_msgs/Imu."""
    return str(_store("ROS1_NOETIC").generate_msgdef(type_name.replace("/", "/msg/"))[1])
