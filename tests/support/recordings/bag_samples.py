"""The messages of `mcap_samples` in bags that rosbags' writers make."""

from collections.abc import Callable, Iterable
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fleetmap.recordings import Recording, format_calibration
from support.recordings.mcap_samples import Message

_STORE = get_typestore(Stores.ROS2_JAZZY)
_STORE1 = get_typestore(Stores.ROS1_NOETIC)
_STORE1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))


def edited(
    messages: Iterable[Message], topic: str, change: dict[str, Any] | Callable[[Any], None], rows: slice = slice(None)
) -> list[Message]:
    """The messages, those of a topic in these rows changed in rosbags' form: fields by dotted names, or by a function of it."""
    edited = list(messages)
    for number in [number for number, message in enumerate(edited) if message[0] == topic][rows]:
        name, kind, stamp_ns, data = edited[number]
        message = _STORE.deserialize_cdr(data, kind.replace("/", "/msg/"))
        for path, value in () if callable(change) else change.items():
            *parents, field = path.split(".")
            setattr(reduce(getattr, parents, message), field, value)
        if callable(change):
            change(message)
        edited[number] = name, kind, stamp_ns, bytes(_STORE.serialize_cdr(message, kind.replace("/", "/msg/")))
    return edited


def write_rosbag2(
    folder: Path,
    messages: Iterable[Message],
    mode: CompressionMode = CompressionMode.NONE,
    storage: StoragePlugin = StoragePlugin.SQLITE3,
) -> Path:
    """A rosbag2 folder."""
    writer = Writer(folder, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, name, stamp_ns, data in messages:
            if topic not in connections:
                kind = name.replace("/", "/msg/")
                connections[topic] = writer.add_connection(topic, kind, typestore=_STORE)
            writer.write(connections[topic], stamp_ns, data)
    return folder


def write_rosbag1(
    path: Path, messages: Iterable[Message], compression: Writer1.CompressionFormat | None = None, publishers: int = 1
) -> Path:
    """A ROS 1 bag, in chunks of 20 kB; publishers take turns, each with a connection of its own."""
    writer = Writer1(path)
    writer.chunk_threshold = 20_000
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections = {}
        for number, (topic, name, stamp_ns, data) in enumerate(messages):
            kind, of = name.replace("/", "/msg/"), (topic, number % publishers)
            if of not in connections:
                connections[of] = writer.add_connection(topic, kind, typestore=_STORE1, callerid=f"/n{of[1]}")
            writer.write(connections[of], stamp_ns, _STORE.cdr_to_ros1(data, kind))
    return path


def assert_same(first: Recording, second: Recording) -> None:
    """The same samples to the bit."""
    assert first.sensor_set == second.sensor_set
    np.testing.assert_array_equal(first.frame_stamps_ns, second.frame_stamps_ns)
    for name in ("stamps_ns", "gyro_radps", "accel_mps2"):
        np.testing.assert_array_equal(getattr(first.imu, name), getattr(second.imu, name))
    for index in (3, 0, 1, 1):
        ours, theirs = first.read_frame(index), second.read_frame(index)
        np.testing.assert_array_equal(ours.left, theirs.left)
        np.testing.assert_array_equal(ours.right, theirs.right)
    assert format_calibration(first.calibration) == format_calibration(second.calibration)
