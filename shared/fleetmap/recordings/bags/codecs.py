"""Messages of one file as values: ROS 2's CDR, ROS 1 by way of it, Foxglove's protobuf."""

from collections.abc import Callable, Sequence
from typing import Protocol

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
        """Imu messages."""
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


CODECS: dict[str, Callable[[], Codec]] = {"cdr": RosCodec, "protobuf": FoxgloveCodec}
