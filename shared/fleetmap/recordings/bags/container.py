"""Files of messages: the common interface of MCAP, rosbag2's SQLite and ROS 1 bags for `streams`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from fleetmap.sensors.samples import DataIssue

CALIBRATION_ATTACHMENT = "calibration.yaml"
Place = tuple[int, ...]  # position of a message in its file, as numbered by its container


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic's channel. type_name: without ROS 2's `/msg/`, such as sensor_msgs/Imu; schema: as in the file."""

    id: int
    topic: str
    encoding: str
    type_name: str
    schema: bytes = b""


Message = tuple[Channel, int, Place, memoryview]


class Container(Protocol):
    """An open recording of messages. path: named in errors; files: covered by its hash; name: its own name, or empty."""

    path: Path
    files: Sequence[Path]
    name: str
    attachments: dict[str, bytes]
    issues: list[DataIssue]

    def messages(self) -> Iterator[Message]:
        """Yield channel, log time in ns, place and bytes of every complete message, in the order of writing.

        After that, name, attachments and issues (unreadable parts) are complete.
        """

    def keep(self, size: int) -> None:
        """See `KeptBytes`."""

    def read(self, place: Place) -> bytes:
        """Read one message again; ValueError if it is damaged, RecordingError if the file has changed."""

    def close(self) -> None:
        """Close the files."""
