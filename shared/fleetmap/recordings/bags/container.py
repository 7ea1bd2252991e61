"""Files of messages: what MCAP, rosbag2's SQLite and ROS 1 bags look like to `streams`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from fleetmap.sensors.samples import DataIssue

CALIBRATION_ATTACHMENT = "calibration.yaml"
Place = tuple[int, int, int]  # of a message in its file, as its container numbers them


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic's channel. type_name: without ROS 2's `/msg/`, such as sensor_msgs/Imu; schema: as the file has it."""

    id: int
    topic: str
    encoding: str
    type_name: str
    schema: bytes = b""


Message = tuple[Channel, int, Place, memoryview]


class Container(Protocol):
    """An open recording of messages. path: what errors name; files: all that its hash covers; name: what it calls itself, or nothing."""

    path: Path
    files: Sequence[Path]
    name: str
    attachments: dict[str, bytes]
    issues: list[DataIssue]

    def messages(self) -> Iterator[Message]:
        """Channel, log time in ns, place and bytes of every message that is whole, in the order of writing.

        After it name, attachments and issues (what could not be read) are complete.
        """

    def keep(self, size: int) -> None:
        """See `KeptBytes`."""

    def read(self, place: Place) -> bytes:
        """One message again; ValueError where it is damaged, RecordingError where the file is not what it was any more."""

    def close(self) -> None:
        """Closes the files."""
