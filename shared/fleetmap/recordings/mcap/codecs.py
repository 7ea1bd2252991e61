"""Decoding of single messages: one codec for each message encoding. To add one: a class and a line in CODECS.

All methods raise ValueError for bytes that are no such message.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

from fleetmap.geometry import Array
from fleetmap.recordings.images import StoredImage
from fleetmap.recordings.mcap.foxglove import FoxgloveCodec
from fleetmap.recordings.mcap.scan import Channel
from fleetmap.recordings.mcap.topics import type_name
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

    def stamp_ns(self, channel: Channel, data: memoryview) -> int:
        return CdrReader(bytes(data[:16])).stamp_ns()

    def image(self, channel: Channel, data: bytes, where: str) -> StoredImage:
        if type_name(channel).endswith("CompressedImage"):
            return ros_messages.decode_compressed_image(data, where)
        return ros_messages.decode_image(data, where)

    def imu(self, channel: Channel, messages: Sequence[bytes]) -> tuple[Stamps, Array, Array, str]:
        return ros_messages.decode_imu(messages)

    def pose(self, channel: Channel, data: bytes) -> tuple[int, Array]:
        return ros_messages.decode_pose(data)

    def links(self, channel: Channel, data: bytes) -> list[FrameLink]:
        return ros_messages.decode_frame_links(data)

    def camera_info(self, channel: Channel, data: bytes) -> CameraInfo:
        return ros_messages.decode_camera_info(data)

    def wheel(self, channel: Channel, data: bytes) -> WheelSample:
        return ros_messages.decode_odometry(data)

    def prior(self, channel: Channel, data: bytes) -> PositionPrior:
        return ros_messages.decode_prior(data)


CODECS: dict[str, Callable[[], Codec]] = {"cdr": RosCodec, "protobuf": FoxgloveCodec}
