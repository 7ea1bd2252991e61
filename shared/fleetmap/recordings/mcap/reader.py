"""Opens MCAP recordings: rosbag2 style (CDR) and Foxglove protobuf; whole, cut off or damaged."""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.recordings.calibration_files import CalibrationFile, parse_calibration
from fleetmap.recordings.finalize import Parts, assemble, calibration_of_options
from fleetmap.recordings.folders.image_files import hash_file
from fleetmap.recordings.folders.table_files import (
    PAIR_TOLERANCE_NS,
    clean_imu,
    forward_only,
    pair_stamps,
    trajectory_of_rows,
)
from fleetmap.recordings.images import StoredFrame, StoredImage, decode_frame
from fleetmap.recordings.mcap.calibration import calibration_of_messages
from fleetmap.recordings.mcap.codecs import CODECS, Codec
from fleetmap.recordings.mcap.scan import MAGIC, Channel, Location, McapScan, MessageReader
from fleetmap.recordings.mcap.topics import IMAGE_TYPES, KNOWN_TYPES, TopicParts, choose_topics, type_name
from fleetmap.recordings.mcap.writer import CALIBRATION_ATTACHMENT
from fleetmap.recordings.recording import OpenOptions, Recording, Topics
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import CameraFrame, DataIssue, ImuSamples, Stamps, Trajectory

DEPTH_TOLERANCE_NS = 20_000_000  # depth and colour of consumer sensors are not triggered together
V = TypeVar("V")


@dataclass
class _Stream:
    """The messages of one channel: images by their place, everything else by its bytes."""

    channel: Channel
    codec: Codec
    stamps_ns: list[int] = field(default_factory=list)
    locations: list[Location] = field(default_factory=list)
    messages: list[bytes] = field(default_factory=list)
    damaged: int = 0

    def __len__(self) -> int:
        return len(self.locations) + len(self.messages)

    def values(self, decode: Callable[[Channel, bytes], V]) -> list[V]:
        """All messages that can be decoded; the others are counted."""
        found = []
        for data in self.messages:
            try:
                found.append(decode(self.channel, data))
            except ValueError:
                self.damaged += 1
        return found


@dataclass(frozen=True, slots=True)
class _Images:
    """One camera's images: stamps (N,), and where each lies."""

    stamps_ns: Stamps
    places: tuple[tuple[_Stream, Location], ...]

    def chosen(self, indices: NDArray[np.int64]) -> "_Images":
        return _Images(self.stamps_ns[indices], tuple(self.places[int(i)] for i in indices))


def recognises(path: Path) -> bool:
    """Whether `path` is a file that begins as MCAP does or is named .mcap, or a rosbag2 folder with one such file."""
    return _mcap_file(path) is not None


def open_mcap(path: Path, options: OpenOptions) -> Recording:
    """The recording in an MCAP file (or the one in a rosbag2 folder), as far as it is whole; losses say what is not."""
    file_path = _mcap_file(path)
    if file_path is None:
        raise RecordingError(f"{path} is no MCAP file; choose a file that ends in .mcap")
    pieces = len(list(path.glob("*.mcap"))) if path.is_dir() else 1
    if pieces > 1:
        raise RecordingError(f"{path} holds {pieces} .mcap files; choose one of them, or merge them with `mcap merge`")
    given = calibration_of_options(options)
    file = file_path.open("rb")
    try:
        return _open(path, file_path, file, options, given)
    except BaseException:
        file.close()
        raise


class McapFrames:
    """A FrameSource over the image messages of an open file."""

    def __init__(
        self,
        path: Path,
        file: BinaryIO,
        left: _Images,
        right: _Images | None,
        depth: _Images | None,
        also: Sequence[Path],
    ) -> None:
        self._path, self._file, self._also = path, file, also
        self._reader = MessageReader(path, file)
        self._left, self._right, self._depth = left, right, depth

    def stored(self, index: int) -> StoredFrame:
        """Frame `index` as its messages carry it."""
        right = None if self._right is None else self._image(self._right, index)
        depth = None if self._depth is None else self._image(self._depth, index)
        return StoredFrame(int(self._left.stamps_ns[index]), self._image(self._left, index), right, depth)

    def frame(self, index: int) -> CameraFrame:
        """Frame `index`, decoded."""
        return decode_frame(self.stored(index))

    def hash_into(self, digest: "hashlib._Hash") -> None:
        """The bytes of the whole file, then those of the calibration file where one was given."""
        for path in (self._path, *self._also):
            hash_file(path, digest)

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def _image(self, images: _Images, index: int) -> StoredImage:
        stream, location = images.places[index]
        where = f"{self._path}: {stream.channel.topic} at {images.stamps_ns[index]}"
        if self._file.closed:
            raise RecordingError(
                f"{where} was asked for after the recording was closed; keep it open while frames are read"
            )
        try:
            return stream.codec.image(stream.channel, self._reader.read(location), where)
        except ValueError as error:
            raise RecordingError(
                f"{where}: {error}; the message is damaged, leave the frame out with --frames"
            ) from error


