"""Size of an image by the header of its file, before anything is decoded: JPEG, PNG, TIFF, BMP and PNM."""

import re
import struct

_PNM = re.compile(rb"P[1-6](?:\s+|#[^\n]{0,1000}\n){1,20}(\d{1,10})(?:\s+|#[^\n]{0,1000}\n){1,20}(\d{1,10})[\s#]")
_JPEG_SIZES = set(range(0xC0, 0xD0)) - {
    0xC4,
    0xC8,
    0xCC,
}  # start of frame; not tables, extensions, arithmetic conditioning
_JPEG_ALONE = {0x01, *range(0xD0, 0xD9)}  # markers without a length
_TIFF_KINDS = {1: "B", 3: "H", 4: "I"}  # byte, short, long
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels that the file's header states; None for other formats and for headers that are not whole."""
    try:
        if data.startswith(b"\xff\xd8"):
            return _jpeg_size(data)
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            width, height = struct.unpack_from(">II", data, 16)
            return (width, height) if data[12:16] == b"IHDR" else None
        if data.startswith((b"II*\0", b"MM\0*")):
            return _tiff_size(data)
        if data.startswith(b"BM"):
            return _bmp_size(data)
        found = _PNM.match(data[:4096])
        return None if found is None else (int(found[1]), int(found[2]))
    except struct.error:
        return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    at = 2
    while at < len(data):
        if data[at] != 0xFF:
            return None
        (marker,) = struct.unpack_from(">B", data, at + 1)
        if marker == 0xFF:  # filling
            at += 1
        elif marker in _JPEG_ALONE:
            at += 2
        else:
            (length,) = struct.unpack_from(">H", data, at + 2)
            if marker in _JPEG_SIZES:
                height, width = struct.unpack_from(">HH", data, at + 5)
                return width, height
            at += 2 + max(2, length)
    return None


def _tiff_size(data: bytes) -> tuple[int, int] | None:
    """Of the first picture; OpenCV reads no other."""
    order = "<" if data[0] == ord("I") else ">"
    (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, at)
    sizes: dict[int, int] = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT) and kind in _TIFF_KINDS:
            (size,) = struct.unpack_from(order + _TIFF_KINDS[kind], data, entry + 8)
            sizes[tag] = max(size, sizes.get(tag, 0))
    return (sizes[_TIFF_WIDTH], sizes[_TIFF_HEIGHT]) if len(sizes) == 2 else None


def _bmp_size(data: bytes) -> tuple[int, int]:
    (header_bytes,) = struct.unpack_from("<I", data, 14)
    if header_bytes == 12:  # OS/2's first form
        width, height = struct.unpack_from("<HH", data, 18)
    else:
        width, height = struct.unpack_from("<ii", data, 18)
    return abs(width), abs(height)
