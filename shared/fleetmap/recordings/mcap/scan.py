"""Walks through an MCAP file as far as it is whole, with or without its index, chunked or not.

Written for files that recorders left behind at a power loss: what does not fit is noted as a DataIssue, and where the
file still has its index the walk goes on at the next chunk. Files may be hostile: sizes are compared with limits before
anything is read or unpacked. Source of the layout: the MCAP specification (mcap.dev/spec).
"""

import struct
import zlib
from bisect import bisect_right
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard

from fleetmap.errors import RecordingError
from fleetmap.recordings.bags.container import MAX_MESSAGE_BYTES, Channel, KeptBytes, Message, Schema
from fleetmap.recordings.strange_files import what_file_instead
from fleetmap.sensors.samples import DataIssue

MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _CHUNK_INDEX = 1, 2, 3, 4, 5, 6, 8
_ATTACHMENT, _METADATA, _DATA_END = 9, 12, 15
_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_FOOTER_BYTES = 9 + 20 + len(MAGIC)
_LARGEST_RECORD_BYTES = 1 << 31  # beyond it the bytes are no record at all
MAX_CHUNK_BYTES = MAX_MESSAGE_BYTES  # recorders write chunks of 1 to 4 MiB
MAX_ATTACHMENT_BYTES = 16 << 20
_MAX_RECORD_BYTES = MAX_CHUNK_BYTES + (64 << 10)  # a chunk that is not compressed, with its head


class Location(NamedTuple):
    """Position of a message's bytes: in the file itself, or in a compressed chunk (chunk_at >= 0) after decompression."""

    at: int
    length: int
    chunk_at: int = -1


@dataclass(slots=True)
class Damage:
    """Records that could not be read, counted while walking."""

    issues: list[DataIssue] = field(default_factory=list)
    bad_chunks: int = 0
    bad_chunk_bytes: int = 0
    first_bad_chunk_at: int = -1
    too_large: int = 0

    def chunk(self, at: int, size: int) -> None:
        """One chunk that is not what it was when it was written."""
        self.first_bad_chunk_at = at if self.bad_chunks == 0 else self.first_bad_chunk_at
        self.bad_chunks += 1
        self.bad_chunk_bytes += size

    def all(self) -> list[DataIssue]:
        """Everything in words."""
        found = list(self.issues)
        if self.too_large:
            limits = f"{MAX_CHUNK_BYTES >> 20} MiB in a chunk, {MAX_ATTACHMENT_BYTES >> 20} MiB in an attachment"
            found.append(DataIssue("records that are too large", f"{self.too_large} left out; the limits are {limits}"))
        if self.bad_chunks:
            detail = f"{self.bad_chunks} with {self.bad_chunk_bytes} bytes left out"
            where = f"{detail}, the first at byte {self.first_bad_chunk_at}"
            found.append(DataIssue("damaged chunks (checksum or compression)", where))
        return found


