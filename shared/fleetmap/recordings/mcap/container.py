"""Files of messages: the common interface of MCAP and of bags for `streams`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fleetmap.geometry import Array
from fleetmap.recordings.limits import KeptBytes
from fleetmap.recordings.ros2 import messages as ros
from fleetmap.recordings.ros2.cdr import unpack
from fleetmap.sensors.samples import DataIssue, Stamps

CALIBRATION_ATTACHMENT = "calibration.yaml"
_MOST_ISSUES = 20
UNDECODABLE = (ValueError, AttributeError)  # the second: a field that a schema in the file lacks
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

    def decode(self, channel: Channel, data: bytes) -> Any:
        """The value of a message by its type, as `DECODERS`; UNDECODABLE for invalid ones, RecordingError if a library is missing."""
        return ros.DECODERS[channel.type_name](data)

    def decode_imu(self, channel: Channel, messages: Sequence[bytes]) -> tuple[Stamps, Array, Array, str]:
        """Stamps (N,), gyro (N, 3), accelerometer (N, 3), frame of the sensor. Errors as of `decode`, for any of the messages."""
        return ros.decode_imu(messages)

    def stamp_of(self, channel: Channel, data: bytes) -> int:
        """Stamp of a message with a header, 0 where the sender set none; UNDECODABLE without one."""
        seconds, nanoseconds = unpack("builtin_interfaces/Time", data)
        return int(seconds * 1_000_000_000 + nanoseconds)

    def close(self) -> None:
        """Close the files."""

    def note(self, what: str, detail: str) -> None:
        """Note an unreadable part, unless there are very many."""
        if len(self.issues) < _MOST_ISSUES:
            self.issues.append(DataIssue(what, detail))
