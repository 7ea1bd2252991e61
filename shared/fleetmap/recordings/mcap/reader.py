"""Opens MCAP recordings: rosbag2 style (CDR) and Foxglove protobuf; whole, cut off or damaged."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Protocol, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from fleetmap.errors import CalibrationError, RecordingError
from fleetmap.geometry import Array
from fleetmap.recordings.calibration_files import CalibrationFile, parse_calibration
from fleetmap.recordings.finalize import RecordingParts, calibration_of_options, finalize
from fleetmap.recordings.folders.image_files import hash_file
from fleetmap.recordings.image_series import ImageSeries, SeriesFrames, pair_images
from fleetmap.recordings.images import StoredImage
from fleetmap.recordings.mcap.calibration import InfoCamera, calibration_of_messages
from fleetmap.recordings.mcap.foxglove import FoxgloveCodec
from fleetmap.recordings.mcap.scan import MAGIC, Channel, Location, McapScan, MessageReader
from fleetmap.recordings.mcap.topics import IMAGE_TYPES, KNOWN_TYPES, choose_topics, type_name
from fleetmap.recordings.mcap.writer import CALIBRATION_ATTACHMENT
from fleetmap.recordings.ordering import ReadLog, clean_imu, trajectory_of_rows, values_forward
from fleetmap.recordings.recording import OpenOptions, Recording, Topics
from fleetmap.recordings.ros2 import messages as ros_messages
from fleetmap.recordings.ros2.cdr import CdrReader
from fleetmap.recordings.ros2.messages import CameraInfo, FrameLink
from fleetmap.sensors.calibration import RigCalibration
from fleetmap.sensors.samples import ImuSamples, PositionPrior, Stamps, Trajectory, WheelSample


class Codec(Protocol):
    """Reads the messages of one file."""

    def stamp_ns(self, channel: Channel, data: memoryview) -> int:
        """Stamp of the measurement; 0 where the sender set none."""

    def image(self, channel: Channel, data: bytes, where: str) -> StoredImage:
        """An image, still encoded."""

    def imu(self, channel: Channel, messages: Sequence[bytes]) -> tuple[Stamps, Array, Array, str]:
        """Stamps (N,), gyro (N, 3), accelerometer (N, 3), frame of the sensor."""

    def pose(self, channel: Channel, data: bytes) -> tuple[int, Array]:
        """Stamp and x y z qw qx qy qz (7,)."""

    def links(self, channel: Channel, data: bytes) -> list[FrameLink]:
        """Transforms between named frames."""

    def camera_info(self, channel: Channel, data: bytes) -> CameraInfo:
        """A lens."""

    def wheel(self, channel: Channel, data: bytes) -> WheelSample:
        """Wheel odometry."""

    def prior(self, channel: Channel, data: bytes) -> PositionPrior:
        """A position prior."""


class RosCodec:
    """ROS 2 messages in CDR."""

    def stamp_ns(self, channel: Channel, data: memoryview) -> int:
        """From the message's header, its first field."""
        return CdrReader(bytes(data[:16])).stamp_ns()

    def image(self, channel: Channel, data: bytes, where: str) -> StoredImage:
        """Image or CompressedImage."""
        if type_name(channel).endswith("CompressedImage"):
            return ros_messages.decode_compressed_image(data, where)
        return ros_messages.decode_image(data, where)

    def imu(self, channel: Channel, messages: Sequence[bytes]) -> tuple[Stamps, Array, Array, str]:
        """Imu messages."""
        return ros_messages.decode_imu(messages)

    def pose(self, channel: Channel, data: bytes) -> tuple[int, Array]:
        """PoseStamped."""
        return ros_messages.decode_pose(data)

    def links(self, channel: Channel, data: bytes) -> list[FrameLink]:
        """TFMessage."""
        return ros_messages.decode_frame_links(data)

    def camera_info(self, channel: Channel, data: bytes) -> CameraInfo:
        """CameraInfo."""
        return ros_messages.decode_camera_info(data)

    def wheel(self, channel: Channel, data: bytes) -> WheelSample:
        """Odometry."""
        return ros_messages.decode_odometry(data)

    def prior(self, channel: Channel, data: bytes) -> PositionPrior:
        """PoseWithCovarianceStamped."""
        return ros_messages.decode_prior(data)


