"""Foxglove's protobuf messages: RawImage, CompressedImage, CameraCalibration, FrameTransform, PoseInFrame.

Foxglove has no inertial message; the convention here is any message on the IMU topic with the fields `timestamp`
(google.protobuf.Timestamp), `frame_id`, `angular_velocity` {x y z} in rad/s and `linear_acceleration` {x y z} in
m/s^2, of a type that `mcap_topics` lists. Wheel odometry and priors have no convention in protobuf and are read from
ROS 2 messages only.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array
from fleetmap.recordings.bags.container import Channel
from fleetmap.recordings.images import StoredImage
from fleetmap.recordings.ros2.messages import CameraInfo, FrameLink, frame_link
from fleetmap.sensors.samples import PositionPrior, Stamps, WheelSample

Message = Any  # made at run time from the schema in the file


class FoxgloveCodec:
    """Decodes by the descriptors that the file itself carries."""

    def __init__(self) -> None:
        self._classes: dict[int, Any] = {}

    def __reduce__(self) -> tuple[type["FoxgloveCodec"], tuple[()]]:
        """Classes made of the file's descriptors are made again where it is unpickled."""
        return FoxgloveCodec, ()

    def stamp_ns(self, channel: Channel, data: memoryview) -> int:
        """The field `timestamp`."""
        return _stamp_ns(self._parse(channel, bytes(data)))

    def image(self, channel: Channel, data: bytes, where: str) -> StoredImage:
        """RawImage or CompressedImage."""
        message = self._parse(channel, data)
        if channel.schema.name.endswith("CompressedImage"):
            return StoredImage("file", message.data, where, form=message.format)
        return StoredImage(message.encoding, message.data, where, message.width, message.height, message.step)

    def imu(self, channel: Channel, messages: Sequence[bytes]) -> tuple[Stamps, Array, Array, str]:
        """Messages of the convention in this module's head."""
        parsed = [self._parse(channel, data) for data in messages]
        try:
            gyro = np.array([_xyz(message.angular_velocity) for message in parsed])
            accel = np.array([_xyz(message.linear_acceleration) for message in parsed])
        except AttributeError as error:
            raise ValueError(f"{channel.schema.name} has no {error.name}") from error
        return (
            np.array([_stamp_ns(message) for message in parsed], np.int64),
            gyro,
            accel,
            str(getattr(parsed[0], "frame_id", "")),
        )

    def pose(self, channel: Channel, data: bytes) -> tuple[int, Array]:
        """PoseInFrame."""
        message = self._parse(channel, data)
        turn = message.pose.orientation
        return _stamp_ns(message), np.array([*_xyz(message.pose.position), turn.w, turn.x, turn.y, turn.z])

    def links(self, channel: Channel, data: bytes) -> list[FrameLink]:
        """FrameTransform or FrameTransforms."""
        message = self._parse(channel, data)
        return [_link(item) for item in (message.transforms if hasattr(message, "transforms") else [message])]

    def camera_info(self, channel: Channel, data: bytes) -> CameraInfo:
        """CameraCalibration."""
        message = self._parse(channel, data)
        matrix, projection = np.array(message.K), np.array(message.P)
        if len(matrix) != 9:
            raise ValueError(f"CameraCalibration with {len(matrix)} numbers in K")
        rect = np.array(message.R) if len(message.R) == 9 else np.eye(3)
        full = projection if len(projection) == 12 else np.pad(matrix.reshape(3, 3), ((0, 0), (0, 1)))
        return CameraInfo(
            message.frame_id,
            message.width,
            message.height,
            message.distortion_model,
            np.array(message.D),
            matrix.reshape(3, 3),
            rect.reshape(3, 3),
            full.reshape(3, 4),
        )

    def wheel(self, channel: Channel, data: bytes) -> WheelSample:
        """There is no such message in protobuf."""
        raise ValueError(f"wheel odometry as {channel.schema.name} is not known; record nav_msgs/Odometry")

    def prior(self, channel: Channel, data: bytes) -> PositionPrior:
        """There is no such message in protobuf."""
        raise ValueError(f"position priors as {channel.schema.name} are not known; record PoseWithCovarianceStamped")

    def _parse(self, channel: Channel, data: bytes) -> Message:
        if channel.id not in self._classes:
            self._classes[channel.id] = _message_class(channel)
        message = self._classes[channel.id]()
        try:
            message.ParseFromString(data)
        except Exception as error:
            # DecodeError cannot be named before protobuf is imported
            if type(error).__name__ == "DecodeError":
                raise ValueError(f"the {len(data)} bytes are no {channel.schema.name}") from error
            raise
        return message


def _message_class(channel: Channel) -> Any:
    try:
        from google.protobuf.descriptor_pb2 import FileDescriptorSet  # type: ignore[import-untyped]
        from google.protobuf.descriptor_pool import DescriptorPool  # type: ignore[import-untyped]
        from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
        from google.protobuf.message_factory import GetMessageClass  # type: ignore[import-untyped]
    except ImportError as error:
        raise RecordingError(
            f"{channel.topic} is in protobuf ({channel.schema.name}), which needs a library more: pip install protobuf"
        ) from error
    try:
        files = FileDescriptorSet.FromString(channel.schema.data)
        pool = DescriptorPool()
        for file in files.file:
            pool.Add(file)
        return GetMessageClass(pool.FindMessageTypeByName(channel.schema.name))
    except (DecodeError, KeyError, TypeError) as error:
        raise ValueError(f"the schema of {channel.topic} is damaged") from error


def _stamp_ns(message: Message) -> int:
    stamp_ns = int(message.timestamp.seconds) * 1_000_000_000 + int(message.timestamp.nanos)
    if abs(stamp_ns) >= 2**63:
        raise ValueError(f"a stamp of {message.timestamp.seconds} s is beyond 64 bits of nanoseconds")
    return stamp_ns


def _xyz(vector: Message) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _link(message: Message) -> FrameLink:
    turn = message.rotation
    quat_wxyz = np.array([turn.w, turn.x, turn.y, turn.z])
    return frame_link(message.parent_frame_id, message.child_frame_id, np.array(_xyz(message.translation)), quat_wxyz)
