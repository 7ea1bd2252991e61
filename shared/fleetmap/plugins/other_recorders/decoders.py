"""From the bytes of a message to its value: ROS 2's CDR, ROS 1 converted to it, Foxglove's protobuf.

Foxglove has no inertial message; the convention here is any message on the IMU topic with the fields `timestamp`
(google.protobuf.Timestamp), `frame_id`, `angular_velocity` {x y z} in rad/s and `linear_acceleration` {x y z} in
m/s^2, of one of IMU_TYPES. Wheel odometry and priors have no convention in protobuf and are read from ROS 2 messages only.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np

from fleetmap.errors import RecordingError
from fleetmap.geometry import Array
from fleetmap.recordings.images import StoredImage
from fleetmap.recordings.mcap.streams import Channel, Container
from fleetmap.recordings.ros2 import messages as ros
from fleetmap.recordings.ros2.cdr import unpack
from fleetmap.sensors.samples import Stamps

ENCODINGS = ("cdr", "ros1", "protobuf")
IMU_TYPES = ("sensor_msgs/Imu", "foxglove.Imu", "foxglove.IMU", "fleetmap.Imu")


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """sensor_msgs/CameraInfo: sizes, lens and the projection of the rectified image.

    matrix and projection are those of the full image, width_px x height_px. binning (2,): pixels that the driver combines; zeros
    mean 1. roi (4,): x, y, width, height of the part that it sends, before binning; zeros mean all.
    """

    frame_id: str
    width_px: int
    height_px: int
    lens: str
    distortion: Array
    matrix: Array
    rect_from_cam: Array
    projection: Array
    binning: tuple[int, int] = (1, 1)
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)
    stamp_ns: int = 0

    @property
    def frame(self) -> str:
        """Name of the camera's frame in the transforms."""
        return self.frame_id.lstrip("/")


class AnyEncoding(Container):
    """Base of containers whose messages may be in CDR, in ROS 1's format and in protobuf."""

    def decode(self, channel: Channel, data: bytes) -> Any:
        """See Container; CameraInfo, FrameLinks too."""
        if channel.type_name in IMU_TYPES:
            return self.decode_imu(channel, [data])
        values, message_of = (_FOXGLOVE, _parsed) if channel.encoding == "protobuf" else (_ROS, _cdr)
        if channel.type_name not in values:
            raise ValueError(f"{channel.type_name} is not known in {channel.encoding}")
        return values[channel.type_name](message_of(channel, data))

    def decode_imu(self, channel: Channel, messages: Sequence[bytes]) -> tuple[Stamps, Array, Array, str]:
        if channel.encoding != "protobuf":
            return ros.decode_imu([_cdr(channel, data) for data in messages])
        found = [_parsed(channel, data) for data in messages]
        gyro, accel = ([_xyz(getattr(m, name)) for m in found] for name in ("angular_velocity", "linear_acceleration"))
        stamps_ns = np.array([_stamp_ns(message) for message in found], np.int64)
        return stamps_ns, np.array(gyro), np.array(accel), str(getattr(found[0], "frame_id", ""))

    def stamp_of(self, channel: Channel, data: bytes) -> int:
        if channel.encoding == "protobuf":
            return _stamp_ns(_parsed(channel, data))
        if channel.encoding == "cdr":
            return super().stamp_of(channel, data)
        if len(data) < 12:
            raise ValueError(f"a message of {len(data)} bytes has no header")
        seconds, nanoseconds = struct.unpack_from("<II", data, 4)  # behind its sequence number
        return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _cdr(channel: Channel, data: bytes) -> bytes:
    if channel.encoding == "cdr":
        return data
    store = _ros1_store("ROS2_JAZZY")
    from rosbags.serde import SerdeError

    try:
        # By ROS 2's definitions: among the types decoded here only the header differs, which rosbags handles
        return bytes(store.ros1_to_cdr(data, channel.type_name.replace("/", "/msg/")))
    except (SerdeError, struct.error, ArithmeticError, LookupError, MemoryError) as error:
        raise ValueError(f"the {len(data)} bytes are not a valid {channel.type_name}") from error


@cache
def _ros1_store(name: str) -> Any:
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        install = "pip install '.[bags]' in fleetmap's source folder"
        raise RecordingError(f"ROS 1 messages need another library: {install}") from error
    store = get_typestore(Stores[name])
    if name == "ROS1_NOETIC":  # missing in rosbags
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


