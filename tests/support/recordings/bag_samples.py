"""The messages of `mcap_samples` in bags that rosbags' writers make."""

from collections.abc import Iterable
from pathlib import Path

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from support.recordings.mcap_samples import Message

_STORE = get_typestore(Stores.ROS2_JAZZY)


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
