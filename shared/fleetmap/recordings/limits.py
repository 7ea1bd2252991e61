"""Memory limits for untrusted files: all limits on sizes, and the functions that unpack within them."""

import bz2
from collections.abc import Callable

import zstandard

# Of a message, a chunk, an attachment: one raw image of 64 megapixels; recorders write chunks of 1 to 4 MiB
MAX_MESSAGE_BYTES = 64 << 20
MAX_PIXELS = 64_000_000  # the largest machine-vision sensors have 150, those of robots 5
MAX_IMAGE_BYTES = 8 * MAX_PIXELS
MAX_TABLE_BYTES = 1 << 30  # 13 hours of an IMU at 200 Hz
MAX_CALIBRATION_BYTES = 1 << 20  # a camchain of two cameras has 2 kB
MAX_VIDEO_TABLE_BYTES = 256 << 20
# Limit on data kept beside the images (schemas, metadata, IMU and so on), by the size of the file. Messages of zeros are
# the extreme: zstd compresses recorded odometry, mostly empty covariances, 8 to 1, and zeros 30,000 to 1.
KEPT_BYTES, KEPT_PER_FILE_BYTE = 64 << 20, 32
KEPT_RECORD_BYTES = 256  # memory of a record's place, stamp and object
# Records that a file of any size may have, and bytes of it for each further one: no recorder packs one into less than ten.
PASSED_RECORDS, LEAST_RECORD_BYTES = 250_000, 4
# Bytes to which a file of any size may unpack, and for each byte of it: pictures of a simulator, a wall without noise, pack 100
# to 1. The limit takes a second of the processor for 4 MiB of the file.
UNPACKED_BYTES, UNPACKED_PER_FILE_BYTE = 1 << 30, 256


def unpack(compression: str, packed: bytes | memoryview, most_bytes: int = MAX_MESSAGE_BYTES) -> bytes:
    """Unpack bytes; ValueError if they are damaged or unpack to more than `most_bytes`.

    Never allocates more, whatever size the packed bytes declare. compression: zstd, lz4, bz2, or empty for none.
    """
    try:
        if compression == "":
            unpacked = packed if isinstance(packed, bytes) else bytes(packed)
        elif compression == "zstd":
            with zstandard.ZstdDecompressor(max_window_size=MAX_MESSAGE_BYTES).stream_reader(packed) as reader:
                unpacked = bytes(reader.read(most_bytes + 1))
        elif compression == "lz4":
            from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

            unpacked = bytes(LZ4FrameDecompressor().decompress(packed, max_length=most_bytes + 1))
        elif compression == "bz2":
            unpacked = bz2.BZ2Decompressor().decompress(packed, most_bytes + 1)
        else:
            raise ValueError(f"compression {compression[:80]!r} is not known; known are zstd, lz4, bz2 and none")
    except (zstandard.ZstdError, RuntimeError, OSError, EOFError) as error:
        raise ValueError(f"{len(packed)} bytes are not valid {compression}") from error
    if len(unpacked) > most_bytes:
        raise ValueError(f"{len(packed)} bytes unpack to more than {most_bytes}, which is the limit")
    return unpacked


_PACKED = {b"\x28\xb5\x2f\xfd": "zstd", b"\x04\x22\x4d\x18": "lz4"}  # first bytes; a CDR message begins with 0


def unpack_message(data: memoryview, unpack: Callable[[str, memoryview], bytes] = unpack) -> memoryview:
    """Return a message, unpacked if its recorder packed each one by itself, as rosbag2 does; ValueError as of `unpack`."""
    kind = _PACKED.get(bytes(data[:4]))
    return data if kind is None else memoryview(unpack(kind, data))
