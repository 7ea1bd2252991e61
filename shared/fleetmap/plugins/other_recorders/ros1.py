"""Opens ROS 1 bags: rosbags reads them and converts their messages to ROS 2's, which are decoded like all others.

Files may be hostile: the sizes of an index and of an unpacked chunk are limited. Source of the layout: ROS's bag format 2.0.
"""

import struct
from collections.abc import Callable, Iterator
from functools import cache, partial
from io import BufferedReader, FileIO
from itertools import islice
from pathlib import Path, PosixPath
from typing import Any, BinaryIO

from fleetmap.errors import RecordingError
from fleetmap.plugins.other_recorders.decoders import AnyEncoding, ros1_digest
from fleetmap.plugins.other_recorders.streams import KNOWN_TYPES, note_videos, open_messages
from fleetmap.recordings import OpenOptions, Recording, RecordingFormat
from fleetmap.recordings.files import file_head
from fleetmap.recordings.limits import MAX_MESSAGE_BYTES
from fleetmap.recordings.mcap.streams import Channel, Message, Place

_MAGIC = b"#ROSBAG V"
_ADVICE = {"not indexed": "rosbag reindex", "encryption": "rosbag decrypt", "Compression": "rosbag decompress"}
# Exceptions of rosbags for damaged files beside its ReaderError, which is unavailable if it is not installed
_DAMAGED = (struct.error, ValueError, LookupError, AssertionError, EOFError, OSError, RuntimeError, OverflowError)


def recognises(path: Path) -> bool:
    """True for a file with the magic bytes of a bag or named .bag."""
    return path.is_file() and (path.suffix == ".bag" or file_head(path, len(_MAGIC)) == _MAGIC)


def open_bag(path: Path, options: OpenOptions) -> Recording:
    """Open the recording in a ROS 1 bag."""
    return open_messages(path, "rosbag1", partial(BagFile, path), options)


class BagFile(AnyEncoding):
    """An open bag as a Container. A place: connection, log time in ns, index among its messages at that time."""

    def __init__(self, path: Path) -> None:
        super().__init__((path,))
        self._reader = _bounded_reader()(_BagPath(path))
        self._reader.file_bytes, self._reader.unpack = self.size, self.unpack
        try:
            self._reader.open()
        except (self._reader.error, *_DAMAGED) as error:
            raise RecordingError(f"{path} cannot be read: {_reason(error, path)}") from error
        self._connections = {connection.id: connection for connection in self._reader.connections}

    def messages(self) -> Iterator[Message]:
        """See Container: in the order of log times."""
        channels = {
            number: Channel(number, connection.topic, "ros1", connection.msgtype.replace("/msg/", "/"))
            for number, connection in self._connections.items()
        }
        known = [c for c in self._connections.values() if channels[c.id].type_name in KNOWN_TYPES]
        strange = [c for c in known if c.digest not in ("*", ros1_digest(channels[c.id].type_name))]
        if strange:
            there = ", ".join(f"{c.topic} ({c.msgtype}, {c.digest})" for c in strange)
            self.note("messages of another definition than ROS's", f"{there} left out")
        if not known:
            there = ", ".join(f"{c.topic} ({c.msgtype})" for c in self._connections.values()) or "none"
            self.note("no topic of a known type", there[:500])
        note_videos(channels.values(), self)
        last: dict[int, tuple[int, int]] = {}
        wanted = [c for c in known if c not in strange]
        try:
            for connection, stamp_ns, data in self._reader.messages(wanted) if wanted else ():
                before_ns, count = last.get(connection.id, (-1, 0))
                count = count + 1 if stamp_ns == before_ns else 0
                last[connection.id] = stamp_ns, count
                found = memoryview(self.unpack("", data))  # an index may count a message again and again
                yield channels[connection.id], stamp_ns, (connection.id, stamp_ns, count), found
        except (self._reader.error, *_DAMAGED) as error:
            self.note("the bag is damaged", f"what follows is not read: {_reason(error, self.path)}")

    def read(self, place: Place) -> bytes:
        number, stamp_ns, count = place
        self._unpacked = 0  # frames are read as often as the caller wants
        try:
            found = self._reader.messages([self._connections[number]], stamp_ns, stamp_ns + 1)
            return bytes(next(islice(found, count, None))[2])
        except (self._reader.error, StopIteration, *_DAMAGED) as error:
            raise RecordingError(f"{self.path}: {_reason(error, self.path)}") from error

    def close(self) -> None:
        if self._reader.bio is not None:
            self._reader.close()


class _BoundedFile(BufferedReader):
    """A file with a limit on single reads: the largest size of a message."""

    def read(self, size: int | None = -1) -> bytes:
        if size is None or not 0 <= size <= MAX_MESSAGE_BYTES:
            raise ValueError(f"a record of {size} bytes; the limit is {MAX_MESSAGE_BYTES}")
        return super().read(size)

    def readline(self, size: int | None = -1) -> bytes:
        return super().readline(100)  # only its first line is read this way


class _BagPath(PosixPath):
    """A path that opens a file with that limit."""

    def open(self, *_: object) -> BinaryIO:  # type: ignore[override]
        return _BoundedFile(FileIO(self))


@cache
def _bounded_reader() -> Any:
    """rosbags' reader with limits."""
    try:
        from rosbags.rosbag1 import Reader, ReaderError
        from rosbags.rosbag1.reader import decompressors
    except ImportError as error:
        install = "pip install '.[bags]' in fleetmap's source folder"
        raise RecordingError(f"ROS 1 bags need another library: {install}") from error
    kinds: dict[Any, str] = {each: kind.replace("none", "") for kind, each in decompressors.items()}

    class BoundedReader(Reader):
        error = ReaderError
        file_bytes, index_bytes = 0, 0
        unpack: Callable[[str, bytes], bytes]

        def read_chunk(self) -> Any:
            chunk = super().read_chunk()
            return chunk._replace(decompressor=partial(self.unpack, kinds[chunk.decompressor]))

        def read_index_data(self, pos: int, indexes: Any) -> None:
            assert self.bio is not None
            start = self.bio.tell()
            super().read_index_data(pos, indexes)
            self.index_bytes += self.bio.tell() - start
            if self.index_bytes > self.file_bytes:
                raise ReaderError("its index is larger than the file")

    return BoundedReader


def _reason(error: BaseException, path: Path) -> str:
    # Other exceptions come from Python, for invalid bytes
    is_told = type(error) is ValueError or type(error).__name__ == "ReaderError"
    words = " ".join(str(error).split())[:200].rstrip(".") if is_told else "a record is invalid"
    for sign, advice in _ADVICE.items():
        if sign in words:
            return f"{words}; `{advice} {path}` makes one that can be read"
    return f"{words}; it is damaged: `rosbag reindex {path}` saves what is whole"


FORMAT = RecordingFormat(
    "a ROS 1 .bag file", recognises, open_bag, (".bag",), 2, {(".bag.active",): "`rosbag reindex {path}` finishes it"}
)
