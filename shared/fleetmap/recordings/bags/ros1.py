"""Opens ROS 1 bags: rosbags reads them and turns their messages into ROS 2's, which are decoded here as any others.

Files may be hostile: what an index may make and a chunk may unpack to is limited. Source of the layout: ROS's bag format 2.0.
"""

import bz2
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from io import BufferedReader, FileIO
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from fleetmap.errors import RecordingError
from fleetmap.recordings.bags.codecs import ros1_digest
from fleetmap.recordings.bags.container import MAX_MESSAGE_BYTES, Channel, KeptBytes, Message, Place, Schema
from fleetmap.recordings.bags.streams import open_messages
from fleetmap.recordings.bags.topics import KNOWN_TYPES, type_name, video_issues
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.sensors.samples import DataIssue

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

_MAGIC = b"#ROSBAG V"
_ADVICE = {"not indexed": "rosbag reindex", "encryption": "rosbag decrypt", "Compression": "rosbag decompress"}
# What rosbags raises of damaged files beside its ReaderError, which is not at hand where it is not installed
_DAMAGED = (
    struct.error,
    ValueError,
    KeyError,
    IndexError,
    AssertionError,
    EOFError,
    OSError,
    RuntimeError,
    OverflowError,
)


def recognises(path: Path) -> bool:
    """Whether `path` is a file that begins as a bag does or is named .bag."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return path.suffix == ".bag" or file.read(len(_MAGIC)) == _MAGIC


def open_bag(path: Path, options: OpenOptions) -> Recording:
    """The recording in a ROS 1 bag."""
    return open_messages(path, "rosbag1", partial(BagFile, path), options)


class BagFile(KeptBytes):
    """An open bag as a Container. A place: connection, log time in ns, which of its messages at that time."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, path.stat().st_size)
        self.files: Sequence[Path] = (path,)
        self.name = ""
        self.attachments: Mapping[str, bytes] = {}
        self._issues: list[DataIssue] = []
        self._reader = _bounded_reader()(_BagPath(path))
        self._reader.file_bytes = self.size
        try:
            self._reader.open()
        except (self._reader.error, *_DAMAGED) as error:
            raise RecordingError(f"{path} cannot be read: {_reason(error, path)}") from error
        self._connections: dict[int, Connection] = {c.id: c for c in self._reader.connections}

    def messages(self) -> Iterator[Message]:
        """See Container: in the order of log times."""
        channels = {
            number: Channel(number, connection.topic, "ros1", Schema(connection.msgtype))
            for number, connection in self._connections.items()
        }
        known = [c for c in self._connections.values() if type_name(channels[c.id]) in KNOWN_TYPES]
        strange = [c for c in known if c.digest not in ("*", ros1_digest(c.msgtype))]
        if strange:
            there = ", ".join(f"{c.topic} ({c.msgtype}, {c.digest})" for c in strange)
            self._issues.append(DataIssue("messages of another definition than ROS's", f"{there} left out"))
        if not known:
            there = ", ".join(f"{c.topic} ({c.msgtype})" for c in self._connections.values()) or "none"
            self._issues.append(DataIssue("no topic of a known type", there[:500]))
        self._issues += video_issues(channels.values())
        last: dict[int, tuple[int, int]] = {}
        wanted = [c for c in known if c not in strange]
        try:
            for connection, stamp_ns, data in self._reader.messages(wanted) if wanted else ():
                before_ns, count = last.get(connection.id, (-1, 0))
                count = count + 1 if stamp_ns == before_ns else 0
                last[connection.id] = stamp_ns, count
                yield channels[connection.id], stamp_ns, (connection.id, stamp_ns, count), memoryview(data)
        except (self._reader.error, *_DAMAGED) as error:
            self._issues.append(
                DataIssue("the bag is damaged", f"what follows is not read: {_reason(error, self.path)}")
            )

    def issues(self) -> list[DataIssue]:
        return self._issues

    def read(self, place: Place) -> bytes:
        number, stamp_ns, count = place
        try:
            found = self._reader.messages([self._connections[number]], stamp_ns, stamp_ns + 1)
            return bytes(next(islice(found, count, None))[2])
        except (self._reader.error, StopIteration, *_DAMAGED) as error:
            raise RecordingError(f"{self.path}: {_reason(error, self.path)}") from error

    def close(self) -> None:
        if self._reader.bio is not None:
            self._reader.close()


class _BoundedFile(BufferedReader):
    """A file of which no more is read at once than a message may have."""

    def read(self, size: int | None = -1) -> bytes:
        if size is None or not 0 <= size <= MAX_MESSAGE_BYTES:
            raise ValueError(f"a record of {size} bytes; the limit is {MAX_MESSAGE_BYTES}")
        return super().read(size)

    def readline(self, size: int | None = -1) -> bytes:
        return super().readline(100)  # its first line is all that is read so


class _BagPath:
    """As much of a path as rosbags asks for."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def exists(self) -> bool:
        return True

    def open(self, _: str) -> BinaryIO:
        return _BoundedFile(FileIO(self._path))

    def __str__(self) -> str:
        return str(self._path)


@cache
def _bounded_reader() -> Any:
    """rosbags' reader with limits."""
    try:
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
        from rosbags.rosbag1 import Reader, ReaderError
        from rosbags.rosbag1.reader import decompressors
    except ImportError as error:
        raise RecordingError(
            "ROS 1 bags need a library more: pip install '.[bags]' in fleetmap's source folder"
        ) from error

    def bounded(unpack: Callable[[bytes, int], bytes]) -> Callable[[bytes], bytes]:
        def unpacked(data: bytes) -> bytes:
            found = unpack(data, MAX_MESSAGE_BYTES + 1)
            if len(found) > MAX_MESSAGE_BYTES:
                raise ReaderError(f"a chunk of {len(data)} bytes unpacks to more than {MAX_MESSAGE_BYTES}")
            return found

        return unpacked

    unpackers = {
        decompressors["bz2"]: bounded(lambda data, most: bz2.BZ2Decompressor().decompress(data, most)),
        decompressors["lz4"]: bounded(lambda data, most: LZ4FrameDecompressor().decompress(data, max_length=most)),
    }

    class BoundedReader(Reader):
        error = ReaderError
        file_bytes, index_bytes = 0, 0

        def read_chunk(self) -> Any:
            chunk = super().read_chunk()
            return chunk._replace(decompressor=unpackers.get(chunk.decompressor, chunk.decompressor))

        def read_index_data(self, pos: int, indexes: Any) -> None:
            assert self.bio is not None
            start = self.bio.tell()
            super().read_index_data(pos, indexes)
            self.index_bytes += self.bio.tell() - start
            if self.index_bytes > self.file_bytes:
                raise ReaderError("its index is larger than the file")

    return BoundedReader


def _reason(error: BaseException, path: Path) -> str:
    is_told = (
        type(error) is ValueError or type(error).__name__ == "ReaderError"
    )  # others are of Python, about bytes that make no sense
    words = " ".join(str(error).split())[:200].rstrip(".") if is_told else "a record makes no sense"
    for sign, advice in _ADVICE.items():
        if sign in words:
            return f"{words}; `{advice} {path}` makes one that can be read"
    return f"{words}; it is damaged: `rosbag reindex {path}` saves what is whole"
