"""PNG files: their checksums, and the pixels of those that cameras write, in half of the time that OpenCV's zlib and libpng take.

Source: Portable Network Graphics (PNG) Specification, third edition.
"""

import struct
from collections.abc import Iterator

import cv2
import numpy as np

from fleetmap import core
from fleetmap.geometry import AnyArray
from fleetmap.recordings.limits import MAX_PIXELS

try:  # it has wheels for x86-64 and 64-bit ARM; elsewhere Python's own does the same, more slowly
    from isal import isal_zlib as _zlib
except ImportError:
    import zlib as _zlib  # type: ignore[no-redef]

PNG_START = b"\x89PNG\r\n\x1a\n"
_PIXEL_BYTES = {(8, 0): 1, (16, 0): 2, (8, 2): 3}  # by bits and kind of colour: grey, and red, green and blue
_HEAD = struct.Struct(">IIBBBBB")
# Chunks of files that are read here: those with pixels, and those that change none.
_PLAIN = {b"IHDR", b"IDAT", b"IEND", b"cHRM", b"eXIf", b"gAMA", b"iCCP", b"pHYs", b"sBIT", b"sRGB", b"tEXt", b"tIME"}


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
    head, packed, last, is_behind = None, bytearray(), b"", False
    for kind, content in _chunks(data) if data.startswith(PNG_START) else ():
        if kind not in _PLAIN or (kind == b"IHDR") != (head is None) or (kind == b"IDAT" and is_behind):
            return None
        head = content if head is None else head
        packed += content if kind == b"IDAT" else b""
        is_behind |= last == b"IDAT" != kind
        last = kind
    if head is None or last != b"IEND":
        return None
    inflating = _zlib.decompressobj()
    try:
        width, height, bits, colour, *others = _HEAD.unpack(head)
        pixel_bytes = _PIXEL_BYTES[bits, colour]
        row_bytes = 1 + width * pixel_bytes
        if any(others) or not 0 < width * height <= MAX_PIXELS:
            return None
        filtered = np.frombuffer(inflating.decompress(packed, height * row_bytes + 1), np.uint8)
        rows = core.png_rows(filtered.reshape(height, row_bytes), pixel_bytes)
    except (struct.error, KeyError, ValueError, _zlib.error):  # type: ignore[misc]
        return None
    if not inflating.eof or inflating.unused_data:
        return None
    if bits == 16:
        return rows.view(">u2").astype(np.uint16)
    return rows if colour == 0 else cv2.cvtColor(rows.reshape(height, width, 3), cv2.COLOR_RGB2BGR)
