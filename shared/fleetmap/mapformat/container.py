"""The common envelope of all binary formats: magic, format number, size, one zstd frame.

    offset  type   content
    0       4 s    magic, names the kind
    4       u16    format number
    6       u16    0
    8       u32    size of the payload before compression
    12      ...    one zstd frame with content size and checksum, and nothing after it

Little-endian. Opening untrusted bytes never allocates more than the limit that the caller states.
"""

import struct
from collections.abc import Sequence

import zstandard

from fleetmap.errors import MapFormatError, check_format

_HEADER = struct.Struct("<4sHHI")
_LEVEL = 19  # tiles are written once at night and read by every robot
_MAX_WINDOW_BYTES = 1 << 27


def pack(magic: bytes, format_number: int, payload: bytes | Sequence[bytes], *, level: int = _LEVEL) -> bytes:
    """Wrap `payload` in its envelope. Equal input gives equal bytes (for one release of zstd).

    A payload in parts is compressed in blocks of its own, each with its own statistics: columns of different kinds
    then compress better.
    """
    parts = [payload] if isinstance(payload, bytes) else payload
    size = sum(len(part) for part in parts)
    parameters = zstandard.ZstdCompressionParameters.from_level(
        level, source_size=size, write_checksum=True, write_content_size=True
    )
    compressor = zstandard.ZstdCompressor(compression_params=parameters).compressobj(size=size)
    frame = []
    for part in parts:
        frame += [compressor.compress(part), compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)]
    frame.append(compressor.flush())
    return _HEADER.pack(magic, format_number, 0, size) + b"".join(frame)


def unpack(magic: bytes, format_number: int, data: bytes, what: str, max_bytes: int) -> bytes:
    """Return the payload of `data`.

    Raises NewerFormatError for a format above `format_number`, MapFormatError for anything else but a complete
    envelope of kind `magic` with at most `max_bytes` inside. `what` names the thing in messages.
    """
    _, number, reserved, size = _HEADER.unpack(data[: _HEADER.size].ljust(_HEADER.size, b"\0"))
    check_format(what, data[:4], magic, number, format_number)
    if number != format_number or reserved != 0:
        raise MapFormatError(
            f"{what}: format {number} with reserved bytes {reserved} is invalid; the bytes are damaged"
        )
    if size > max_bytes:
        raise MapFormatError(f"{what} declares {size} bytes, the limit is {max_bytes}; it is damaged or not ours")
    frame = data[_HEADER.size :]
    try:
        declared = zstandard.get_frame_parameters(frame).content_size
        if declared != size:
            raise MapFormatError(f"{what}: header says {size} bytes, its zstd frame {declared}; the bytes are damaged")
        decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW_BYTES)
        payload = decompressor.decompress(frame, max_output_size=max(size, 1), allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise MapFormatError(f"{what}: {error}; the bytes are damaged, fetch them again") from error
    if len(payload) != size:
        raise MapFormatError(f"{what}: {len(payload)} bytes instead of {size}; the bytes are damaged, fetch them again")
    return payload
