"""PNG files: their checksums, and the pixels of those that cameras write, in a third of the time that OpenCV's zlib and libpng take.

Source: Portable Network Graphics (PNG) Specification, third edition.
"""

import struct
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import cv2
import numpy as np

from fleetmap import core
from fleetmap.geometry import AnyArray
from fleetmap.recordings.limits import MAX_PIXELS

# isal has wheels for x86-64 and 64-bit ARM; elsewhere Python's own does the same, more slowly.
_zlib: Any = import_module("isal.isal_zlib" if find_spec("isal") else "zlib")
PNG_START = b"\x89PNG\r\n\x1a\n"
_PIXEL_BYTES = {(8, 0): 1, (16, 0): 2, (8, 2): 3}  # by bits and kind of colour: grey, and red, green and blue
_HEAD = struct.Struct(">IIBBBBB")
# Chunks that change pixels: a colour that is transparent, and further pictures. Those with a capital letter must be understood.
_CHANGING = {b"tRNS", b"acTL"}
_UNDERSTOOD = {b"IHDR", b"IDAT", b"IEND"}


def is_damaged_png(data: bytes) -> bool:
    """True if a checksum in a PNG file fails; False for other files."""
    return data.startswith(PNG_START) and None in (kind for kind, _ in _chunks(data))


def _chunks(data: bytes) -> Iterator[tuple[bytes | None, memoryview]]:
    """Yield kind and content of each chunk; kind None at the first damage, where it ends."""
    view, at = memoryview(data), len(PNG_START)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind, end = data[at + 4 : at + 8], at + 8 + length
        is_whole = end + 4 <= len(data)
        if not is_whole or _zlib.crc32(view[at + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            break
        yield kind, view[at + 8 : end]
        if kind == b"IEND":
            return
        at = end + 4
    if at < len(data):
        yield None, view[at:]


def plain_png_pixels(data: bytes) -> AnyArray | None:
    """Return the pixels of a PNG file as OpenCV does, unchanged: grey (H, W) of 8 or 16 bits, or blue, green and red (H, W, 3) of 8.

    None for a file that is damaged, large, or of another kind, such as interlaced ones and those with a palette: let OpenCV judge it.
    """
    if not data.startswith(PNG_START):
        return None
    chunks = list(_chunks(data))
    kinds = {kind for kind, _ in chunks}
    if None in kinds or any(
        kind in _CHANGING or (kind[:1].isupper() and kind not in _UNDERSTOOD) for kind in kinds if kind
    ):
        return None
    if not chunks or chunks[0][0] != b"IHDR" or len(chunks[0][1]) != _HEAD.size:
        return None
    width, height, bits, colour, *others = _HEAD.unpack(chunks[0][1])
    pixel_bytes = _PIXEL_BYTES.get((bits, colour), 0)
    if not (0 < width * height <= MAX_PIXELS and pixel_bytes) or any(others):
        return None
    row_bytes = 1 + width * pixel_bytes
    inflating = _zlib.decompressobj()
    try:
        inflated = inflating.decompress(
            b"".join(content for kind, content in chunks if kind == b"IDAT"), height * row_bytes + 1
        )
        filtered = np.frombuffer(inflated, np.uint8).reshape(height, row_bytes)
        rows = core.png_rows(filtered, pixel_bytes)
    except (_zlib.error, ValueError):
        return None
    if not inflating.eof:
        return None
    if bits == 16:
        return rows.view(">u2").astype(np.uint16)
    return rows if colour == 0 else cv2.cvtColor(rows.reshape(height, width, 3), cv2.COLOR_RGB2BGR)
