"""Foxglove's protobuf messages: RawImage, CompressedImage, CameraCalibration, FrameTransform, PoseInFrame.

Foxglove has no inertial message; the convention here is any message on the IMU topic with the fields `timestamp`
(google.protobuf.Timestamp), `frame_id`, `angular_velocity` {x y z} in rad/s and `linear_acceleration` {x y z} in
m/s^2, of a type that `topics` lists. Wheel odometry and priors have no convention in protobuf and are read from
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

Message = Any  # created at run time from the schema in the file


class FoxgloveDecoder:
    """Decodes with the descriptors contained in the file; methods as those of RosDecoder."""

    def __init__(self, channel: Channel) -> None:
        self.channel = channel
        self._class: Any = None

    def __reduce__(self) -> tuple[type["FoxgloveDecoder"], tuple[Channel]]:
        """Unpickling recreates the class from the file's descriptors."""
        return FoxgloveDecoder, (self.channel,)

    def stamp_ns(self, data: bytes) -> int:
        return _stamp_ns(self._parse(data))

    def image(self, data: bytes, where: str) -> StoredImage:
        """RawImage or CompressedImage."""
        message = self._parse(data)
        if self.channel.type_name.endswith("CompressedImage"):
            return StoredImage("file", message.data, where, form=message.format)
        return StoredImage(message.encoding, message.data, where, message.width, message.height, message.step)

    def imu(self, messages: Sequence[bytes]) -> tuple[Stamps, Array, Array, str]:
        """Messages of the convention in this module's docstring."""
        parsed = [self._parse(data) for data in messages]
        stamps_ns = np.array([_stamp_ns(message) for message in parsed], np.int64)
        gyro = np.array([_xyz(message.angular_velocity) for message in parsed])
        accel = np.array([_xyz(message.linear_acceleration) for message in parsed])
        return stamps_ns, gyro, accel, str(getattr(parsed[0], "frame_id", ""))

    def pose(self, data: bytes) -> tuple[int, Array]:
        """PoseInFrame."""
        message = self._parse(data)
        turn = message.pose.orientation
        return _stamp_ns(message), np.array([*_xyz(message.pose.position), turn.w, turn.x, turn.y, turn.z])

    def links(self, data: bytes) -> list[FrameLink]:
        """FrameTransform or FrameTransforms."""
        message = self._parse(data)
        found = []
        for item in message.transforms if hasattr(message, "transforms") else [message]:
            quat_wxyz = np.array([item.rotation.w, item.rotation.x, item.rotation.y, item.rotation.z])
            translation = np.array(_xyz(item.translation))
            found.append(frame_link(item.parent_frame_id, item.child_frame_id, translation, quat_wxyz))
        return found

    def camera_info(self, data: bytes) -> CameraInfo:
        """CameraCalibration."""
        message = self._parse(data)
        if len(message.K) != 9:
            raise ValueError(f"CameraCalibration with {len(message.K)} numbers in K")
        matrix = np.array(message.K).reshape(3, 3)
        rect = np.array(message.R).reshape(3, 3) if len(message.R) == 9 else np.eye(3)
        projection = np.pad(matrix, ((0, 0), (0, 1)))
        if len(message.P) == 12:
            projection = np.array(message.P).reshape(3, 4)
        lens = message.distortion_model, np.array(message.D)
        return CameraInfo(message.frame_id, message.width, message.height, *lens, matrix, rect, projection)

    def wheel(self, data: bytes) -> WheelSample:
        raise ValueError(f"wheel odometry as {self.channel.type_name} is not known; record nav_msgs/Odometry")

    def prior(self, data: bytes) -> PositionPrior:
        raise ValueError(f"position priors as {self.channel.type_name} are not known; record PoseWithCovarianceStamped")

    def _parse(self, data: bytes) -> Message:
        if self._class is None:
            self._class = _message_class(self.channel)
        from google.protobuf.message import DecodeError  # type: ignore[import-untyped]

        message = self._class()
        try:
            message.ParseFromString(data)
        except DecodeError as error:
            raise ValueError(f"the {len(data)} bytes are not a valid {self.channel.type_name}") from error
        return message


def _message_class(channel: Channel) -> Any:
    try:
        from google.protobuf.descriptor_pb2 import FileDescriptorSet  # type: ignore[import-untyped]
        from google.protobuf.descriptor_pool import DescriptorPool  # type: ignore[import-untyped]
        from google.protobuf.message import DecodeError
        from google.protobuf.message_factory import GetMessageClass  # type: ignore[import-untyped]
    except ImportError as error:
        raise RecordingError(
            f"{channel.topic} is in protobuf ({channel.type_name}), which needs another library: pip install protobuf"
        ) from error
    try:
        pool = DescriptorPool()
        for file in FileDescriptorSet.FromString(channel.schema).file:
            pool.Add(file)
        return GetMessageClass(pool.FindMessageTypeByName(channel.type_name))
    except (DecodeError, KeyError, TypeError) as error:
        raise ValueError(f"the schema of {channel.topic} is damaged") from error


def _stamp_ns(message: Message) -> int:
    stamp_ns = int(message.timestamp.seconds) * 1_000_000_000 + int(message.timestamp.nanos)
    if abs(stamp_ns) >= 2**63:
        raise ValueError(f"a stamp of {message.timestamp.seconds} s is beyond 64 bits of nanoseconds")
    return stamp_ns


def _xyz(vector: Message) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z
