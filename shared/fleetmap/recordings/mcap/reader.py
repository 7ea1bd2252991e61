"""Opens MCAP recordings: rosbag2 style (CDR) and Foxglove protobuf; whole, cut off or damaged."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

from fleetmap.errors import RecordingError
from fleetmap.recordings.bags.container import Message, Place
from fleetmap.recordings.bags.streams import open_messages
from fleetmap.recordings.mcap.scan import MAGIC, Location, McapScan, MessageReader
from fleetmap.recordings.ordering import UNCERTAIN_STAMPS
from fleetmap.recordings.recording import OpenOptions, Recording
from fleetmap.sensors.samples import DataIssue


def recognises(path: Path) -> bool:
    """Whether `path` is a file that begins as MCAP does or is named .mcap, or a rosbag2 folder with one such file."""
    return _mcap_file(path) is not None


def open_mcap(path: Path, options: OpenOptions) -> Recording:
    """The recording in an MCAP file (or the one in a rosbag2 folder), as far as it is whole; its issues say what is not."""
    file_path = _mcap_file(path)
    if file_path is None:
        raise RecordingError(f"{path} is no MCAP file; choose a file that ends in .mcap")
    pieces = len(list(path.glob("*.mcap"))) if path.is_dir() else 1
    if pieces > 1:
        raise RecordingError(f"{path} holds {pieces} .mcap files; choose one of them, or merge them with `mcap merge`")
    return open_messages(path, "mcap", partial(McapFile, file_path), options)


class McapFile:
    """An open MCAP file as a Container."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files: Sequence[Path] = (path,)
        self._file = path.open("rb")
        self._scan, self._reader = McapScan(path, self._file), MessageReader(path, self._file)
        self.keep = self._scan.keep

    @property
    def name(self) -> str:
        return self._written("name")

    @property
    def attachments(self) -> Mapping[str, bytes]:
        return self._scan.attachments

    def _written(self, key: str) -> str:
        """What McapRecordingWriter wrote of the whole recording."""
        return self._scan.metadata.get("fleetmap", {}).get(key, "")

    def messages(self) -> Iterator[Message]:
        return self._scan.messages()

    def issues(self) -> list[DataIssue]:
        return [*self._scan.damage.all(), *([UNCERTAIN_STAMPS] if self._written("stamps") else [])]

    def read(self, place: Place) -> bytes:
        return self._reader.read(Location(*place))

    def close(self) -> None:
        self._file.close()


def _mcap_file(path: Path) -> Path | None:
    if path.is_dir():
        return next(iter(sorted(path.glob("*.mcap"))), None)
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return path if path.suffix == ".mcap" or file.read(len(MAGIC)) == MAGIC else None
