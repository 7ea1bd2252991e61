"""Files of messages: what MCAP, rosbag2's SQLite and ROS 1 bags look like to `streams`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from fleetmap.errors import RecordingError
from fleetmap.sensors.samples import DataIssue

CALIBRATION_ATTACHMENT = "calibration.yaml"
MAX_MESSAGE_BYTES = 64 << 20  # one raw image of 64 megapixels
# What is kept of a file beside its images (schemas, metadata, IMU and the rest), by the size of the file. Messages of zeros are
# the limit: zstd makes 1 of 8 bytes of recorded odometry, which is mostly empty covariances, and 1 of 30,000 zeros.
_KEPT_BYTES, _KEPT_PER_FILE_BYTE = 64 << 20, 32
_KEPT_RECORD_BYTES = 256  # of a record's place, stamp and object in memory
Place = tuple[int, int, int]  # of a message in its file, as its container numbers them


@dataclass(frozen=True, slots=True)
class Schema:
    """The type of a channel's messages."""

    name: str
    encoding: str = ""
    data: bytes = b""


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic's channel."""

    id: int
    topic: str
    message_encoding: str
    schema: Schema


Message = tuple[Channel, int, Place, memoryview]


class Container(Protocol):
    """An open recording of messages. path: what errors name; files: all that its hash covers; name: what it calls itself, or nothing."""

    path: Path
    files: Sequence[Path]

    @property
    def name(self) -> str:
        """See above; after `messages`."""

    @property
    def attachments(self) -> Mapping[str, bytes]:
        """Files inside it, after `messages`."""

    def messages(self) -> Iterator[Message]:
        """Channel, log time in ns, place and bytes of every message that is whole, in the order of writing."""

    def issues(self) -> list[DataIssue]:
        """What could not be read, after `messages`."""

    def keep(self, size: int) -> None:
        """See `KeptBytes`."""

    def read(self, place: Place) -> bytes:
        """One message again; ValueError where it is damaged, RecordingError where the file is not what it was any more."""

    def close(self) -> None:
        """Closes the files."""


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
