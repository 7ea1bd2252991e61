"""One version as one file, to carry it to another store or to a robot; fleetmap.mapformat.version_file describes and reads it."""

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import cast

from fleetmap.errors import MapFormatError, disk_errors
from fleetmap.mapformat import Manifest
from fleetmap.mapformat.version_file import BlobKind, ExportBlob, ExportHead
from mapserver.store.blobs import BlobFolder
from mapserver.store.files import write_atomically
from mapserver.store.rows import VersionInfo


def export_head(
    info: VersionInfo, manifest: Manifest, blobs: BlobFolder, kept: Sequence[tuple[str, str]]
) -> ExportHead:
    """What the file of a version holds. kept: kind and address of what robots do not fetch; StoreError where the store lacks it."""
    entries = [ExportBlob(kind="manifest", sha256=info.manifest_sha256, bytes=info.manifest_bytes)]
    entries.append(ExportBlob(kind="vocabulary", sha256=manifest.vocabulary.sha256, bytes=manifest.vocabulary.bytes))
    tiles = {tile.sha256: tile.bytes for tile in manifest.tiles}
    entries += [ExportBlob(kind="tile", sha256=sha256, bytes=size) for sha256, size in tiles.items()]
    for kind, sha256 in kept:
        size = sum(len(chunk) for chunk in blobs.chunks(sha256))
        entries.append(ExportBlob(kind=cast(BlobKind, kind), sha256=sha256, bytes=size))
    return ExportHead(site=info.site, version=info.version, blobs=tuple(entries))


def write_export(path: Path, head: ExportHead, blobs: BlobFolder) -> int:
    """Writes a version into the file at `path`, whole or not at all, and returns its size.

    Raises StoreError where the disk refuses, MapFormatError for damaged bytes in the store.
    """
    with disk_errors(f"{path} cannot be written", "check the folder, its space and rights"):
        write_atomically(path, export_chunks(head, blobs))
        return path.stat().st_size


def export_chunks(head: ExportHead, blobs: BlobFolder) -> Iterator[bytes]:
    """The bytes of the file in pieces; MapFormatError, before its end, for damaged bytes in the store."""
    start = head.start()
    whole = hashlib.sha256(start)
    yield start
    for blob in head.blobs:
        own, size = hashlib.sha256(), 0
        for chunk in blobs.chunks(blob.sha256):
            own.update(chunk)
            whole.update(chunk)
            size += len(chunk)
            yield chunk
        if own.hexdigest() != blob.sha256 or size != blob.bytes:
            raise MapFormatError(f"{blob.kind} {blob.sha256} in the store is damaged; run `mapserver verify`")
    yield whole.digest()