CODECS: dict[str, Callable[[], Codec]] = {"cdr": RosCodec, "protobuf": FoxgloveCodec}


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


_Images = ImageSeries[tuple[_Stream, Location]]
_Roles = Mapping[str, list[_Stream]]  # the streams by the role that `choose_topics` gives their topic


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
    given = calibration_of_options(options)
    file = file_path.open("rb")
    try:
        return _open(path, file_path, file, options, given)
    except BaseException:
        file.close()
        raise


class McapFrames(SeriesFrames[tuple[_Stream, Location]]):
    """A FrameSource over the image messages of an open file, or of one that the first read opens.

    `read_files`: the files that the content's hash covers, the recording first.
    """

    def __init__(
        self,
        file: BinaryIO | None,
        read_files: Sequence[Path],
        left: _Images,
        right: _Images | None = None,
        depth: _Images | None = None,
    ) -> None:
        super().__init__(self._image, left, right, depth)
        self._path, self._file, self._read_files = read_files[0], file, read_files
        self._reader = None if file is None else MessageReader(self._path, file)

    def part(self, indices: NDArray[np.int64]) -> "McapFrames":
        """See FrameSource."""
        return McapFrames(None, self._read_files, *self.taken(indices))

    def hash_into(self, digest: "hashlib._Hash") -> None:
        """The bytes of the whole file, then those of the calibration file where one was given."""
        for path in self._read_files:
            hash_file(path, digest)

    def close(self) -> None:
        """Closes the file."""
        if self._file is not None:
            self._file.close()

    def _image(self, source: tuple[_Stream, Location], stamp_ns: int) -> StoredImage:
        stream, location = source
        where = f"{self._path}: {stream.channel.topic} at {stamp_ns}"
        if self._file is None or self._reader is None:
            self._file = _opened(self._path)
            self._reader = MessageReader(self._path, self._file)
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


def _opened(path: Path) -> BinaryIO:
    try:
        return path.open("rb")
    except OSError as error:
        raise RecordingError(f"{path} cannot be read any more ({error.strerror}); was the recording moved?") from error


def _open(
    path: Path, file_path: Path, file: BinaryIO, options: OpenOptions, given: CalibrationFile | None
) -> Recording:
    scan = McapScan(file_path, file)
    streams = _collect(scan, options.topics)
    channels = [stream.channel for stream in streams.values() if len(stream)]
    if not channels:
        issues = "; ".join(f"{issue.what}: {issue.detail}" for issue in scan.damage.all())
        raise RecordingError(f"{file_path} holds no message that can be read ({issues or 'it is empty'})")
    topics = _with_hints(options.topics, given, {channel.topic for channel in channels})
    log = ReadLog(scan.damage.all(), [file_path])
    chosen = choose_topics(channels, topics, str(file_path), log)
    roles = {role: [streams[channel_id] for channel_id in ids] for role, ids in chosen.items()}
    imu, imu_frame = _imu(roles.get("imu", ()), log)
    left = _images(roles["left"], "left images", log)
    right = _images(roles["right"], "right images", log) if "right" in roles else None
    depth = _images(roles["depth"], "depth images", log) if "depth" in roles else None
    if right is not None:
        (left, right), depth = pair_images(left, right, log), None
    elif depth is not None:
        left, depth = pair_images(left, depth, log, DEPTH_TOLERANCE_NS)
    calibration = given.calibration if given else _calibration(scan, roles, right is not None, imu_frame)
    wheel = [v for stream in roles.get("wheel", ()) for v in stream.values(stream.codec.wheel)]
    priors = [v for stream in roles.get("prior", ()) for v in stream.values(stream.codec.prior)]
    ground_truth = _ground_truth(roles.get("ground_truth", ()), log)
    for stream in streams.values():
        if stream.damaged:
            what = f"{stream.channel.topic}: damaged messages"
            log.note(what, f"{stream.damaged} left out, {len(stream)} were found")
    if options.calibration_file is not None:
        log.files.append(options.calibration_file)
    parts = RecordingParts(
        path=path,
        name=scan.metadata.get("fleetmap", {}).get("name", path.stem),
        format="mcap",
        calibration=calibration,
        frame_stamps_ns=left.stamps_ns,
        frames=McapFrames(file, log.files, left, right, depth),
        has_right=right is not None,
        has_depth=depth is not None,
        imu=imu,
        wheel=values_forward(wheel, [sample.stamp_ns for sample in wheel], "wheel odometry", log),
        priors=values_forward(priors, [prior.stamp_ns for prior in priors], "position priors", log),
        ground_truth=ground_truth,
    )
    return finalize(parts, log)


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
            if not (stream.messages and type_name(channel) in ("sensor_msgs/CameraInfo", "foxglove.CameraCalibration")):
                scan.keep(len(data))
                stream.messages.append(bytes(data))
            continue
        try:
            stamp_ns = stream.codec.stamp_ns(channel, data) or log_time_ns
        except ValueError:
            stream.damaged += 1
            continue
        scan.keep(0)
        stream.stamps_ns.append(stamp_ns)
        stream.locations.append(location)
    return streams


