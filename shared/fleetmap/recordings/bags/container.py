"""Files of messages: the common interface of MCAP, rosbag2's SQLite and ROS 1 bags for `streams`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from fleetmap.recordings.limits import KeptBytes
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


class Container(KeptBytes):
    """Base of the open files of a recording of messages. files: covered by its hash; name: its own name, or empty."""

    def __init__(self, files: Sequence[Path]) -> None:
        super().__init__(files[0], sum(file.stat().st_size for file in files))
        self.files, self.name = files, ""
        self.attachments: dict[str, bytes] = {}
        self.issues: list[DataIssue] = []

    def messages(self) -> Iterator[Message]:
        """Yield channel, log time in ns, place and bytes of every complete message, in the order of writing.

        After that, name, attachments and issues (unreadable parts) are complete.
        """
        raise NotImplementedError

    def read(self, place: Place) -> bytes:
        """Read one message again; ValueError if it is damaged, RecordingError if the file has changed."""
        raise NotImplementedError

    def close(self) -> None:
        """Close the files."""

    def note(self, what: str, detail: str) -> None:
        """Note an unreadable part."""
        self.issues.append(DataIssue(what, detail))