class McapScan(KeptBytes):
    """One walk through a file: `messages()` fills channels, attachments, metadata and damage on its way to the end."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        super().__init__(path, path.stat().st_size)
        self._file = file
        self.channels: dict[int, Channel] = {}
        self.attachments: dict[str, bytes] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.damage = Damage()
        self._schemas: dict[int, Schema] = {}
        self._chunk_starts: list[int] | None = None
        self._has_ended = False

    def messages(self) -> Iterator[Message]:
        """Channel, log time in ns, place and bytes of every message that is whole, in file order."""
        self._file.seek(0)
        if self._file.read(len(MAGIC)) != MAGIC:
            fault = what_file_instead(self.path) or "no MCAP file: it does not begin as one; copy the recording again"
            raise RecordingError(f"{self.path} is {fault}")
        at = len(MAGIC)
        while not self._has_ended:
            next_at = yield from self._record(at)
            if next_at is None:
                next_at = self._next_indexed_chunk(at)
                if next_at is None:
                    return
            at = next_at
        self._file.seek(max(0, self.size - len(MAGIC)))
        if self._file.read() != MAGIC:
            self._note("the file ends inside its index", "no message is missing")

    def _record(self, at: int) -> Generator[Message, None, int | None]:
        """Yields the messages of the record at `at`.

        Returns where the next one begins, None where this one is not whole.
        """
        self._file.seek(at)
        head = self._file.read(_RECORD_HEAD.size)
        if len(head) < _RECORD_HEAD.size:
            self._note(
                "the file has no end mark",
                "the recorder was stopped hard" if not head else "it ends inside a record's head",
            )
            return None
        opcode, length = _RECORD_HEAD.unpack(head)
        start, rest = at + len(head), self.size - at - len(head)
        if not _HEADER <= opcode < 0x80 or length > _LARGEST_RECORD_BYTES:
            self._note("not an MCAP record", f"{rest} bytes from byte {at} on are not readable in sequence")
            return None
        if length > rest:
            self._note(
                "the file ends inside a record",
                f"{length - rest} of {length} bytes of the record at byte {at} are missing",
            )
            if opcode == _CHUNK:
                yield from self._chunk(start, self._file.read(min(rest, _MAX_RECORD_BYTES)), is_cut=True)
            return None
        if opcode in (_DATA_END, _FOOTER):
            self._has_ended = True
        elif length > (MAX_ATTACHMENT_BYTES if opcode == _ATTACHMENT else _MAX_RECORD_BYTES):
            self.damage.too_large += 1
        elif opcode == _CHUNK:
            yield from self._chunk(start, self._file.read(length), is_cut=False)
        elif opcode in (_SCHEMA, _CHANNEL, _MESSAGE, _ATTACHMENT, _METADATA):
            content = memoryview(self._file.read(length))
            yield from self._content(opcode, content, Location(start, length))
        return int(start + length)

    def _chunk(self, at: int, content: bytes, *, is_cut: bool) -> Iterator[Message]:
        try:
            _, _, uncompressed_size, crc, name_length = struct.unpack_from("<QQQII", content)
            compression = content[32 : 32 + name_length].decode("ascii")
            records_at = 32 + name_length + 8
            packed = memoryview(content)[records_at:]
            (packed_size,) = struct.unpack_from("<Q", content, records_at - 8)
            if is_cut and compression:
                raise ValueError("the rest of a compressed chunk says nothing")
            if is_cut:
                records = packed
            else:
                if packed_size > len(packed):
                    raise ValueError("the chunk holds more than its record")
                if uncompressed_size > MAX_CHUNK_BYTES:
                    self.damage.too_large += 1
                    return
                records = memoryview(decompress(compression, packed[:packed_size], uncompressed_size))
                if len(records) != uncompressed_size or (crc and zlib.crc32(records) != crc):
                    raise ValueError("checksum")
        except (struct.error, ValueError, zstandard.ZstdError):
            self.damage.chunk(at, len(content))
            return
        base = Location(at + records_at, 0) if not compression else Location(0, 0, at)
        yield from self._records_in_chunk(records, base)

    def _records_in_chunk(self, records: memoryview, base: Location) -> Iterator[Message]:
        position = 0
        while position + _RECORD_HEAD.size <= len(records):
            opcode, length = _RECORD_HEAD.unpack_from(records, position)
            position += _RECORD_HEAD.size
            if position + length > len(records):
                return
            location = Location(base.at + position, length, base.chunk_at)
            yield from self._content(opcode, records[position : position + length], location)
            position += length

    def _content(self, opcode: int, content: memoryview, location: Location) -> Iterator[Message]:
        try:
            if opcode == _MESSAGE:
                channel_id, _, log_time, _ = _MESSAGE_HEAD.unpack_from(content)
                head = _MESSAGE_HEAD.size
                body = Location(location.at + head, location.length - head, location.chunk_at)
                channel = self.channels.get(channel_id)
                if channel is None:
                    raise ValueError(f"message of an unknown channel {channel_id}")
                yield channel, log_time, body, content[head:]
            elif opcode == _SCHEMA:
                self._read_schema(content)
            elif opcode == _CHANNEL:
                self._read_channel(content)
            elif opcode == _ATTACHMENT:
                self._read_attachment(content)
            elif opcode == _METADATA:
                name, at = _text(content, 0)
                self.keep(4 * len(content))
                self.metadata[name] = _text_map(content, at)
        except (struct.error, ValueError) as error:
            fault = "it ends too early" if isinstance(error, struct.error) else str(error)
            self._note("a damaged record", f"kind {opcode} at byte {location.at}: {fault}")

    def _read_schema(self, content: memoryview) -> None:
        (schema_id,) = struct.unpack_from("<H", content)
        name, at = _text(content, 2)
        encoding, at = _text(content, at)
        (length,) = struct.unpack_from("<I", content, at)
        self.keep(len(content))
        self._schemas.setdefault(schema_id, Schema(name, encoding, bytes(content[at + 4 : at + 4 + length])))

    def _read_channel(self, content: memoryview) -> None:
        channel_id, schema_id = struct.unpack_from("<HH", content)
        topic, at = _text(content, 4)
        encoding, _ = _text(content, at)
        self.keep(len(content))
        schema = self._schemas.get(schema_id, Schema("", "", b""))
        self.channels.setdefault(channel_id, Channel(channel_id, topic, encoding, schema))

    def _read_attachment(self, content: memoryview) -> None:
        name, at = _text(content, 16)
        _, at = _text(content, at)
        (length,) = struct.unpack_from("<Q", content, at)
        data = bytes(content[at + 8 : at + 8 + length])
        (crc,) = struct.unpack_from("<I", content, at + 8 + length)
        if crc and zlib.crc32(content[: at + 8 + length]) != crc:
            raise ValueError(f"the attachment {name[:80]!r} fails its checksum")
        self.keep(length)
        self.attachments[name] = data

    def _next_indexed_chunk(self, after: int) -> int | None:
        """Start of the first chunk behind `after`, by the index at the file's end; None without one."""
        if self._chunk_starts is None:
            self._chunk_starts = sorted(self._indexed_chunks())
        behind = bisect_right(self._chunk_starts, after)
        return self._chunk_starts[behind] if behind < len(self._chunk_starts) else None

    def _indexed_chunks(self) -> Iterator[int]:
        self._file.seek(max(0, self.size - _FOOTER_BYTES))
        tail = self._file.read(_FOOTER_BYTES)
        if len(tail) < _FOOTER_BYTES or tail[0] != _FOOTER or not tail.endswith(MAGIC):
            return
        (summary_at,) = struct.unpack_from("<Q", tail, 9)
        at = summary_at
        while 0 < at <= self.size - _RECORD_HEAD.size:
            self._file.seek(at)
            head = self._file.read(_RECORD_HEAD.size + 24)
            opcode, length = _RECORD_HEAD.unpack_from(head)
            if opcode == _CHUNK_INDEX and length >= 24 and len(head) == _RECORD_HEAD.size + 24:
                (chunk_at,) = struct.unpack_from("<Q", head, _RECORD_HEAD.size + 16)
                if chunk_at < summary_at:
                    self.keep(0)
                    yield chunk_at
            at += _RECORD_HEAD.size + length

    def _note(self, what: str, detail: str) -> None:
        if len(self.damage.issues) < 20:
            self.damage.issues.append(DataIssue(what, detail))


