"""ROS 2's definitions of the messages in recordings, and CDR, their byte layout: values aligned to their size after a 4-byte header.

The values of a message are those of its fields in order, with the fields of messages in it in their place: a builtin_interfaces/Time is
one stamp in ns, uint8[] and int8[] are bytes, neighbouring float64 and float64[N] one array, float64[] an array of its own, and a sequence
of messages a list of their values.

rosbags' typestore does the same, but would cost robots 17 MB (rosbags, apsw, ruamel.yaml) and reads 20,000 IMU messages in 0.35 s,
which are read together here in 0.03 s (`typestore.deserialize_cdr` against `messages.decode_imu`); the contract tests compare both.
Source: OMG's Common Data Representation (DDS-XTypes 1.3, plain CDR version 1), as ROS 2 records it.
"""

import struct
from functools import cache
from typing import Any

import numpy as np

from fleetmap.errors import RecordingError

# Field by field as ROS 2 fixes them
DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "sensor_msgs/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 "
        "step\nuint8[] data"
    ),
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data",
    "sensor_msgs/RegionOfInterest": ("uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify"),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
        "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi"
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
        "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
        "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance"
    ),
    "nav_msgs/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist"
    ),
    "nav_msgs/MapMetaData": (
        "builtin_interfaces/Time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\ngeometry_msgs/Pose origin"
    ),
    "nav_msgs/OccupancyGrid": "std_msgs/Header header\nnav_msgs/MapMetaData info\nint8[] data",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
}
_HEAD = b"\x00\x01\x00\x00"  # plain CDR, little endian
_NUMBERS = {"bool": "B", "uint8": "B", "int32": "i", "uint32": "I", "float32": "f"}
_FORMS = {order + code: struct.Struct(order + code) for order in "<>" for code in _NUMBERS.values()}
_TIME, _BYTES = "builtin_interfaces/Time", ("uint8[]", "int8[]")
Fields = tuple[Any, ...]  # types, counts of neighbouring float64, and Fields of the messages of a sequence


@cache
def _fields(type_name: str) -> Fields:
    fields: list[Any] = []
    for line in DEFINITIONS[type_name].splitlines():
        kind = line.split()[0]
        base, _, count = kind.removesuffix("]").partition("[")
        inner: Fields = (kind,)
        if base == "float64" and kind != "float64[]":
            inner = (int(count or 1),)
        elif base in DEFINITIONS and base != _TIME:
            inner = (_fields(base),) if kind.endswith("[]") else _fields(base)
        for field in inner:
            if isinstance(field, int) and fields and isinstance(fields[-1], int):
                fields[-1] += field
            else:
                fields.append(field)
    return tuple(fields)


def ros2msg(type_name: str) -> str:
    """The full definition of a message type such as `sensor_msgs/Imu`, followed by those of its parts."""
    parts = [type_name]
    for name in parts:  # which grows by the parts of parts
        kinds = (line.split()[0].removesuffix("[]") for line in DEFINITIONS[name].splitlines())
        parts += [kind for kind in dict.fromkeys(kinds) if kind in DEFINITIONS and kind not in parts]
    separator = "=" * 80
    return "".join([DEFINITIONS[type_name], *(f"\n{separator}\nMSG: {n}\n{DEFINITIONS[n]}" for n in parts[1:]), "\n"])


def unpack(type_name: str, data: bytes) -> list[Any]:
    """The values of a message, of which `data` may be longer; ValueError if it is shorter than it declares."""
    reader = _Reader(data)
    return [reader.read(field) for field in _fields(type_name)]


def pack(type_name: str, *values: Any) -> bytes:
    """The message with these values, little endian; arrays may have any shape. RecordingError for a stamp that it cannot hold."""
    out = bytearray(_HEAD)
    _put(out, _fields(type_name), values)
    return bytes(out)


def byte_order(data: bytes) -> str:
    """`<` or `>` of a message; ValueError for other bytes."""
    if len(data) < 4 or data[0] != 0 or data[1] > 1:
        starts = data[:2].hex(" ") or "nothing"
        raise ValueError(
            f"a CDR message has 4 bytes or more and starts with 00 00 or 00 01, this one has {len(data)}: {starts}"
        )
    return "<" if data[1] else ">"


class _Reader:
    def __init__(self, data: bytes) -> None:
        self._data, self._at, self._order = data, len(_HEAD), byte_order(data)

    def read(self, field: Any) -> Any:
        if field == "string":
            return self._take(self._number("I")).rstrip(b"\0").decode("utf-8", "replace")
        if field == _TIME:
            seconds = self._number("i")
            return seconds * 1_000_000_000 + self._number("I")
        if field in _BYTES:
            return self._take(self._number("I"))
        if isinstance(field, tuple):
            return [[self.read(each) for each in field] for _ in range(self._number("I"))]
        if field in _NUMBERS:
            return self._number(_NUMBERS[field])
        count = field if isinstance(field, int) else self._number("I")
        self._at += -(self._at - len(_HEAD)) % (8 if count else 1)
        return np.frombuffer(self._take(8 * count), np.dtype(self._order + "f8")).astype(np.float64)

    def _number(self, code: str) -> Any:
        form = _FORMS[self._order + code]
        self._at += -(self._at - len(_HEAD)) % form.size
        return form.unpack(self._take(form.size))[0]

    def _take(self, count: int) -> bytes:
        if self._at + count > len(self._data):
            raise ValueError(f"the message of {len(self._data)} bytes ends before the {count} bytes at {self._at}")
        taken = self._data[self._at : self._at + count]
        self._at += count
        return bytes(taken)


def _put(out: bytearray, fields: Fields, values: Any) -> None:
    for field, value in zip(fields, values, strict=True):
        if field == "string" or field in _BYTES:
            content = value.encode() + b"\0" if field == "string" else value
            _put_number(out, "I", len(content))
            out += content
        elif field == _TIME:
            seconds, nanoseconds = divmod(value, 1_000_000_000)
            if not 0 <= seconds < 2**31:
                raise RecordingError(
                    f"the stamp {value} ns is not within 1970 to 2038, as ROS 2 writes it; set the sensor's clock, or leave "
                    "out these values"
                )
            _put_number(out, "i", seconds)
            _put_number(out, "I", nanoseconds)
        elif isinstance(field, tuple):
            _put_number(out, "I", len(value))
            for each in value:
                _put(out, field, each)
        elif field in _NUMBERS:
            _put_number(out, _NUMBERS[field], value)
        else:
            if field == "float64[]":
                _put_number(out, "I", len(value))
            flat = np.ascontiguousarray(value, "<f8").tobytes()
            out += b"\0" * (-(len(out) - len(_HEAD)) % 8 if flat else 0) + flat


def _put_number(out: bytearray, code: str, value: float) -> None:
    form = _FORMS["<" + code]
    out += b"\0" * (-(len(out) - len(_HEAD)) % form.size) + form.pack(value)
