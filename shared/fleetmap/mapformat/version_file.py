"""A version exported to one file: layout and reader. The server writes it, `mapserver import` and robots read it.

    offset  type   content
    0       4 s    magic FMEX
    4       u16    format number: 3 with surfels, 2 with a grid, else 1
    6       u16    0
    8       u32    size of the head
    12      ...    head, JSON: site, version, and of every blob its kind, SHA-256 and size
    ...     ...    the blobs' bytes in that order: manifest, vocabulary, tiles, grid, surfels and archive (if included)
    end-32  32 s   SHA-256 of everything before

Little-endian. The file contains no paths: blobs are stored by their SHA-256. Reading holds one map blob at a time in
memory, for any file; the archive is read in pieces.
"""

import hashlib
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from fleetmap.encoding import decode_json, to_json
from fleetmap.errors import MapFormatError, StoreError, check_format, disk_errors
from fleetmap.mapformat.manifest import MAX_MANIFEST_BYTES, Manifest, Name, Positive, Sha256, decode_manifest
from fleetmap.mapformat.names import check_name, verified
from fleetmap.mapformat.tile import decode_tile

EXPORT_MAGIC = b"FMEX"
EXPORT_FORMAT = 3
BlobKind = Literal["manifest", "vocabulary", "tile", "grid", "surfel", "archive"]
MAX_BLOB_BYTES: dict[BlobKind, int] = {
    "manifest": MAX_MANIFEST_BYTES,
    "vocabulary": 256 << 20,
    "tile": 64 << 20,
    "grid": 64 << 20,
    "surfel": 256 << 20,
    "archive": 1 << 33,
}
_UNNAMED = {"manifest", "archive", "grid", "surfel"}
DIGEST_BYTES = 32
_START = struct.Struct("<4sHHI")
_MAX_HEAD_BYTES = 64 << 20
_CHUNK_BYTES = 1 << 20