def decompress(compression: str, packed: memoryview, uncompressed_size: int) -> bytes:
    """The records of a chunk, at most one byte more than `uncompressed_size`; ValueError for what cannot be decompressed.

    Never more than that is unpacked, whatever the compressed bytes say of themselves.
    """
    if uncompressed_size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {uncompressed_size} bytes; the limit is {MAX_CHUNK_BYTES}")
    if compression == "":
        return bytes(packed)
    if compression == "zstd":
        unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
        with unpacker.stream_reader(packed) as reader:
            return bytes(reader.read(uncompressed_size + 1))
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

        try:
            return bytes(LZ4FrameDecompressor().decompress(packed, max_length=uncompressed_size + 1))
        except RuntimeError as error:
            raise ValueError(str(error)) from error
    raise ValueError(f"chunk compression {compression[:80]!r} is not known; known are zstd, lz4 and none")


class MessageReader:
    """Reads messages by their place; keeps the last decompressed chunks, so that going through in order is cheap."""

    _KEPT_CHUNKS = 2

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self._path, self._file = path, file
        self._chunks: dict[int, bytes] = {}

    def read(self, location: Location) -> bytes:
        """The bytes of one message; RecordingError where the file is not what it was any more."""
        if location.chunk_at >= 0:
            return self._chunk(location.chunk_at)[location.at : location.at + location.length]
        self._file.seek(location.at)
        data = self._file.read(location.length)
        if len(data) < location.length:
            raise RecordingError(f"{self._path} became shorter while it was read; is it still being written?")
        return data

    def _chunk(self, at: int) -> bytes:
        if at not in self._chunks:
            self._file.seek(at)
            head = self._file.read(32)
            _, _, uncompressed_size, _, name_length = struct.unpack("<QQQII", head)
            compression = self._file.read(name_length).decode("ascii")
            (packed_size,) = struct.unpack("<Q", self._file.read(8))
            while len(self._chunks) >= self._KEPT_CHUNKS:
                del self._chunks[next(iter(self._chunks))]
            self._chunks[at] = decompress(
                compression, memoryview(self._file.read(min(packed_size, _MAX_RECORD_BYTES))), uncompressed_size
            )
        return self._chunks[at]


def _text(content: memoryview, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    end = at + 4 + length
    if end > len(content):
        raise ValueError("a text reaches past its record")
    return bytes(content[at + 4 : end]).decode("utf-8", "replace"), end


def _text_map(content: memoryview, at: int) -> dict[str, str]:
    (length,) = struct.unpack_from("<I", content, at)
    at += 4
    end, pairs = at + length, {}
    while at < end:
        key, at = _text(content, at)
        pairs[key], at = _text(content, at)
    return pairs
