"""Messages of one file as values: ROS 2's CDR, ROS 1 by way of it, Foxglove's protobuf."""

import struct
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Protocol

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array
from fleetmap.recordings.bags.container import Channel
from fleetmap.recordings.bags.foxglove import FoxgloveCodec
from fleetmap.recordings.bags.topics import type_name
from fleetmap.recordings.images import StoredImage
from fleetmap.recordings.ros2 import messages as ros_messages
from fleetmap.recordings.ros2.cdr import CdrReader
from fleetmap.recordings.ros2.messages import CameraInfo, FrameLink
from fleetmap.sensors.samples import PositionPrior, Stamps, WheelSample


class Codec(Protocol):
    """Reads the messages of one file."""

    def stamp_ns(self, channel: Channel, data: memoryview) -> int:
        """Stamp of the measurement; 0 where the sender set none."""

    def image(self, channel: Channel, data: bytes, where: str) -> StoredImage:
        """An image, still encoded."""

    def imu(self, channel: Channel, messages: Sequence[bytes]) -> tuple[Stamps, Array, Array, str]:
        """Stamps (N,), gyro (N, 3), accelerometer (N, 3), frame of the sensor."""

    def pose(self, channel: Channel, data: bytes) -> tuple[int, Array]:
        """Stamp and x y z qw qx qy qz (7,)."""

    def links(self, channel: Channel, data: bytes) -> list[FrameLink]:
        """Transforms between named frames."""

    def camera_info(self, channel: Channel, data: bytes) -> CameraInfo:
        """A lens."""

    def wheel(self, channel: Channel, data: bytes) -> WheelSample:
        """Wheel odometry."""

    def prior(self, channel: Channel, data: bytes) -> PositionPrior:
        """A position prior."""


class RosCodec:
    """ROS 2 messages in CDR."""

    def cdr(self, channel: Channel, data: bytes) -> bytes:
        """The message in CDR."""
        return data

    def stamp_ns(self, channel: Channel, data: memoryview) -> int:
        """From the message's header, its first field."""
        return CdrReader(bytes(data[:16])).stamp_ns()

    def image(self, channel: Channel, data: bytes, where: str) -> StoredImage:
        """Image or CompressedImage."""
        if type_name(channel).endswith("CompressedImage"):
            return ros_messages.decode_compressed_image(self.cdr(channel, data), where)
        return ros_messages.decode_image(self.cdr(channel, data), where)

    def imu(self, channel: Channel, messages: Sequence[bytes]) -> tuple[Stamps, Array, Array, str]:
        return ros_messages.decode_imu([self.cdr(channel, data) for data in messages])

    def pose(self, channel: Channel, data: bytes) -> tuple[int, Array]:
        """PoseStamped."""
        return ros_messages.decode_pose(self.cdr(channel, data))

    def links(self, channel: Channel, data: bytes) -> list[FrameLink]:
        """TFMessage."""
        return ros_messages.decode_frame_links(self.cdr(channel, data))

    def camera_info(self, channel: Channel, data: bytes) -> CameraInfo:
        """CameraInfo."""
        return ros_messages.decode_camera_info(self.cdr(channel, data))

    def wheel(self, channel: Channel, data: bytes) -> WheelSample:
        """Odometry."""
        return ros_messages.decode_odometry(self.cdr(channel, data))

    def prior(self, channel: Channel, data: bytes) -> PositionPrior:
        """PoseWithCovarianceStamped."""
        return ros_messages.decode_prior(self.cdr(channel, data))


class Ros1Codec(RosCodec):
    """ROS 1 messages, which rosbags turns into CDR."""

    def cdr(self, channel: Channel, data: bytes) -> bytes:
        """See RosCodec; ValueError where the bytes are no such message."""
        try:
            # By ROS 2's definitions: of those that are decoded here the header alone is another, which rosbags knows
            return bytes(_store("ROS2_JAZZY").ros1_to_cdr(data, type_name(channel).replace("/", "/msg/")))
        except (struct.error, ArithmeticError, LookupError, MemoryError) as error:
            raise ValueError(f"the {len(data)} bytes are no {type_name(channel)}") from error
        except Exception as error:
            # SerdeError cannot be named before rosbags is imported
            if type(error).__name__ == "SerdeError":
                raise ValueError(f"the {len(data)} bytes are no {type_name(channel)}") from error
            raise

    def stamp_ns(self, channel: Channel, data: memoryview) -> int:
        """From the message's header, behind its sequence number."""
        if len(data) < 12:
            raise ValueError(f"a message of {len(data)} bytes has no header")
        seconds, nanoseconds = struct.unpack_from("<II", data, 4)
        return int(seconds) * 1_000_000_000 + int(nanoseconds)


@cache
def _store(name: str) -> Any:
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise RecordingError(
            "ROS 1 messages need a library more: pip install '.[bags]' in fleetmap's source folder"
        ) from error
    store = get_typestore(Stores[name])
    if name == "ROS1_NOETIC":  # rosbags ships it without
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


@cache
def ros1_digest(type_name: str) -> str:
    """The MD5 by which ROS 1 knows the definition of a type that is decoded here, such as sensor_msgs/msg/Imu."""
    return str(_store("ROS1_NOETIC").generate_msgdef(type_name)[1])


CODECS: dict[str, Callable[[], Codec]] = {"cdr": RosCodec, "ros1": Ros1Codec, "protobuf": FoxgloveCodec}