class ExportBlob(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One blob in the file."""

    kind: BlobKind
    sha256: Sha256
    bytes: Positive


class ExportHead(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Content of the file."""

    site: Name
    version: Annotated[int, msgspec.Meta(ge=1, le=1 << 31)]
    blobs: tuple[ExportBlob, ...]

    def archive(self) -> ExportBlob | None:
        """The archive, if included."""
        return next((blob for blob in self.blobs if blob.kind == "archive"), None)

    def start(self) -> bytes:
        """Bytes of the file before the first blob."""
        text = to_json(self, order="deterministic")
        number = max({"grid": 2, "surfel": 3}.get(blob.kind, 1) for blob in self.blobs)
        return _START.pack(EXPORT_MAGIC, number, 0, len(text)) + text

    def file_bytes(self) -> int:
        """Size of the whole file."""
        return len(self.start()) + sum(blob.bytes for blob in self.blobs) + DIGEST_BYTES


class ExportReader:
    """An open export file. Use its content only after the checks."""

    def __init__(self, descriptor: int, path: Path) -> None:
        self._descriptor = descriptor
        self._path = path
        self._size = os.fstat(descriptor).st_size
        self.head, body = self._read_head()
        self._starts = list(accumulate((blob.bytes for blob in self.head.blobs), initial=body))

    def check_whole(self) -> None:
        """Raise MapFormatError unless the file's own SHA-256 is correct; reads the whole file once."""
        whole = hashlib.sha256()
        for chunk in self._span(0, self._size - DIGEST_BYTES):
            whole.update(chunk)
        if whole.digest() != b"".join(self._span(self._size - DIGEST_BYTES, self._size)):
            raise self._damaged("its SHA-256 is not that of its bytes")

    def manifest(self) -> Manifest:
        """The manifest, which must name exactly the blobs of the head; raises MapFormatError otherwise."""
        blob = self.head.blobs[0]
        manifest = decode_manifest(self.data(0))
        named = {("vocabulary", manifest.vocabulary.sha256, manifest.vocabulary.bytes)}
        named |= {("tile", tile.sha256, tile.bytes) for tile in manifest.tiles}
        held = [(b.kind, b.sha256, b.bytes) for b in self.head.blobs if b.kind not in _UNNAMED]
        if (manifest.site, manifest.version) != (self.head.site, self.head.version) or blob.kind != "manifest":
            raise self._damaged("its manifest is that of another version")
        if len(held) != len(named) or set(held) != named:
            raise self._damaged("it does not hold exactly what its manifest names")
        if len({(tile.x, tile.y) for tile in manifest.tiles}) != len(manifest.tiles):
            raise self._damaged("its manifest names a tile twice")
        check_name(manifest.site, "site")
        return manifest

    def check_tiles(self, manifest: Manifest) -> None:
        """Raise MapFormatError unless every tile is valid and matches the manifest."""
        number_of = {blob.sha256: number for number, blob in enumerate(self.head.blobs)}
        for entry in manifest.tiles:
            tile = decode_tile(self.data(number_of[entry.sha256]))
            if (tile.tile_x, tile.tile_y, len(tile)) != (entry.x, entry.y, entry.landmarks):
                raise self._damaged(f"tile {entry.x},{entry.y} is not the one that its manifest names")

    def data(self, number: int) -> bytes:
        """Read the bytes of a blob; raises MapFormatError if they are damaged."""
        return verified(b"".join(self.chunks(number)), self.head.blobs[number].sha256)

    def chunks(self, number: int) -> Iterator[bytes]:
        """Read the bytes of a blob in pieces, unverified."""
        return self._span(self._starts[number], self._starts[number + 1])

    def _read_head(self) -> tuple[ExportHead, int]:
        if self._size < _START.size + DIGEST_BYTES:
            raise self._damaged(f"{self._size} bytes are too few")
        magic, number, reserved, head_bytes = _START.unpack(b"".join(self._span(0, _START.size)))
        check_format(str(self._path), magic, EXPORT_MAGIC, number, EXPORT_FORMAT)
        if number < 1 or reserved != 0 or head_bytes > min(_MAX_HEAD_BYTES, self._size):
            raise self._damaged(f"format {number}, head of {head_bytes} bytes")
        body = _START.size + head_bytes
        head = decode_json(b"".join(self._span(_START.size, body)), ExportHead, str(self._damaged("{}")))
        kinds = [blob.kind for blob in head.blobs]
        if kinds[:1] != ["manifest"] or kinds.count("manifest") != 1 or kinds.count("archive") > 1:
            raise self._damaged("it does not begin with one manifest, or has several archives")
        if any(blob.bytes > MAX_BLOB_BYTES[blob.kind] for blob in head.blobs):
            raise self._damaged("a blob is larger than its kind may be")
        if body + sum(blob.bytes for blob in head.blobs) + DIGEST_BYTES != self._size:
            raise self._damaged(f"its head does not fit its {self._size} bytes")
        return head, body

    def _span(self, start: int, end: int) -> Iterator[bytes]:
        while start < end:
            chunk = os.pread(self._descriptor, min(_CHUNK_BYTES, end - start), start)
            if not chunk:
                raise self._damaged("it became shorter while it was read")
            start += len(chunk)
            yield chunk

    def _damaged(self, why: str) -> MapFormatError:
        return MapFormatError(f"{self._path} is not a complete export: {why}; export it again")


@contextmanager
def open_export(path: Path) -> Iterator[ExportReader]:
    """Open the export file at `path`.

    Raises StoreError if it cannot be read, NewerFormatError for a newer format, MapFormatError for anything
    else but a complete export.
    """
    with disk_errors(f"{path} cannot be read", "check the path"):
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        yield ExportReader(descriptor, path)
    except OSError as error:
        raise StoreError(f"{path} cannot be read ({error.strerror}); check the disk") from error
    finally:
        os.close(descriptor)
