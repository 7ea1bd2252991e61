"""What a file from a stranger may cost in memory: every limit on sizes, and the functions that unpack within them."""

import bz2
from pathlib import Path

import zstandard

from fleetmap.errors import RecordingError

MAX_MESSAGE_BYTES = (
    64 << 20
)  # of a message, a chunk, an attachment: one raw image of 64 megapixels; recorders write chunks of 1 to 4 MiB
MAX_PIXELS = 64_000_000  # the largest sensors of machine vision have 150, those of robots 5
MAX_IMAGE_BYTES = 8 * MAX_PIXELS
MAX_TABLE_BYTES = 1 << 30  # 13 hours of an IMU at 200 Hz
MAX_CALIBRATION_BYTES = 1 << 20  # a camchain of two cameras has 2 kB
MAX_VIDEO_TABLE_BYTES = 256 << 20
# What is kept of a file beside its images (schemas, metadata, IMU and the rest), by the size of the file. Messages of zeros are
# the limit: zstd makes 1 of 8 bytes of recorded odometry, which is mostly empty covariances, and 1 of 30,000 zeros.
_KEPT_BYTES, _KEPT_PER_FILE_BYTE = 64 << 20, 32
_KEPT_RECORD_BYTES = 256  # of a record's place, stamp and object in memory


class KeptBytes:
    """Counts what stays in memory of files of `size` bytes."""

    def __init__(self, path: Path, size: int) -> None:
        self.path, self.size, self._kept = path, size, 0

    def keep(self, size: int) -> None:
        """Counts a record of `size` bytes that stays in memory; RecordingError where the file unpacks to more than a recording can."""
        self._kept += size + _KEPT_RECORD_BYTES
        limit = _KEPT_BYTES + _KEPT_PER_FILE_BYTE * self.size
        if self._kept > limit:
            raise RecordingError(
                f"{self.path}: {self.size} bytes unpack to more than {limit} bytes beside the images; no recorder writes "
                "that, leave the file out"
            )


def unpack(compression: str, packed: bytes | memoryview, most_bytes: int = MAX_MESSAGE_BYTES) -> bytes:
    """The unpacked bytes; ValueError for what cannot be unpacked, or to more than `most_bytes`.

    No more memory is taken, whatever the packed bytes say of themselves. compression: zstd, lz4, bz2, or empty for none.
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
        raise ValueError(f"{len(packed)} bytes are no {compression}") from error
    if len(unpacked) > most_bytes:
        raise ValueError(f"{len(packed)} bytes unpack to more than {most_bytes}, which is the limit")
    return unpacked
