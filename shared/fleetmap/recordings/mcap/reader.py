"""Opens MCAP recordings: whole, cut off or damaged, with or without their index.

The mcap library parses the records. Its readers are not used, because they stop at the first damage, allocate as the file declares, and
lose a chunk truncated by a power failure. Here damage is noted as a DataIssue, reading continues at the next chunk if the file
still has its index, and sizes are compared with limits before anything is read or unpacked.
"""

import re
import struct
import zlib
from bisect import bisect_right
from collections.abc import Generator, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from io import BytesIO
from pathlib import Path
from typing import Any

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from fleetmap.errors import RecordingError
from fleetmap.recordings.files import file_head, natural_key, what_file_instead
from fleetmap.recordings.limits import MAX_MESSAGE_BYTES, unpack, unpack_message
from fleetmap.recordings.mcap.streams import Channel, Container, Message, Place, open_written
from fleetmap.recordings.ordering import UNCERTAIN_STAMPS
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.sensors.samples import DataIssue

MAGIC = b"\x89MCAP0\r\n"
_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_LARGEST_RECORD_BYTES = 1 << 31  # larger lengths are not those of a record
_MAX_RECORD_BYTES = MAX_MESSAGE_BYTES + (64 << 10)  # an uncompressed chunk, with its header
_KEPT_CHUNKS = 2  # unpacked chunks kept, so that sequential reading is cheap
_PARSED: dict[int, Any] = {
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.ATTACHMENT: records.Attachment,
    Opcode.METADATA: records.Metadata,
    Opcode.CHUNK: records.Chunk,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.FOOTER: records.Footer,
}


def recognises(path: Path) -> bool:
    """True for a file with MCAP's magic bytes or named .mcap, or a rosbag2 folder with such files."""
    if path.is_dir():
        return any(path.glob("*.mcap"))
    return path.is_file() and (path.suffix == ".mcap" or file_head(path, len(MAGIC)) == MAGIC)


def open_mcap(path: Path, options: OpenOptions) -> Recording:
    """Open the recording that this project wrote to an MCAP file, or to a folder of parts; its issues list damaged and missing data."""
    return open_written(path, partial(McapFiles, parts_at(path)), options)


def parts_at(path: Path) -> tuple[Path, ...]:
    """The MCAP files of the recording at `path`. RecordingError for a folder with several recordings."""
    files = sorted(path.glob("*.mcap"), key=lambda file: natural_key(file.name)) if path.is_dir() else [path]
    names = {re.sub(r"_\d+$", "", file.stem) for file in files}
    if len(names) > 1:
        raise RecordingError(
            f"{path} holds {len(files)} .mcap files of several recordings ({', '.join(sorted(names)[:5])}); choose one of them, or "
            "name the parts of one NAME_0.mcap, NAME_1.mcap"
        )
    return tuple(files)


class McapFiles(Container):
    """The parts of one recording, in the order of their names, as a Container. A place: number of the part, then as in McapFile."""

    def __init__(self, files: Sequence[Path]) -> None:
        super().__init__(files)
        self._parts = [McapFile(file) for file in files]

    def messages(self) -> Iterator[Message]:
        """See Container: part by part, in the order of each file. Equal channels of several parts are one."""
        alike: dict[Channel, Channel] = {}
        for number, part in enumerate(self._parts):
            channels: dict[int, Channel] = {}
            for channel, log_time_ns, place, data in part.messages():
                if channel.id not in channels:
                    channels[channel.id] = alike.setdefault(replace(channel, id=0), replace(channel, id=len(alike)))
                yield channels[channel.id], log_time_ns, (number, *place), data
            self.name = self.name or part.name
            self.attachments = part.attachments | self.attachments
            where = f"{part.path.name}: " if len(self._parts) > 1 else ""
            self.issues += [replace(issue, detail=where + issue.detail) for issue in part.issues]

    def read(self, place: Place) -> bytes:
        return self._parts[place[0]].read(place[1:])

    def close(self) -> None:
        for part in self._parts:
            part.close()