def _open(
    path: Path, file_path: Path, file: BinaryIO, options: OpenOptions, given: CalibrationFile | None
) -> Recording:
    scan = McapScan(file_path, file)
    streams = _collect(scan, options.topics)
    channels = [stream.channel for stream in streams.values() if len(stream)]
    if not channels:
        raise RecordingError(
            f"{file_path} holds no message that can be read ({_in_words(scan.damage.all()) or 'it is empty'})"
        )
    topics = _with_hints(options.topics, given, {channel.topic for channel in channels})
    chosen = choose_topics(channels, topics, str(file_path))
    losses = [*scan.damage.all(), *chosen.losses]
    imu, imu_frame = _imu(_streams(streams, chosen, "imu"), losses)
    left = _images(_streams(streams, chosen, "left"), "left images", losses)
    right = _images(_streams(streams, chosen, "right"), "right images", losses) if "right" in chosen.channels else None
    depth = _images(_streams(streams, chosen, "depth"), "depth images", losses) if "depth" in chosen.channels else None
    if right is not None:
        left, right = _paired(left, right, PAIR_TOLERANCE_NS, losses)
        depth = None
    elif depth is not None:
        left, depth = _paired(left, depth, DEPTH_TOLERANCE_NS, losses)
    calibration = given.calibration if given else _calibration(scan, streams, chosen, right is not None, imu_frame)
    wheel = [v for s in _streams(streams, chosen, "wheel") for v in s.values(s.codec.wheel)]
    priors = [v for s in _streams(streams, chosen, "prior") for v in s.values(s.codec.prior)]
    ground_truth = _ground_truth(_streams(streams, chosen, "ground_truth"), losses)
    losses += [_damaged(stream) for stream in streams.values() if stream.damaged]
    also = [options.calibration_file] if options.calibration_file is not None else []
    return assemble(
        Parts(
            path=path,
            name=scan.metadata.get("fleetmap", {}).get("name", path.stem),
            format="mcap",
            calibration=calibration,
            frame_stamps_ns=left.stamps_ns,
            frames=McapFrames(file_path, file, left, right, depth, also),
            has_right=right is not None,
            has_depth=depth is not None,
            imu=imu,
            wheel=tuple(_forward(wheel, [w.stamp_ns for w in wheel], "wheel odometry", losses)),
            priors=tuple(_forward(priors, [p.stamp_ns for p in priors], "position priors", losses)),
            ground_truth=ground_truth,
            losses=losses,
        )
    )


def _collect(scan: McapScan, topics: Topics) -> dict[int, _Stream]:
    """The streams of all channels whose messages may be needed."""
    streams: dict[int, _Stream] = {}
    codecs: dict[str, Codec] = {}
    unused: set[int] = set()
    for channel, log_time_ns, location, data in scan.messages():
        stream = streams.get(channel.id)
        if stream is None:
            if channel.id in unused or not _may_be_needed(channel, topics):
                unused.add(channel.id)
                continue
            encoding = channel.message_encoding
            codec = codecs.setdefault(encoding, CODECS[encoding]())
            stream = streams[channel.id] = _Stream(channel, codec)
        if type_name(channel) not in IMAGE_TYPES:
            # Lenses repeat with every image, one is enough
            if not (stream.messages and _is_lens(channel)):
                stream.messages.append(bytes(data))
            continue
        try:
            stamp_ns = stream.codec.stamp_ns(channel, data) or log_time_ns
        except ValueError:
            stream.damaged += 1
            continue
        stream.stamps_ns.append(stamp_ns)
        stream.locations.append(location)
    return streams


def _may_be_needed(channel: Channel, topics: Topics) -> bool:
    if channel.message_encoding not in CODECS or type_name(channel) not in KNOWN_TYPES:
        return False
    return channel.topic == topics.tf_static or "Transform" not in type_name(channel).replace("TFMessage", "Transform")


def _is_lens(channel: Channel) -> bool:
    return type_name(channel) in ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration")


def _with_hints(topics: Topics, given: CalibrationFile | None, present: set[str]) -> Topics:
    """The wanted topics, with those that a Kalibr file notes where they exist and the caller asked for no other."""
    if given is None:
        return topics
    defaults, changes = Topics(), {}
    for part, key in (("left", "cam0"), ("right", "cam1"), ("imu", "imu0")):
        hint = given.topics.get(key, "")
        is_asked_for = getattr(topics, part) != getattr(defaults, part)
        if hint in present and not is_asked_for:
            changes[part] = hint
    return msgspec.structs.replace(topics, **changes)