def _may_be_needed(channel: Channel, topics: Topics) -> bool:
    if channel.message_encoding not in CODECS or type_name(channel) not in KNOWN_TYPES:
        return False
    return channel.topic == topics.tf_static or "Transform" not in type_name(channel).replace("TFMessage", "Transform")


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


def _images(streams: Sequence[_Stream], what: str, log: ReadLog) -> _Images:
    stamps_ns = np.array([stamp for stream in streams for stamp in stream.stamps_ns], np.int64)
    sources = tuple(
        (bare, location)
        for stream in streams
        for bare in [_Stream(stream.channel, stream.codec)]
        for location in stream.locations
    )
    return _Images(stamps_ns, sources).forward(what, log)


def _imu(streams: Sequence[_Stream], log: ReadLog) -> tuple[ImuSamples, str | None]:
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
    return clean_imu(stamps_ns.astype(np.int64), gyro, accel, log), parts[0][3]


def _ground_truth(streams: Sequence[_Stream], log: ReadLog) -> Trajectory | None:
    rows = [value for stream in streams for value in stream.values(stream.codec.pose)]
    if not rows:
        return None
    stamps_ns = np.array([stamp for stamp, _ in rows], np.int64)
    return trajectory_of_rows(stamps_ns, np.stack([row for _, row in rows]), log)


def _calibration(scan: McapScan, roles: _Roles, has_right: bool, imu_frame: str | None) -> RigCalibration:
    attached = scan.attachments.get(CALIBRATION_ATTACHMENT)
    if attached is not None:
        where = f"{scan.path}: attachment {CALIBRATION_ATTACHMENT}"
        return parse_calibration(attached.decode("utf-8", "replace"), where).calibration
    cameras = []
    for role in ("left", "right") if has_right else ("left",):
        streams, image_topic = roles.get(f"{role}_info", ()), roles[role][0].channel.topic
        infos = [info for stream in streams for info in stream.values(stream.codec.camera_info)]
        if not infos:
            raise CalibrationError(
                f"{scan.path}: no CameraInfo beside {image_topic} says what its lens is; pass a calibration with "
                "--calibration FILE"
            )
        cameras.append(InfoCamera(infos[0], "rect" in image_topic))
    streams = roles.get("tf_static", ())
    links = [link for stream in streams for found in stream.values(stream.codec.links) for link in found]
    return calibration_of_messages(cameras, links, imu_frame, str(scan.path))


def _mcap_file(path: Path) -> Path | None:
    if path.is_dir():
        return next(iter(sorted(path.glob("*.mcap"))), None)
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return path if path.suffix == ".mcap" or file.read(len(MAGIC)) == MAGIC else None