class McapFile(Container):
    """An open MCAP file as a Container. A place: byte, length, and -1, or the byte of the compressed chunk in whose content they lie."""

    def __init__(self, path: Path) -> None:
        super().__init__((path,))
        self._file = path.open("rb")
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, tuple[str, bytes]] = {}
        self._unpacked_chunk = lru_cache(_KEPT_CHUNKS)(self._unpack_chunk)
        self._too_large = 0
        self._bad_chunks: list[tuple[int, int]] = []  # byte and size

    def messages(self) -> Iterator[Message]:
        """See Container: in the order of the file."""
        if self._bytes(0, len(MAGIC)) != MAGIC:
            fault = what_file_instead(self.path) or "not an MCAP file: it begins differently; copy the recording again"
            raise RecordingError(f"{self.path} is {fault}")
        at = len(MAGIC)
        while at:
            at = yield from self._record(at)
        if self._too_large:
            limit = f"the limit of a record is {MAX_MESSAGE_BYTES >> 20} MiB"
            self.issues.append(DataIssue("records that are too large", f"{self._too_large} left out; {limit}"))
        if self._bad_chunks:
            size = sum(size for _, size in self._bad_chunks)
            where = f"{len(self._bad_chunks)} with {size} bytes left out, the first at byte {self._bad_chunks[0][0]}"
            self.issues.append(DataIssue("damaged chunks (checksum or compression)", where))

    def read(self, place: Place) -> bytes:
        at, length, chunk_at = place
        data = self._unpacked_chunk(chunk_at)[at : at + length] if chunk_at >= 0 else self._bytes(at, length)
        if len(data) < length:
            raise RecordingError(f"{self.path} became shorter while it was read; is it still being written?")
        return bytes(unpack_message(memoryview(data)))

    def close(self) -> None:
        self._file.close()

    def _bytes(self, at: int, length: int) -> bytes:
        self._file.seek(at)
        return self._file.read(length)

    def _record(self, at: int) -> Generator[Message, None, int]:
        """Yield the messages of the record at `at`; return the start of the next one, 0 at the end."""
        head, start = self._bytes(at, _RECORD_HEAD.size), at + _RECORD_HEAD.size
        rest = self.size - start
        opcode, length = _RECORD_HEAD.unpack(head.ljust(_RECORD_HEAD.size, b"\0"))
        if rest < 0:
            why = "it ends inside a record's head" if head else "the recorder was stopped hard"
            self.note("the file has no end mark", why)
        elif not 1 <= opcode < 0x80 or length > _LARGEST_RECORD_BYTES:
            self.note("not an MCAP record", f"{rest} bytes from byte {at} on are not readable in sequence")
        elif length > rest:
            missing = f"{length - rest} of {length} bytes of the record at byte {at} are missing"
            self.note("the file ends inside a record", missing)
            if opcode == Opcode.CHUNK:
                yield from self._chunk(start, self._bytes(start, min(rest, _MAX_RECORD_BYTES)), is_cut=True)
        elif opcode in (Opcode.DATA_END, Opcode.FOOTER):
            if self._bytes(max(0, self.size - len(MAGIC)), len(MAGIC)) != MAGIC:
                self.note("the file ends inside its index", "no message is missing")
            return 0
        else:
            if length > _MAX_RECORD_BYTES:
                self._too_large += 1
            elif opcode == Opcode.CHUNK:
                yield from self._chunk(start, self._bytes(start, length))
            elif opcode == Opcode.MESSAGE or opcode in _PARSED:
                yield from self._content(opcode, memoryview(self._bytes(start, length)), start, -1)
            return start + int(length)
        starts = self._chunk_starts
        return next(iter(starts[bisect_right(starts, at) :]), 0)

    def _chunk(self, at: int, content: bytes, *, is_cut: bool = False) -> Iterator[Message]:
        try:
            chunk = _parsed(Opcode.CHUNK, content)
            if chunk.uncompressed_size > MAX_MESSAGE_BYTES:
                self._too_large += 1
                return
            if is_cut and chunk.compression:
                raise ValueError("the rest of a compressed chunk says nothing")
            unpacked = memoryview(self.unpack(chunk.compression, chunk.data, chunk.uncompressed_size))
            is_whole, crc = len(unpacked) == chunk.uncompressed_size, chunk.uncompressed_crc
            if not is_cut and not (is_whole and (not crc or zlib.crc32(unpacked) == crc)):
                raise ValueError("checksum")
        except ValueError:
            self._bad_chunks.append((at, len(content)))
            return
        # Records that are not compressed are in the file, behind the chunk's header
        base, chunk_at = (0, at) if chunk.compression else (at + 40, -1)
        position = 0
        while position + _RECORD_HEAD.size <= len(unpacked):
            opcode, length = _RECORD_HEAD.unpack_from(unpacked, position)
            position += _RECORD_HEAD.size
            self.pass_record()
            if position + length > len(unpacked):
                return
            if opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
                yield from self._content(opcode, unpacked[position : position + length], base + position, chunk_at)
            position += length

    def _content(self, opcode: int, content: memoryview, at: int, chunk_at: int) -> Iterator[Message]:
        """Yield the message in a record's content at byte `at`; other records are kept."""
        try:
            if opcode != Opcode.MESSAGE:
                self._keep_record(_parsed(opcode, content), content)
                return
            if len(content) < (head := _MESSAGE_HEAD.size):
                raise ValueError("it ends too early")
            channel_id, _, log_time, _ = _MESSAGE_HEAD.unpack_from(content)
            if channel_id not in self._channels:
                _ = self._chunk_starts  # its own record may be in a damaged chunk, and is again in the index
            if channel_id not in self._channels:
                raise ValueError(f"message of an unknown channel {channel_id}")
            data = unpack_message(content[head:], self.unpack)
        except ValueError as error:
            self.note("a damaged record", f"kind {opcode} at byte {at}: {error}")
            return
        yield self._channels[channel_id], log_time, (at + head, len(content) - head, chunk_at), data

    def _keep_record(self, record: Any, content: memoryview) -> None:
        self.keep(len(content))
        match record:
            case records.Schema():
                self._schemas.setdefault(record.id, (record.name.replace("/msg/", "/"), record.data))
            case records.Channel():
                schema = self._schemas.get(record.schema_id, ("", b""))
                channel = Channel(record.id, record.topic, record.message_encoding, *schema)
                self._channels.setdefault(record.id, channel)
            case records.Attachment():
                (crc,) = struct.unpack_from("<I", content, len(content) - 4)
                if crc and zlib.crc32(content[:-4]) != crc:
                    raise ValueError(f"the attachment {record.name[:80]!r} fails its checksum")
                self.attachments[record.name] = record.data
            case records.Metadata(name="fleetmap"):  # metadata of the whole recording, by McapRecordingWriter
                self.name = record.metadata.get("name", self.name)
                if "stamps" in record.metadata:
                    self.issues.append(UNCERTAIN_STAMPS)

    def _unpack_chunk(self, at: int) -> bytes:
        length = int.from_bytes(self._bytes(at - 8, 8), "little")
        chunk = _parsed(Opcode.CHUNK, self._bytes(at, min(length, _MAX_RECORD_BYTES)))
        return unpack(chunk.compression, chunk.data)

    @cached_property
    def _chunk_starts(self) -> list[int]:
        """Starts of the chunks by the index at the file's end, empty without one; schemas and channels there are kept."""
        starts: list[int] = []
        tail_bytes = _RECORD_HEAD.size + 20 + len(MAGIC)  # footer and end mark
        tail = self._bytes(max(0, self.size - tail_bytes), tail_bytes)
        is_whole = len(tail) == tail_bytes and tail[0] == Opcode.FOOTER and tail.endswith(MAGIC)
        at = summary_at = _parsed(Opcode.FOOTER, tail[_RECORD_HEAD.size :]).summary_start if is_whole else 0
        while 0 < at <= self.size - _RECORD_HEAD.size:
            opcode, length = _RECORD_HEAD.unpack(self._bytes(at, _RECORD_HEAD.size))
            at += _RECORD_HEAD.size
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK_INDEX) and length <= _MAX_RECORD_BYTES:
                content = memoryview(self._bytes(at, length))
                try:
                    record = _parsed(opcode, content)
                except ValueError:
                    break
                if opcode != Opcode.CHUNK_INDEX:
                    self._keep_record(record, content)
                elif record.chunk_start_offset < summary_at:
                    self.keep(0)
                    starts.append(record.chunk_start_offset)
            at += length
        return sorted(starts)


def _parsed(opcode: int, content: bytes | memoryview) -> Any:
    """Parse a record with the mcap library, from its content alone; ValueError for invalid content."""
    try:
        return _PARSED[opcode].read(ReadDataStream(BytesIO(content)))
    except (McapError, struct.error, UnicodeDecodeError, OverflowError) as error:  # the last: of lengths beyond 63 bits
        raise ValueError("it ends too early, or is not text") from error