def _streams(streams: dict[int, _Stream], chosen: TopicParts, part: str) -> list[_Stream]:
    return [streams[channel_id] for channel_id in chosen.channels.get(part, ())]


def _images(streams: Sequence[_Stream], what: str, losses: list[DataIssue]) -> _Images:
    stamps_ns = np.array([stamp for stream in streams for stamp in stream.stamps_ns], np.int64)
    places = tuple((stream, location) for stream in streams for location in stream.locations)
    return _Images(stamps_ns, places).chosen(np.flatnonzero(forward_only(stamps_ns, what, losses)))


def _paired(first: _Images, second: _Images, tolerance_ns: int, losses: list[DataIssue]) -> tuple[_Images, _Images]:
    firsts, seconds = pair_stamps(first.stamps_ns, second.stamps_ns, tolerance_ns)
    alone = len(first.places) + len(second.places) - 2 * len(firsts)
    if alone:
        counts = f"{alone} of {len(first.places)} and {len(second.places)}"
        losses.append(DataIssue("images without their partner", f"{counts}; {len(firsts)} pairs remain"))
    return first.chosen(firsts), second.chosen(seconds)


def _imu(streams: Sequence[_Stream], losses: list[DataIssue]) -> tuple[ImuSamples, str | None]:
    parts: list[tuple[Stamps, NDArray[np.float64], NDArray[np.float64], str]] = []
    for stream in streams:
        codec = stream.codec
        try:
            parts.append(codec.imu(stream.channel, stream.messages))
        except ValueError:
            parts += stream.values(lambda channel, data, codec=codec: codec.imu(channel, [data]))  # type: ignore[misc]
    if not parts:
        return ImuSamples.empty(), None
    stamps_ns, gyro, accel = (np.concatenate([part[i] for part in parts]) for i in range(3))
    return clean_imu(stamps_ns.astype(np.int64), gyro, accel, losses), parts[0][3]


def _ground_truth(streams: Sequence[_Stream], losses: list[DataIssue]) -> Trajectory | None:
    rows = [value for stream in streams for value in stream.values(stream.codec.pose)]
    if not rows:
        return None
    stamps_ns = np.array([stamp for stamp, _ in rows], np.int64)
    return trajectory_of_rows(stamps_ns, np.stack([row for _, row in rows]), losses, "ground truth")


def _calibration(
    scan: McapScan, streams: dict[int, _Stream], chosen: TopicParts, has_right: bool, imu_frame: str | None
) -> RigCalibration:
    attached = scan.attachments.get(CALIBRATION_ATTACHMENT)
    if attached is not None:
        where = f"{scan.path}: attachment {CALIBRATION_ATTACHMENT}"
        return parse_calibration(attached.decode("utf-8", "replace"), where).calibration
    infos, are_rectified = [], []
    for part in ("left", "right") if has_right else ("left",):
        found = [
            v for stream in _streams(streams, chosen, f"{part}_info") for v in stream.values(stream.codec.camera_info)
        ]
        image_topic = _streams(streams, chosen, part)[0].channel.topic
        if not found:
            raise CalibrationError(
                f"{scan.path}: no CameraInfo beside {image_topic} says what its lens is; pass a calibration with "
                f"--calibration FILE"
            )
        infos.append(found[0])
        are_rectified.append("rect" in image_topic)
    links = [
        link for s in _streams(streams, chosen, "tf_static") for found in s.values(s.codec.links) for link in found
    ]
    return calibration_of_messages(infos, are_rectified, links, imu_frame, str(scan.path))


def _forward(values: Sequence[V], stamps_ns: Iterable[int], what: str, losses: list[DataIssue]) -> list[V]:
    kept = forward_only(np.array(list(stamps_ns), np.int64), what, losses)
    return [value for value, keep in zip(values, kept, strict=True) if keep]


def _damaged(stream: _Stream) -> DataIssue:
    return DataIssue(
        f"{stream.channel.topic}: damaged messages", f"{stream.damaged} left out, {len(stream)} were found"
    )


def _in_words(losses: Iterable[DataIssue]) -> str:
    return "; ".join(f"{loss.what}: {loss.detail}" for loss in losses)


def _mcap_file(path: Path) -> Path | None:
    if path.is_dir():
        return next(iter(sorted(path.glob("*.mcap"))), None)
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return path if path.suffix == ".mcap" or file.read(len(MAGIC)) == MAGIC else None