@cache
def ros1_digest(type_name: str) -> str:
    """ROS 1's MD5 of the definition of a type decoded here, such as sensor_msgs/Imu."""
    return str(_ros1_store("ROS1_NOETIC").generate_msgdef(type_name.replace("/", "/msg/"))[1])


def _parsed(channel: Channel, data: bytes) -> Any:
    """A message of Foxglove's, by the descriptors that the file contains; ValueError for invalid bytes."""
    try:
        from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
    except ImportError as error:
        library = "which needs another library: pip install protobuf"
        raise RecordingError(f"{channel.topic} is in protobuf ({channel.type_name}), {library}") from error
    try:
        message = _message_class(channel)()
        message.ParseFromString(data)
    except (DecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{len(data)} bytes are not a valid {channel.type_name}, or its schema is damaged") from error
    return message


@lru_cache(100)
def _message_class(channel: Channel) -> Any:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet  # type: ignore[import-untyped]
    from google.protobuf.descriptor_pool import DescriptorPool  # type: ignore[import-untyped]
    from google.protobuf.message_factory import GetMessageClass  # type: ignore[import-untyped]

    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(channel.schema).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(channel.type_name))


def _stamp_ns(message: Any) -> int:
    stamp = int(message.timestamp.seconds) * 1_000_000_000 + int(message.timestamp.nanos)
    if abs(stamp) >= 2**63:
        raise ValueError(f"a stamp of {message.timestamp.seconds} s is beyond 64 bits of nanoseconds")
    return stamp


def _camera_info(m: Any) -> CameraInfo:
    if len(m.K) != 9:
        raise ValueError(f"CameraCalibration with {len(m.K)} numbers in K")
    matrix = np.array(m.K).reshape(3, 3)
    rect = np.array(m.R).reshape(3, 3) if len(m.R) == 9 else np.eye(3)
    projection = np.array(m.P).reshape(3, 4) if len(m.P) == 12 else np.pad(matrix, ((0, 0), (0, 1)))
    lens = m.distortion_model, np.array(m.D)
    return CameraInfo(m.frame_id, m.width, m.height, *lens, matrix, rect, projection, stamp_ns=_stamp_ns(m))


def decode_camera_info(data: bytes) -> CameraInfo:
    """sensor_msgs/CameraInfo."""
    stamp_ns, frame_id, height, width, lens, distortion, matrices, bin_x, bin_y, x, y, roi_height, roi_width, _ = (
        unpack("sensor_msgs/CameraInfo", data)
    )
    matrix, rect, projection = (each.reshape(3, -1) for each in np.split(matrices, [9, 18]))
    binning, roi = (bin_x or 1, bin_y or 1), (x, y, roi_width, roi_height)
    return CameraInfo(frame_id, width, height, lens, distortion, matrix, rect, projection, binning, roi, stamp_ns)


def _links(items: Sequence[Any]) -> list[ros.FrameLink]:
    return [
        ros.frame_link(t.parent_frame_id, t.child_frame_id, np.array(_xyz(t.translation)), np.array(_wxyz(t.rotation)))
        for t in items
    ]


def _xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _wxyz(quaternion: Any) -> tuple[float, float, float, float]:
    return quaternion.w, quaternion.x, quaternion.y, quaternion.z


_ROS: dict[str, Callable[[Any], Any]] = ros.DECODERS | {
    "sensor_msgs/CameraInfo": decode_camera_info,
    "tf2_msgs/TFMessage": ros.decode_frame_links,
}
_FOXGLOVE: dict[str, Callable[[Any], Any]] = {
    "foxglove.RawImage": lambda m: StoredImage(m.encoding, m.data, "", m.width, m.height, m.step),
    "foxglove.CompressedImage": lambda m: StoredImage("file", m.data, "", form=m.format),
    "foxglove.CameraCalibration": _camera_info,
    "foxglove.PoseInFrame": lambda m: (_stamp_ns(m), np.array([*_xyz(m.pose.position), *_wxyz(m.pose.orientation)])),
    "foxglove.FrameTransform": lambda m: _links([m]),
    "foxglove.FrameTransforms": lambda m: _links(m.transforms),
}
